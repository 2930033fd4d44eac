"""The parts of stage 06: kinematics, QP, tags, camera, the simulated arm."""
from dataclasses import replace

import cv2
import numpy as np
import pytest
import qpsolvers
from robot_arms import STILL, placed
from six_joints import SIX

from common import simulator, task
from common.robot import hardware, ik, scene, tags
from common.robot.iiwa import IIWA

# The arm's kinematics


def rpy(roll, pitch, yaw):
    return cv2.Rodrigues(np.array([0, 0, yaw], float))[0] @ cv2.Rodrigues(np.array([0, pitch, 0], float))[0] @ cv2.Rodrigues(
        np.array([roll, 0, 0], float))[0]


def test_the_flange_is_where_the_urdf_says():
    h = np.pi / 2  # iiwa14 of iiwa_stack: origin (xyz, rpy) of each joint, all about their own z; the last link 0.045
    joints = [((0, 0, 0.1575), (0, 0, 0)), ((0, 0, 0.2025), (h, 0, 2 * h)), ((0, 0.2045, 0), (h, 0, 2 * h)),
              ((0, 0, 0.2155), (h, 0, 0)), ((0, 0.1845, 0), (-h, 2 * h, 0)), ((0, 0, 0.2155), (h, 0, 0)),
              ((0, 0.081, 0), (-h, 2 * h, 0))]
    for q in np.random.default_rng(0).uniform(-1, 1, (20, 7)) * IIWA.limits:
        turn, point = IIWA.facing, IIWA.base
        for (xyz, angles), angle in zip(joints, q):
            point, turn = point + turn @ xyz, turn @ rpy(*angles) @ rpy(0, 0, angle)
        _, points, rotation = IIWA.chain(q)
        assert np.allclose(rotation, turn, atol=1e-12)
        assert np.allclose(points[-1], point + (0.045 + 0.25) * turn[:, 2], atol=1e-12)


def test_the_jacobian_is_the_derivative(model):
    n = len(model.limits)
    for q in np.random.default_rng(1).uniform(-1, 1, (20, n)) * model.limits:
        j, d = model.jacobian(*model.chain(q)[:2]), 1e-6
        for i in range(n):
            (_, a, ra), (_, b, rb) = (model.chain(q + side * d * np.eye(n)[i]) for side in (-1, 1))
            assert np.allclose(j[:3, i], (b - a)[-1] / (2 * d), atol=1e-8)
            turn = (rb @ ra.T - ra @ rb.T) / (4 * d)  # the cross product with the angular velocity
            assert np.allclose(j[3:, i], turn[[2, 0, 1], [1, 2, 0]], atol=1e-8)


def test_the_whole_workspace_is_within_reach_ten_degrees_from_any_joint_limit(model):
    for x in np.linspace(-1, 1, 7):
        for y in np.linspace(-1, 1, 5):
            q = model.joints_at([x, y] * (task.HALF + ik.MARGIN))
            _, points, rotation = model.chain(q)
            assert np.allclose(points[-1], [*([x, y] * (task.HALF + ik.MARGIN)), model.height], atol=1e-8)
            assert np.allclose(rotation, model.down, atol=1e-7) and (np.abs(q) < model.limits - np.deg2rad(10)).all()
    with pytest.raises(ValueError):
        model.joints_at([0.0, 2.0])


# The quadratic program


def test_the_program_holds_what_it_says(model):
    q, v, n = model.joints_at([0.1, -0.05]), np.array([0.03, -0.02]), len(model.limits)
    problem, j = ik.build(model, q, v), model.jacobian(*model.chain(q)[:2])
    p, g = problem.P.toarray(), problem.G.toarray()
    assert np.allclose(p, p.T) and np.linalg.eigvalsh(p).min() > 0.01
    assert np.allclose(problem.A.toarray(), j[2:5]) and np.allclose(problem.b, 0, atol=1e-7)
    assert np.allclose(g[:n], np.eye(n)) and np.allclose(g[2 * n:2 * n + 2], j[:2]) and np.isfinite(problem.h).all()
    assert np.allclose(j[:2] @ ik.solve(model, q, v), v, atol=2e-5)


@pytest.mark.parametrize("speed, room", [(1.0, 170.0), (0.07, 4.0)])
def test_no_limit_is_ever_broken(model, speed, room):
    """5,000 random ticks of the arm as it is, and 5,000 of a slow one, whose joints may turn by 4 degrees."""
    rng, dt, least = np.random.default_rng(0), 1 / ik.QP_RATE, np.inf
    for _ in range(50):
        q = model.joints_at(rng.uniform(-1, 1, 2) * task.HALF)
        free = np.linalg.svd(model.jacobian(*model.chain(q)[:2]))[2][6:]  # turns the elbow only, where there is one to spare
        q = q + rng.uniform(-0.02, 0.02, len(free)) @ free
        slow = replace(model, speeds=speed * model.speeds, limits=np.minimum(model.limits, np.abs(q) + np.deg2rad(room)))
        for tick in range(100):
            if tick % 50 == 0:
                velocity = rng.uniform(-1, 1, 2) * task.MAX_SPEED
            qd = ik.solve(slow, q, velocity)
            qd = np.zeros(len(q)) if qd is None else qd
            assert (np.abs(qd) <= slow.speeds + 1e-6).all()
            q, least = q + dt * qd, min(least, (slow.speeds - np.abs(qd)).min())
            assert (np.abs(q) <= slow.limits).all()
            assert (np.abs(model.chain(q)[1][-1, :2]) <= task.HALF + ik.MARGIN + 1e-5).all()
    assert speed == 1 or least < 1e-4 or model is SIX  # the slow arm's limits were felt


def test_the_pusher_keeps_to_its_path_its_height_and_its_direction(model):
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1], [1, 1]]) * 0.98 * task.HALF
    q, wanted, misses = model.joints_at(corners[0]), corners[0].copy(), []
    for a, b in zip(corners, corners[1:]):
        velocity = 0.0475 * (b - a) / np.linalg.norm(b - a)
        for _ in range(int(np.linalg.norm(b - a) / 0.0475 * ik.QP_RATE)):
            q, wanted = q + ik.solve(model, q, velocity) / ik.QP_RATE, wanted + velocity / ik.QP_RATE
            _, points, rotation = model.chain(q)
            down = -(rotation @ model.tool / np.linalg.norm(model.tool))[2]
            assert abs(points[-1, 2] - model.height) < 1e-4 and down > np.cos(np.deg2rad(0.05))
            misses.append(np.linalg.norm(points[-1, :2] - wanted))
    assert np.sqrt(np.mean(np.square(misses))) < 1e-3


def test_a_pusher_at_the_margin_goes_no_further(model):
    q = model.joints_at([task.HALF[0] + ik.MARGIN - 1e-4, 0.0])
    speeds = ik.solve(model, q, np.array([0.05, 0.0]))
    assert abs((model.jacobian(*model.chain(q)[:2]) @ speeds)[0]) < 1.1e-3


@pytest.mark.parametrize("q, velocity", [(np.full(7, np.nan), np.zeros(2)), (IIWA.posture, np.array([np.nan, 0.0]))])
def test_what_is_not_a_number_has_no_solution(q, velocity):
    assert ik.solve(IIWA, q, velocity) is None


def test_an_infeasible_program_has_no_solution(model):
    """Joints too slow for the correction of the height."""
    slow = replace(model, speeds=np.full(len(model.limits), 1e-4))
    q = model.joints_at([0.0, 0.0]) + np.eye(len(model.limits))[1] * 0.05
    assert not qpsolvers.solve_problem(ik.build(slow, q, np.zeros(2)), solver="clarabel").found
    assert ik.solve(slow, q, np.zeros(2)) is None


# Tags and camera


def test_the_camera_and_its_inverse_agree(model):
    q = model.joints_at([0.05, -0.02])
    camera = scene.wrist_camera(model, q, np.array([0.001, 0, 0.002, 0.01, 0.02, 0]))
    spots = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 2))
    pixels, depth = camera.project(np.append(spots, np.full((50, 1), 0.07), 1))
    assert (depth > 0.1).all() and np.allclose(camera.on_plane(pixels, 0.07), spots, atol=1e-12)
    h = np.append(spots, np.ones((50, 1)), 1) @ camera.plane(0.07).T
    assert np.allclose(h[:, :2] / h[:, 2:], pixels)
    assert np.allclose(scene.wrist_camera(model, q).project(model.chain(q)[1][-1])[0], [319.5, 239.5])  # it looks at the ball


def test_the_sheet_has_the_tags_where_the_fit_expects_them():
    image = cv2.copyMakeBorder(tags.sheet(), 50, 50, 50, 50, cv2.BORDER_CONSTANT, value=255)
    corners, ids, _ = tags.detector().detectMarkers(image)
    assert sorted(ids.ravel()) == list(range(12))
    for found, i in zip(corners, ids.ravel()):
        expected = (tags.CORNERS[i] * [1, -1] + task.BOX[:2] / 2) * 8000 + 50 - 0.5
        assert np.abs(found[0] - expected).max() < 1


def test_the_printed_sheet_is_at_true_scale(tmp_path):
    tags.print_sheet(tmp_path / "tags.pdf")
    text = (tmp_path / "tags.pdf").read_bytes()
    box = text[text.index(b"/MediaBox"):].split(b"]")[0].split(b"[")[1].split()
    assert np.allclose([float(x) / 72 * 25.4 for x in box], [0, 0, 210, 297], atol=0.2)


def test_the_pose_of_the_box_is_seen_to_half_a_millimetre():
    """2,000 random poses under the camera: accurate where seen, and no flips."""
    rng, errors, images = np.random.default_rng(0), [], 2000
    arms = [IIWA.joints_at(xy) for xy in rng.uniform(-1, 1, (50, 2)) * task.HALF]
    for _ in range(images):
        q = arms[rng.integers(len(arms))]
        points = IIWA.chain(q)[1]
        away, angle = rng.uniform(-np.pi, np.pi), rng.uniform(-np.pi, np.pi)
        box = np.array([*(points[-1, :2] + rng.uniform(0.085, 0.12) * np.array([np.cos(away), np.sin(away)])), angle])
        camera = scene.wrist_camera(IIWA, q)
        sight = tags.Tracker().update(scene.photograph(camera, box, points, False, rng), camera)
        if sight.seen is not None:
            errors.append([np.linalg.norm(sight.seen[:2] - box[:2]), abs(task.wrap(sight.seen[2] - box[2]))])
    distance, turn = np.array(errors).T
    assert len(errors) > 0.7 * images
    assert distance.max() < 5e-4 and turn.max() < np.deg2rad(0.3)


def test_a_covered_box_is_not_seen_and_the_last_pose_is_held():
    rng, tracker = np.random.default_rng(0), tags.Tracker()
    points = IIWA.chain(IIWA.joints_at([-0.09, 0.0]))[1]
    camera, box = scene.wrist_camera(IIWA, IIWA.joints_at([-0.09, 0.0])), np.array([0.0, 0.0, 0.3])
    assert tracker.update(scene.photograph(camera, box, points, True, rng), camera).seen is None
    first = tracker.update(scene.photograph(camera, box, points, False, rng), camera)
    assert first.age == 0 and np.abs(first.seen - box).max() < 1e-3
    for age in (1, 2, 3):
        held = tracker.update(scene.photograph(camera, box + [0.01, 0, 0], points, True, rng), camera)
        assert held.age == age and (held.seen == first.seen).all()


def test_a_bad_fit_is_rejected():
    camera, ids = scene.wrist_camera(IIWA, IIWA.joints_at([0.0, 0.0])), np.arange(4)
    pixels, _ = camera.project(np.append(tags.CORNERS[:4], np.full((4, 4, 1), 0.07), 2))
    pose, residual = tags.fit(pixels, ids, camera)
    assert np.abs(pose).max() < 1e-9 and residual < 1e-9
    assert tags.fit(pixels, ids[::-1], camera)[1] > tags.RESIDUAL
    higher = replace(camera, position=camera.position + [0, 0, 0.05])  # than believed
    assert tags.fit(camera.project(np.append(tags.CORNERS, np.full((12, 4, 1), 0.07), 2))[0], np.arange(12),
                    higher)[1] > tags.RESIDUAL


# The simulated arm


def drive(arm, velocity, ticks):
    for _ in range(ticks * 10):
        arm.command(ik.solve(arm.model, arm.read_joints()[1], np.array(velocity)))
        yield arm.read_wrench()[1]


def test_the_arm_pushes_the_box_as_the_training_world_does():
    """The same push at 150 steps a second and at 15, to a millimetre and a degree."""
    for offset in (-0.02, 0.0, 0.03):
        arm, worlds = placed(pusher=(-0.08, offset)), simulator.Worlds(1)
        worlds.place(np.arange(1), np.zeros((1, 3)), np.array([[-0.08, offset]]), arm.worlds.dynamics)
        for _ in range(30):
            list(drive(arm, (0.05, 0.0), 1))
            worlds.step(np.array([[0.05, 0.0]]))
        assert np.linalg.norm(arm.box[:2] - worlds.box[0, :2]) < 1e-3
        assert abs(arm.box[2] - worlds.box[0, 2]) < np.deg2rad(1)


def test_the_force_sensor_feels_friction_against_the_push_in_the_tool_frame():
    arm = placed(pusher=(-0.08, 0.0))
    forces = [arm.rotation @ force for force in drive(arm, (0.05, 0.0), 30)]
    felt = np.mean(forces[-100:], 0)
    assert np.allclose(felt, [-0.2 * 3.2 * 9.81, 0, 0], atol=0.5)


def test_the_force_sensor_feels_the_tools_inertia():
    arm = placed(hardware.Gaps(**vars(STILL) | {"tool_mass": 0.5, "servo_lag": 0.02}), pusher=(-0.25, 0.0))
    forces = np.array([arm.rotation @ force for force in drive(arm, (0.05, 0.0), 3)])
    change = -0.5 * 0.05 * ik.QP_RATE  # the whole impulse is the change of momentum
    assert np.isclose(forces[:, 0].sum(), change, rtol=0.02) and forces[0, 0] == forces[:, 0].min()


def test_the_servo_lags():
    arm = placed(hardware.Gaps(**vars(STILL) | {"servo_lag": 0.02}))
    speeds, before = np.full(7, 0.1), arm.joints
    for _ in range(3):
        arm.command(speeds)
    assert np.allclose(arm.speeds, 0.1 * (1 - np.exp(-3 / ik.QP_RATE / 0.02)))
    arm = placed(STILL)
    arm.command(speeds)
    assert np.allclose(arm.joints - before, 0.1 / ik.QP_RATE)


def test_the_camera_is_a_frame_late_and_says_so():
    arm = placed(hardware.Gaps(**vars(STILL) | {"latency": 1}))
    list(drive(arm, (0.05, 0.0), 2))
    points, q = arm.points.copy(), arm.joints
    list(drive(arm, (0.0, 0.05), 1))
    taken, image = arm.grab()
    assert np.isclose(taken, 2 / 15) and np.isclose(arm.time, 3 / 15)
    expected = scene.render(scene.wrist_camera(IIWA, q), arm.box, points)
    assert np.abs(cv2.GaussianBlur(image, (0, 0), 5).astype(int) - cv2.GaussianBlur(expected, (0, 0), 5)).mean() < 1.5


@pytest.mark.parametrize("latency", [0, 0.5, 1, 1.5, 2])
@pytest.mark.parametrize("before", [0, 4, 6])
def test_an_image_that_was_begun_ahead_is_the_one_that_is_due(latency, before):
    arm, slow = placed(hardware.Gaps(**vars(STILL) | {"latency": latency})), np.full(7, 0.01)
    for _ in range(4):  # from the start on, where the camera has not seen as much as it is late
        for step in range(ik.STEPS):
            if step == before:
                arm.look_ahead()
            arm.command(slow)
        (begun, coming), (taken, image) = arm.coming, arm.grab()
        assert taken == arm.past[0][0]
        known = ik.STEPS - before <= round(latency * ik.STEPS)
        assert known == (begun == taken and image is coming.result())
    for _ in range(ik.STEPS):
        arm.command(slow)
    assert arm.grab()[0] == arm.past[0][0] != taken


def test_a_run_shows_no_image_of_the_last_one():
    arm = placed(hardware.Gaps(**vars(STILL) | {"latency": 1}))
    arm.look_ahead()
    _, last = arm.coming
    arm.place(np.random.default_rng(1), np.array([0.1, 0.0, 0.0]), np.array([-0.1, 0.0]), {})
    taken, image = arm.grab()
    assert taken == 0 and image is not last.result()


def test_hand_eye_error_shifts_what_is_seen():
    arm = placed(hardware.Gaps(**vars(STILL) | {"hand_eye_mm": 5.0}))
    sight = tags.Tracker().update(arm.grab()[1], scene.wrist_camera(arm.model, arm.joints))
    assert 1e-3 < np.linalg.norm(sight.seen[:2]) < 0.02
    assert np.allclose(sight.seen[:2], -(arm.rotation @ arm.error[:3])[:2], atol=3e-3)


def test_the_hand_comes_and_goes():
    arm = placed(hand=(0.1, 0.2))
    covered = [arm.covered for _ in drive(arm, (0.0, 0.0), 4)]
    assert not covered[0] and covered[15] and not covered[-1]
