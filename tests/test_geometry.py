import numpy as np
import pytest

from common import geometry, task

HALF_BOX = np.array(task.World.box[:2]) / 2


def in_box_frame(box, pusher):
    cos, sin = np.cos(box[2]), np.sin(box[2])
    return np.array([[cos, sin], [-sin, cos]]) @ (pusher - box[:2])


def closed_form(box, pusher):
    """Signed distance of a disc to a rectangle, and the nearest point on the rectangle in its frame."""
    local = in_box_frame(box, pusher)
    excess = np.abs(local) - HALF_BOX
    if (excess <= 0).all():  # the disc's centre is inside: it leaves through the nearest side
        point, axis = local.copy(), np.argmax(excess)
        point[axis] = np.copysign(HALF_BOX[axis], local[axis])
        return excess.max() - task.RADIUS, point
    return np.linalg.norm(np.maximum(excess, 0)) - task.RADIUS, np.clip(local, -HALF_BOX, HALF_BOX)


def test_nearest_is_the_closed_form():
    rng = np.random.default_rng(0)
    for _ in range(2000):
        box = rng.uniform(-1, 1, 3) * [0.3, 0.15, np.pi]
        pusher = box[:2] + rng.uniform(-0.12, 0.12, 2)
        distance, point = geometry.nearest(box, pusher)
        expected_distance, expected_point = closed_form(box, pusher)
        assert distance == pytest.approx(expected_distance, abs=1e-6)
        if expected_distance > -task.RADIUS + 1e-3:  # deep inside two sides may be as near
            assert point == pytest.approx(expected_point, abs=1e-5)


def test_distance_of_a_touch_is_zero():
    assert geometry.nearest([0.1, 0.05, np.pi / 2], [0.1, 0.05 + 0.06 + 0.013])[0] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("point, side", [((0.06, 0.01), 0), ((-0.02, 0.05), 1), ((-0.06, -0.03), 2), ((0.03, -0.05), 3)])
def test_face_is_the_side_that_holds_the_point(point, side):
    assert geometry.face(np.array(point), -1) == side
    assert geometry.face(np.array(point), (side + 1) % 4) == side


def test_last_face_stays_within_a_millimetre_of_a_corner():
    assert geometry.face(np.array([0.06, 0.0492]), 1) == 1  # on +x, 0.8 mm from the corner to +y
    assert geometry.face(np.array([0.06, 0.0488]), 1) == 0  # 1.2 mm from it
    assert geometry.face(np.array([0.06, 0.0492]), -1) == 0  # no last face


def touch(side, force=1.0, along=0.0, box=(0.02, -0.01, 0.7)):
    """A state whose pusher touches a side of the box, `along` m from the side's middle."""
    normal = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[side]
    local = normal * (HALF_BOX + task.RADIUS) + along * normal[::-1]
    cos, sin = np.cos(box[2]), np.sin(box[2])
    pusher = np.array(box[:2]) + np.array([[cos, -sin], [sin, cos]]) @ local
    return np.array([*box, *pusher, force, 0.0])


@pytest.mark.parametrize("episode, switches", [
    ([touch(0, force=0)], 0),  # never in contact
    ([touch(2), touch(2, along=0.03)], 0),  # the first contact is none, and neither is a slide along a side
    ([touch(2), touch(1, force=0), touch(2)], 0),  # passing another side without force
    ([touch(2), touch(1, force=0), touch(1), touch(1), touch(3), touch(2)], 3),
    ([touch(0), touch(1, along=0.0595), touch(0)], 0),  # around the corner and back
    ([touch(0), touch(1, along=0.0595), touch(1, along=0.05)], 1),
])
def test_contact_switches(episode, switches):
    assert geometry.contact_switches(np.array(episode)) == switches
