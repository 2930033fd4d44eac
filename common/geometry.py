"""Rotations of the plane; distance between the pusher and the box, and the face that it touches, from Coal."""
import threading

import coal
import numpy as np

from common.task import BOX, RADIUS

_box = coal.Box(BOX[0], BOX[1], 1.0)  # tall, so that a deep penetration leaves through a side
_ball = coal.Sphere(RADIUS)
_distance = coal.ComputeDistance(_box, _ball)
_at_box, _at_ball = coal.Transform3s(), coal.Transform3s()
_request, _result = coal.DistanceRequest(), coal.DistanceResult()
_lock = threading.Lock()  # of these, which are everybody's


def rotation(angle):
    """Matrix (2, 2) that turns a vector (2,) by an angle in rad; rows of points turn by `points @ rotation(angle).T`."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def nearest(box, pusher):
    """Signed distance in m of a box (3,) in m, m, rad and a pusher at (2,) in m, and the box's point (2,) nearest to it.

    The distance is negative in penetration; the point is in the box frame, in m.
    """
    in_box_frame = (rotation(-box[2]) * np.subtract(pusher[:2], box[:2])).sum(1)  # BLAS's product rounds as the machine likes
    with _lock:
        _at_ball.setTranslation(np.array([*in_box_frame, 0.0]))
        _result.clear()
        return _distance(_at_box, _at_ball, _request, _result), _result.getNearestPoint1()[:2]


def face(point, last):
    """Side of the box (0: +x, 1: +y, 2: -x, 3: -y) that holds a surface point (2,); `last` within 1 mm of a corner."""
    depth = BOX[:2] / 2 - np.abs(point)
    if last >= 0 and max(depth) < 0.001:
        return last
    axis = int(np.argmin(depth))
    return axis + 2 * bool(point[axis] < 0)


def contact_switches(states):
    """Contacts (force above 0) of an episode, states (T, 7), on another face than the last; the first is none (sec. 5.4)."""
    faces = [-1]
    for s in states[np.linalg.norm(states[:, 5:7], axis=1) > 0]:
        faces.append(face(nearest(s[:3], s[3:5])[1], faces[-1]))
    return sum(last != now for last, now in zip(faces[1:], faces[2:]))
