"""Distance between the pusher and the box, and the face that it touches, from Coal."""
import coal
import numpy as np

from common.task import BOX, RADIUS

_CORNER = 0.001  # m: this near to a corner the last face stays
_box = coal.Box(BOX[0], BOX[1], 1.0)  # tall, so that a deep penetration leaves through a side
_ball = coal.Sphere(RADIUS)
_distance = coal.ComputeDistance(_box, _ball)
_at_box, _at_ball = coal.Transform3s(), coal.Transform3s()
_request, _result = coal.DistanceRequest(), coal.DistanceResult()


def nearest(box, pusher):
    """Signed distance and nearest point on the box of one world.

    Args:
        box: (3,) pose in m, m, rad.
        pusher: (2,) centre in m.
    Returns:
        distance in m (negative in penetration), and the box's nearest point (2,) in the box frame, m.
    """
    cos, sin = np.cos(box[2]), np.sin(box[2])
    dx, dy = pusher[0] - box[0], pusher[1] - box[1]
    _at_ball.setTranslation(np.array([cos * dx + sin * dy, cos * dy - sin * dx, 0.0]))  # the pusher in the box frame
    _result.clear()
    distance = _distance(_at_box, _at_ball, _request, _result)
    return distance, _result.getNearestPoint1()[:2]


def face(point, last):
    """Side of the box (0: +x, 1: +y, 2: -x, 3: -y) that holds a surface point (2,); `last` within 1 mm of a corner."""
    depth = BOX[:2] / 2 - np.abs(point)
    if last >= 0 and max(depth) < _CORNER:
        return last
    axis = int(np.argmin(depth))
    return axis + 2 * bool(point[axis] < 0)


def contact_switches(states):
    """Contacts of one episode on another face than the last; the first contact is none (sec. 5.4).

    Args:
        states: (T, 7) true states; a row is in contact if its force is above zero.
    """
    switches, last = 0, -1
    for s in states[np.linalg.norm(states[:, 5:7], axis=1) > 0]:
        now = face(nearest(s[:3], s[3:5])[1], last)
        switches += last >= 0 and now != last
        last = now
    return int(switches)
