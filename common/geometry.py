"""Rotations of the plane; distance between the pusher and the box, and the face that it touches, from Coal."""
import threading
from functools import cache

import coal
import numpy as np

from common.task import RADIUS, World

_ball = coal.Sphere(RADIUS)
_at_box, _at_ball = coal.Transform3s(), coal.Transform3s()
_request, _result = coal.DistanceRequest(), coal.DistanceResult()
_lock = threading.Lock()  # of these, which are everybody's


def rotation(angle):
    """Matrix (2, 2) that turns a vector (2,) by an angle in rad; rows of points turn by `points @ rotation(angle).T`."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


@cache
def _distance(length, width, height):
    """Coal's function for a box of that size."""
    box = coal.Box(length, width, 1.0)  # tall, so that a deep penetration leaves through a side
    return box, coal.ComputeDistance(box, _ball)  # which keeps no reference to the box


def nearest(box, pusher, size=World.box):
    """Signed distance in m of a box (3,) in m, m, rad and a pusher at (2,) in m, and the box's point (2,) nearest to it.

    The distance is negative in penetration; the point is in the box frame, in m.
    """
    in_box_frame = (rotation(-box[2]) * np.subtract(pusher[:2], box[:2])).sum(1)  # BLAS's product rounds as the machine likes
    with _lock:
        _at_ball.setTranslation(np.array([*in_box_frame, 0.0]))
        _result.clear()
        distance = _distance(*size)[1](_at_box, _at_ball, _request, _result)
        return distance, _result.getNearestPoint1()[:2]


def face(point, last, size=World.box):
    """Side of the box (0: +x, 1: +y, 2: -x, 3: -y) that holds a surface point (2,); `last` within 1 mm of a corner."""
    depth = np.array(size[:2]) / 2 - np.abs(point)
    if last >= 0 and max(depth) < 0.001:
        return last
    axis = int(np.argmin(depth))
    return axis + 2 * bool(point[axis] < 0)


def contact_switches(states, size=World.box):
    """Contacts (force above 0) of an episode, states (T, 7), on another face than the last; the first is none (sec. 5.4)."""
    faces = [-1]
    for s in states[np.linalg.norm(states[:, 5:7], axis=1) > 0]:
        faces.append(face(nearest(s[:3], s[3:5], size)[1], faces[-1], size))
    return sum(last != now for last, now in zip(faces[1:], faces[2:]))
