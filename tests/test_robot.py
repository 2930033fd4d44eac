"""Stage 06 and its parts: kinematics, QP, tags, camera, the simulated arm, and every fault that must stop it."""
import importlib
import itertools
import json
import re
import sys
import threading
import time

import cv2
import numpy as np
import pytest
import qpsolvers
import torch

from common import artifacts, belief, networks, simulator, stacks, symmetry, task
from common.robot import hardware, iiwa, ik, safety, scene, tags

STILL = hardware.Gaps(latency=0, hand_eye_mm=0, hand_eye_deg=0, servo_lag=0, tool_mass=0, force_bias=0, force_noise=0)
UNUSED = itertools.count(1000)  # seeds
DYNAMICS = {"mass": 3.2, "mu_static": 0.4, "mu_dynamic": 0.2, "mu_pusher": 0.2, "restitution": 0.3}


def placed(gaps=STILL, box=(0.0, 0.0, 0.0), pusher=(-0.1, 0.0), hand=(np.inf, np.inf), seed=0):
    arm = hardware.SimulatedArm(gaps)
    dynamics = {name: np.array([value]) for name, value in DYNAMICS.items()}
    arm.place(np.random.default_rng(seed), np.array(box, float), np.array(pusher, float), dynamics, hand)
    return arm


# The arm's kinematics


def rpy(roll, pitch, yaw):
    return cv2.Rodrigues(np.array([0, 0, yaw], float))[0] @ cv2.Rodrigues(np.array([0, pitch, 0], float))[0] @ cv2.Rodrigues(
        np.array([roll, 0, 0], float))[0]


def test_the_flange_is_where_the_urdf_says():
    h = np.pi / 2  # iiwa14 of iiwa_stack: origin (xyz, rpy) of each joint, all about their own z; the last link 0.045
    joints = [((0, 0, 0.1575), (0, 0, 0)), ((0, 0, 0.2025), (h, 0, 2 * h)), ((0, 0.2045, 0), (h, 0, 2 * h)),
              ((0, 0, 0.2155), (h, 0, 0)), ((0, 0.1845, 0), (-h, 2 * h, 0)), ((0, 0, 0.2155), (h, 0, 0)),
              ((0, 0.081, 0), (-h, 2 * h, 0))]
    for q in np.random.default_rng(0).uniform(-1, 1, (20, 7)) * iiwa.LIMITS:
        turn, point = iiwa.FACING, iiwa.BASE
        for (xyz, angles), angle in zip(joints, q):
            point, turn = point + turn @ xyz, turn @ rpy(*angles) @ rpy(0, 0, angle)
        _, points, rotation = iiwa.chain(q)
        assert np.allclose(rotation, turn, atol=1e-12)
        assert np.allclose(points[7], point + (0.045 + iiwa.TOOL) * turn[:, 2], atol=1e-12)


def test_the_jacobian_is_the_derivative():
    for q in np.random.default_rng(1).uniform(-1, 1, (20, 7)) * iiwa.LIMITS:
        j, d = iiwa.jacobian(*iiwa.chain(q)[:2]), 1e-6
        for i in range(7):
            (_, a, ra), (_, b, rb) = (iiwa.chain(q + side * d * np.eye(7)[i]) for side in (-1, 1))
            assert np.allclose(j[:3, i], (b - a)[7] / (2 * d), atol=1e-8)
            turn = (rb @ ra.T - ra @ rb.T) / (4 * d)  # the cross product with the angular velocity
            assert np.allclose(j[3:, i], turn[[2, 0, 1], [1, 2, 0]], atol=1e-8)


def test_the_whole_workspace_is_within_reach_ten_degrees_from_any_joint_limit():
    for x in np.linspace(-1, 1, 7):
        for y in np.linspace(-1, 1, 5):
            q = iiwa.joints_at([x, y] * (task.HALF + ik.MARGIN))
            _, points, rotation = iiwa.chain(q)
            assert np.allclose(points[7], [*([x, y] * (task.HALF + ik.MARGIN)), iiwa.HEIGHT], atol=1e-8)
            assert np.allclose(rotation, iiwa.DOWN, atol=1e-7) and (np.abs(q) < iiwa.LIMITS - np.deg2rad(10)).all()
    with pytest.raises(ValueError):
        iiwa.joints_at([0.0, 2.0])


# The quadratic program


def test_the_program_holds_what_it_says():
    q, v = iiwa.joints_at([0.1, -0.05]), np.array([0.03, -0.02])
    problem, j = ik.build(q, v), iiwa.jacobian(*iiwa.chain(q)[:2])
    p, g = problem.P.toarray(), problem.G.toarray()
    assert np.allclose(p, p.T) and np.linalg.eigvalsh(p).min() > 0.01
    assert np.allclose(problem.A.toarray(), j[2:5]) and np.allclose(problem.b, 0, atol=1e-7)
    assert np.allclose(g[:7], np.eye(7)) and np.allclose(g[14:16], j[:2]) and np.isfinite(problem.h).all()
    assert np.allclose(j[:2] @ ik.solve(q, v), v, atol=2e-5)


@pytest.mark.parametrize("speed, room", [(1.0, 170.0), (0.07, 4.0)])
def test_no_limit_is_ever_broken(monkeypatch, speed, room):
    """5,000 random ticks of the arm as it is, and 5,000 of a slow one, whose joints may turn by 4 degrees."""
    rng, dt, least = np.random.default_rng(0), 1 / ik.QP_RATE, np.inf
    speeds, limits = speed * iiwa.SPEEDS, iiwa.LIMITS
    monkeypatch.setattr(iiwa, "SPEEDS", speeds)
    for _ in range(50):
        q = iiwa.joints_at(rng.uniform(-1, 1, 2) * task.HALF)
        q = q + rng.uniform(-0.02, 0.02) * np.linalg.svd(iiwa.jacobian(*iiwa.chain(q)[:2]))[2][6]  # turns the elbow only
        top = np.minimum(limits, np.abs(q) + np.deg2rad(room))
        monkeypatch.setattr(iiwa, "LIMITS", top)
        for tick in range(100):
            if tick % 50 == 0:
                velocity = rng.uniform(-1, 1, 2) * task.MAX_SPEED
            qd = ik.solve(q, velocity)
            qd = np.zeros(7) if qd is None else qd
            assert (np.abs(qd) <= speeds + 1e-6).all()
            q, least = q + dt * qd, min(least, (speeds - np.abs(qd)).min())
            assert (np.abs(q) <= top).all()
            assert (np.abs(iiwa.chain(q)[1][7, :2]) <= task.HALF + ik.MARGIN + 1e-5).all()
        monkeypatch.setattr(iiwa, "LIMITS", limits)
    assert speed == 1 or least < 1e-4  # the slow arm's limits were felt


def test_the_pusher_keeps_to_its_path_its_height_and_its_direction():
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1], [1, 1]]) * 0.98 * task.HALF
    q, wanted, misses = iiwa.joints_at(corners[0]), corners[0].copy(), []
    for a, b in zip(corners, corners[1:]):
        velocity = 0.0475 * (b - a) / np.linalg.norm(b - a)
        for _ in range(int(np.linalg.norm(b - a) / 0.0475 * ik.QP_RATE)):
            q, wanted = q + ik.solve(q, velocity) / ik.QP_RATE, wanted + velocity / ik.QP_RATE
            _, points, rotation = iiwa.chain(q)
            assert abs(points[7, 2] - iiwa.HEIGHT) < 1e-4 and -rotation[2, 2] > np.cos(np.deg2rad(0.05))
            misses.append(np.linalg.norm(points[7, :2] - wanted))
    assert np.sqrt(np.mean(np.square(misses))) < 1e-3


def test_a_pusher_at_the_margin_goes_no_further():
    q = iiwa.joints_at([task.HALF[0] + ik.MARGIN - 1e-4, 0.0])
    speeds = ik.solve(q, np.array([0.05, 0.0]))
    assert abs((iiwa.jacobian(*iiwa.chain(q)[:2]) @ speeds)[0]) < 1.1e-3


@pytest.mark.parametrize("q, velocity", [(np.full(7, np.nan), np.zeros(2)), (iiwa.POSTURE, np.array([np.nan, 0.0]))])
def test_what_is_not_a_number_has_no_solution(q, velocity):
    assert ik.solve(q, velocity) is None


def test_an_infeasible_program_has_no_solution(monkeypatch):
    """Joints too slow for the correction of the height."""
    monkeypatch.setattr(iiwa, "SPEEDS", np.full(7, 1e-4))
    q = iiwa.joints_at([0.0, 0.0]) + [0, 0.05, 0, 0, 0, 0, 0]
    assert not qpsolvers.solve_problem(ik.build(q, np.zeros(2)), solver="clarabel").found
    assert ik.solve(q, np.zeros(2)) is None


# Tags and camera


def test_the_camera_and_its_inverse_agree():
    points, rotation = iiwa.chain(iiwa.joints_at([0.05, -0.02]))[1:]
    camera = scene.wrist_camera(points, rotation, np.array([0.001, 0, 0.002, 0.01, 0.02, 0]))
    spots = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 2))
    pixels, depth = camera.project(np.append(spots, np.full((50, 1), 0.07), 1))
    assert (depth > 0.1).all() and np.allclose(camera.on_plane(pixels, 0.07), spots, atol=1e-12)
    h = np.append(spots, np.ones((50, 1)), 1) @ camera.plane(0.07).T
    assert np.allclose(h[:, :2] / h[:, 2:], pixels)
    assert np.allclose(scene.wrist_camera(points, rotation).project(points[7])[0], [319.5, 239.5])  # it looks at the ball


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
    arms = [iiwa.chain(iiwa.joints_at(xy))[1:] for xy in rng.uniform(-1, 1, (50, 2)) * task.HALF]
    for _ in range(images):
        points, rotation = arms[rng.integers(len(arms))]
        away, angle = rng.uniform(-np.pi, np.pi), rng.uniform(-np.pi, np.pi)
        box = np.array([*(points[7, :2] + rng.uniform(0.085, 0.12) * np.array([np.cos(away), np.sin(away)])), angle])
        camera = scene.wrist_camera(points, rotation)
        sight = tags.Tracker().update(scene.photograph(camera, box, points, False, rng), camera)
        if sight.seen is not None:
            errors.append([np.linalg.norm(sight.seen[:2] - box[:2]), abs(task.wrap(sight.seen[2] - box[2]))])
    distance, turn = np.array(errors).T
    assert len(errors) > 0.7 * images
    assert distance.max() < 5e-4 and turn.max() < np.deg2rad(0.3)


def test_a_covered_box_is_not_seen_and_the_last_pose_is_held():
    rng, tracker = np.random.default_rng(0), tags.Tracker()
    points, rotation = iiwa.chain(iiwa.joints_at([-0.09, 0.0]))[1:]
    camera, box = scene.wrist_camera(points, rotation), np.array([0.0, 0.0, 0.3])
    assert tracker.update(scene.photograph(camera, box, points, True, rng), camera).seen is None
    first = tracker.update(scene.photograph(camera, box, points, False, rng), camera)
    assert first.age == 0 and np.abs(first.seen - box).max() < 1e-3
    for age in (1, 2, 3):
        held = tracker.update(scene.photograph(camera, box + [0.01, 0, 0], points, True, rng), camera)
        assert held.age == age and (held.seen == first.seen).all()


def test_a_bad_fit_is_rejected():
    points, rotation = iiwa.chain(iiwa.joints_at([0.0, 0.0]))[1:]
    camera, ids = scene.wrist_camera(points, rotation), np.arange(4)
    pixels, _ = camera.project(np.append(tags.CORNERS[:4], np.full((4, 4, 1), 0.07), 2))
    pose, residual = tags.fit(pixels, ids, camera)
    assert np.abs(pose).max() < 1e-9 and residual < 1e-9
    assert tags.fit(pixels, ids[::-1], camera)[1] > tags.RESIDUAL
    points[7, 2] += 0.05  # a camera higher than believed
    assert tags.fit(camera.project(np.append(tags.CORNERS, np.full((12, 4, 1), 0.07), 2))[0], np.arange(12),
                    scene.wrist_camera(points, rotation))[1] > tags.RESIDUAL


# The simulated arm


def drive(arm, velocity, ticks):
    for _ in range(ticks * 10):
        arm.command(ik.solve(arm.read_joints()[1], np.array(velocity)))
        yield arm.read_wrench()[1]


def test_the_arm_pushes_the_box_as_the_training_world_does():
    """The same push at 150 steps a second and at 15, to a millimetre and a degree."""
    for offset in (-0.02, 0.0, 0.03):
        arm, worlds = placed(pusher=(-0.08, offset)), simulator.Worlds(1)
        worlds.place(np.arange(1), np.zeros((1, 3)), np.array([[-0.08, offset]]), {k: np.array([v]) for k, v in DYNAMICS.items()})
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
    points = arm.points.copy()
    list(drive(arm, (0.0, 0.05), 1))
    taken, image = arm.grab()
    assert np.isclose(taken, 2 / 15) and np.isclose(arm.time, 3 / 15)
    expected = scene.render(scene.wrist_camera(points, iiwa.DOWN), arm.box, points)
    assert np.abs(cv2.GaussianBlur(image, (0, 0), 5).astype(int) - cv2.GaussianBlur(expected, (0, 0), 5)).mean() < 1.5


def test_hand_eye_error_shifts_what_is_seen():
    arm = placed(hardware.Gaps(**vars(STILL) | {"hand_eye_mm": 5.0}))
    sight = tags.Tracker().update(arm.grab()[1], scene.wrist_camera(arm.points, arm.rotation))
    assert 1e-3 < np.linalg.norm(sight.seen[:2]) < 0.02
    assert np.allclose(sight.seen[:2], -(arm.rotation @ arm.error[:3])[:2], atol=3e-3)


def test_the_hand_comes_and_goes():
    arm = placed(hand=(0.1, 0.2))
    covered = [arm.covered for _ in drive(arm, (0.0, 0.0), 4)]
    assert not covered[0] and covered[15] and not covered[-1]


# Stage 06 itself


@pytest.fixture(scope="module")
def nets(tmp_path_factory):
    """A root with an untrained estimator and policy, as stages 03 and 04 leave them."""
    out = tmp_path_factory.mktemp("robot") / "runs"
    cfg = artifacts.Stage(preset="smoke", out=out)
    for stage, method, name, save, net in (
            ("03_train_estimator", "ours", "estimator.safetensors", networks.save_estimator, networks.Estimator((16, 16, 16))),
            ("04_train_policy", "est_uncertainty", "policy.safetensors", networks.save_recurrent, networks.policy(12, (16, 16, 16)))):
        run = artifacts.Run(cfg, stage, {}, method)
        save(run.dir / name, net)
        run.finish([name])
    return out


@pytest.fixture
def robot(nets, monkeypatch, capsys):
    """Runs 06 in this process; returns stdout, stderr, the exit code and the run's folder."""
    def of(*args, seed=None):
        seed = str(next(UNUSED) if seed is None else seed)
        monkeypatch.setattr(sys, "argv", ["06_robot.py", "smoke", "--out", str(nets), "--seed", seed, *args])
        module, code = importlib.import_module("06_robot"), 0
        try:
            artifacts.main(module.Config, module.PRESETS, module.main, module.__doc__)
        except SystemExit as end:
            code = end.code
        return *capsys.readouterr(), code, nets / "smoke" / "06_robot" / f"seed{seed}"
    return of


def mistakes(stderr):
    """Lines that tell one; the others are the progress bar's."""
    return [line for line in stderr.splitlines() if line.startswith("error: ")]


class Faulty(hardware.SimulatedArm):
    """After 25 steps of a run something goes wrong. `last` is the arm that was made last."""

    steps, wrong = 0, False

    def __init__(self, gaps):
        super().__init__(gaps)
        Faulty.last, self.commands = self, []

    def command(self, velocity):
        super().command(velocity)
        self.commands.append(np.array(velocity))
        self.wrong = len(self.commands) > 25


class JointsNaN(Faulty):
    def read_joints(self):
        return self.time, self.joints * (np.nan if self.wrong else 1)


class WrenchNaN(Faulty):
    def read_wrench(self):
        time, force = super().read_wrench()
        return time, force * [1, np.nan if self.wrong else 1, 1]


class ImageTimeNaN(Faulty):
    def grab(self):
        time, image = super().grab()
        return (np.nan if self.wrong else time), image


class CameraFrozen(Faulty):
    kept = None

    def grab(self):
        time, image = super().grab()
        self.kept = image if self.kept is None or not self.wrong else self.kept
        return time, self.kept


class CameraStuck(Faulty):
    def grab(self):
        time, image = super().grab()
        return min(time, 0.1), image


class CameraGone(Faulty):
    def grab(self):
        time, image = super().grab()
        return time, None if self.wrong else image


class WrenchOld(Faulty):
    def read_wrench(self):
        time, force = super().read_wrench()
        return min(time, 0.1), force


class Forced(Faulty):
    def read_wrench(self):
        time, force = super().read_wrench()
        return time, force + [45.0 * self.wrong, 0, 0]


class JointAtLimit(Faulty):
    def read_joints(self):
        return self.time, np.where([0, 0, 0, self.wrong, 0, 0, 0], -iiwa.LIMITS, self.joints)


class Beyond(Faulty):
    def read_joints(self):
        return self.time, iiwa.joints_at([0.32, 0.0]) if self.wrong else self.joints.copy()


class JointsOld(Faulty):
    def read_joints(self):
        return min(self.time, 0.1), self.joints.copy()


class Lifted(Faulty):
    def read_joints(self):
        return self.time, self.joints - [0, 0.02 * self.wrong, 0, 0, 0, 0, 0]


class Broken(Faulty):
    def read_wrench(self):
        if self.wrong:
            raise BrokenPipeError("the driver is gone")
        return super().read_wrench()


class CtrlC(Faulty):
    def grab(self):
        if self.wrong:
            raise KeyboardInterrupt
        return super().grab()


FAULTS = {JointsNaN: "joint angles", WrenchNaN: "wrench", ImageTimeNaN: "camera", CameraFrozen: "frozen",
          CameraStuck: "camera: the newest is", CameraGone: "no image", WrenchOld: "wrench: the newest is", Forced: "over 40 N",
          JointAtLimit: "joint 4 is at its limit", Beyond: "beyond the border", JointsOld: "s old",
          Lifted: "above its height", Broken: "BrokenPipeError in test_robot.py", CtrlC: "Ctrl-C"}


def stopped_for_good(arm):
    before = arm.joints.copy()
    arm.command(np.full(7, 0.1))
    return arm.stopped and not arm.speeds.any() and (arm.joints == before).all()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_every_fault_stops_the_arm(robot, fault):
    stdout, stderr, code, folder = robot("--arm", f"{__name__}:{fault.__name__}", "--scenario", "natural")
    assert code == 2 and len(mistakes(stderr)) == 1 and "Traceback" not in stderr
    assert mistakes(stderr)[0].startswith("error: arm stopped: ") and FAULTS[fault] in stderr
    assert stopped_for_good(Faulty.last)
    if fault is CtrlC:  # played again
        assert not list(folder.glob("*.npz"))
    else:
        assert json.loads((folder / "summary.json").read_text())["natural"]["stops"] == 1


def test_an_arm_whose_programs_are_not_solved_stands_still_and_then_stops(robot, monkeypatch):
    solve = ik.solve
    monkeypatch.setattr(ik, "solve", lambda q, v: None if Faulty.last.wrong else solve(q, v))
    _, stderr, code, _ = robot("--arm", f"{__name__}:Faulty", "--scenario", "natural")
    assert code == 2 and "3 programs in a row were not solved" in stderr
    assert [command.any() for command in Faulty.last.commands[-3:]] == [True, False, False]
    assert stopped_for_good(Faulty.last)


def test_an_estimate_that_is_not_finite_stops_the_arm(robot, monkeypatch):
    monkeypatch.setattr(belief, "believe", lambda *args: (np.full((1, 12), np.nan, np.float32), None))
    _, stderr, code, _ = robot("--arm", f"{__name__}:Faulty", "--scenario", "natural")
    assert code == 2 and "the estimate is not finite" in stderr and stopped_for_good(Faulty.last)


def test_a_box_that_is_never_seen_ends_the_run_with_one_line(robot, monkeypatch):
    module = importlib.import_module("06_robot")
    prepare = module.prepare

    def hidden(arm, *args):
        prepare(arm, *args)
        arm.hand = (0.0, np.inf)
        arm.past.clear(), arm.remember()
        return arm.hand

    monkeypatch.setattr(module, "prepare", hidden)
    stdout, _, code, folder = robot("--scenario", "natural")
    assert code == 0 and "natural_000: box not seen for 5 s" in stdout
    assert np.load(folder / "natural_000.npz")["ended"] == "box not seen for 5 s"
    assert json.loads((folder / "summary.json").read_text())["natural"]["tick_p99_ms"] is None


def test_a_run_goes_on_after_a_stop_and_counts_it(robot):
    assert robot("--scenario", "natural", "--runs", "2", "--arm", f"{__name__}:Broken", seed=7)[2] == 2
    Broken.read_wrench, broken = Faulty.read_wrench, Broken.read_wrench
    try:
        _, _, code, folder = robot("--scenario", "natural", "--runs", "2", "--arm", f"{__name__}:Broken", seed=7)
    finally:
        Broken.read_wrench = broken
    row = json.loads((folder / "summary.json").read_text())["natural"]
    assert code == 0 and row["stops"] == 1 and row["runs"] == 2


def test_leaving_the_workspace_ends_a_run_and_the_next_begins(robot, monkeypatch):
    monkeypatch.setattr(networks, "mode", lambda logits: torch.tensor([[10, 10]]))
    monkeypatch.setattr(symmetry, "mirror_action", lambda action, sign: action)
    _, _, code, folder = robot("--scenario", "natural", "--runs", "2")
    logs = [np.load(folder / f"natural_{k:03d}.npz") for k in range(2)]
    assert code == 0 and all(log["ended"] == "out of the workspace" for log in logs)
    assert not json.loads((folder / "summary.json").read_text())["natural"]["stops"]


def test_a_run_is_logged_and_filmed_and_its_film_can_be_the_camera(robot, nets):
    stdout, _, code, folder = robot("--scenario", "hand_5s", "--video", seed=3)
    assert code == 0 and "hand_5s" in stdout
    log = np.load(folder / "hand_5s_000.npz")
    ticks = len(log["time"])
    assert {"time", "joints", "true", "seen", "estimated", "sigma", "force", "action", "unsolved", "busy", "age"} <= set(log)
    assert np.allclose(np.diff(log["time"]), 1 / task.RATE) and np.isfinite(log["sigma"]).all() and not log["unsolved"].any()
    assert log["joints"].shape == (ticks, 7) and log["true"].shape == log["seen"].shape == (ticks, 3)
    summary = json.loads((folder / "summary.json").read_text())["hand_5s"]
    assert summary.keys() >= {"successes", "runs", "low", "high", "occluded_share", "tick_p99_ms", "stops"}
    assert np.isclose(summary["occluded_share"], (log["age"] > 0).mean())
    covered = np.flatnonzero(log["covered"])
    assert not covered.size or task.RATE <= covered[0] <= 5 * task.RATE + 1 and len(covered) in (75, ticks - covered[0])
    seen = log["age"] == 0
    assert np.linalg.norm((log["seen"] - log["true"])[seen, :2], axis=1).max() < 0.012  # latency and hand-eye error

    film = folder / "hand_5s_000_camera.mp4"
    camera, tracker, misses = hardware.VideoCamera(str(film), lambda: 0.0, 0.0), tags.Tracker(), []
    for tick in range(ticks):
        _, image = camera.grab()
        joints = log["joints"][max(tick - 1, 0)]
        sight = tracker.update(image, scene.wrist_camera(*iiwa.chain(joints)[1:]))
        if log["age"][tick] == 0 and sight.age == 0 and tick:
            misses.append(np.linalg.norm(sight.seen[:2] - log["seen"][tick, :2]))
    assert np.median(misses) < 1e-3 and camera.grab()[1] is None

    film.rename(film := nets / "film.mp4")
    _, stderr, code, _ = robot("--scenario", "hand_5s", "--camera", str(film), "--force", seed=3)
    again = np.load(folder / "hand_5s_000.npz")
    assert code == 2 and "camera: no image" in mistakes(stderr)[0]  # the film lacks the first look
    assert len(again["time"]) >= ticks - 3 and np.linalg.norm((again["true"] - log["true"][:len(again["true"])])[:20, :2]).max() < 2e-3


def test_a_damaged_log_is_named(robot):
    folder = robot("--scenario", "natural", seed=22)[3]
    (folder / "natural_000.npz").write_bytes(b"")
    _, stderr, code, _ = robot("--scenario", "natural", seed=22)
    assert code == 2 and len(mistakes(stderr)) == 1 and "natural_000.npz is damaged: delete it" in stderr


@pytest.mark.parametrize("args, words", [(("--latency", "inf"), "finite"), (("--arm", "json:loads"), "TypeError"),
                                         (("--camera", "nothing.mp4"), "cannot open"), (("--arm", "nothing:Arm"), "module:Class"),
                                         (("--arm", "nothing"), "module:Class"), (("--runs", "0"), "at least 1")])
def test_mistakes_are_one_line(robot, args, words):
    _, stderr, code, _ = robot(*args)
    assert code == 2 and len(mistakes(stderr)) == 1 and words in stderr and "Traceback" not in stderr


def test_the_tags_can_be_printed_before_anything_is_trained(robot, nets):
    stdout, _, code, _ = robot("--print-tags")
    assert code == 0 and (nets / "tags.pdf").stat().st_size > 2_000


def test_the_same_seed_plays_the_same_run(robot):
    folder = robot("--scenario", "natural", seed=11)[3]
    first = dict(np.load(folder / "natural_000.npz"))
    robot("--scenario", "natural", "--force", seed=11)
    again = np.load(folder / "natural_000.npz")
    assert all((first[key] == again[key]).all() for key in ("joints", "true", "seen", "action"))


class Driver:
    """A SimulatedArm that the program does not know for one."""

    def __init__(self, config):
        self.simulated = placed(box=(0.0, 0.03, 0.2), pusher=(-0.09, 0.0))
        for name in ("read_joints", "read_wrench", "grab", "command", "stop"):
            setattr(self, name, getattr(self.simulated, name))


@pytest.fixture
def at_once(monkeypatch):
    """A real arm's program does not sleep."""
    pacer = hardware.pacer
    monkeypatch.setattr(hardware, "pacer", lambda on: pacer(False))


def test_the_guard_itself_refuses_after_a_stop():
    driver = Driver(None)
    driver.stop, guard = lambda: 1 / 0, safety.Guarded(driver)
    with pytest.raises(safety.Stop, match=r"own stop\(\) failed \(ZeroDivisionError.*arm stopped: a reason"), guard:
        guard.stop("a reason")
    with pytest.raises(safety.Stop, match="arm stopped: a reason"):
        guard.command(np.zeros(7))


def test_a_real_arm_is_judged_by_the_estimate(robot, monkeypatch, at_once):
    asked = []
    monkeypatch.setattr("builtins.input", asked.append)
    monkeypatch.setattr(task, "reached", lambda box: True)
    stdout, _, code, folder = robot("--arm", f"{__name__}:Driver", "--scenario", "hand_5s", "--video")
    log = np.load(folder / "hand_5s_000.npz")
    assert len(log["time"]) == 5 and log["ended"] == "success by estimate" and np.isnan(log["true"]).all()
    assert len(asked) == 1 and "1/1 by estimate" in stdout and (folder / "robot.png").exists()


def test_a_real_arms_helper_is_told_when_to_cover_the_tags(robot, monkeypatch, at_once):
    monkeypatch.setattr("builtins.input", lambda words: None)
    monkeypatch.setattr(task, "outside", lambda box, pusher: False)
    monkeypatch.setattr(networks, "mode", lambda logits: torch.full((1, 2), 5))
    stdout, _, _, folder = robot("--arm", f"{__name__}:Driver", "--scenario", "hand_5s")
    assert stdout.index("now cover the tags") < stdout.index("now uncover the tags")
    assert len(np.load(folder / "hand_5s_000.npz")["time"]) == task.HORIZON


def test_a_real_arm_needs_someone_at_the_terminal(robot, monkeypatch):
    monkeypatch.setattr(sys, "stdin", open("/dev/null"))
    _, stderr, code, _ = robot("--arm", f"{__name__}:Driver")
    assert code == 2 and len(mistakes(stderr)) == 1 and "terminal" in stderr


def test_the_pacer_keeps_the_rate_and_makes_up_for_a_late_step():
    wait, began = hardware.pacer(True), time.perf_counter()
    for step in range(30):
        if step == 10:
            time.sleep(0.03)
        wait()
    assert 0.2 <= time.perf_counter() - began < 0.25 and 0.1 < wait.slept < 0.18


def test_a_live_camera_never_makes_the_arm_wait(monkeypatch):
    class Blocking:
        """Two images, then none for ever."""

        def __init__(self, source):
            self.images = 0

        def isOpened(self):
            return True

        def set(self, *setting):
            pass

        def read(self):
            self.images += 1
            if self.images > 2:
                threading.Event().wait()
            return True, np.full((480, 640, 3), self.images, np.uint8)

    monkeypatch.setattr(cv2, "VideoCapture", Blocking)
    clock = itertools.count()
    camera = hardware.VideoCamera("0", lambda: float(next(clock)), 0.5)
    time.sleep(0.1)
    assert all(camera.grab()[0] == 0.5 for _ in range(3)) and camera.grab()[1][0, 0, 0] == 2


@pytest.mark.parametrize("corner", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_the_program_thinks_as_the_training_stack_does(corner, float32):
    """The same observations, estimates and actions as Mirrored, Believed and the policy."""
    torch.manual_seed(1)
    f, pi = networks.Estimator((16, 16, 16), dropout=0.0).requires_grad_(False), networks.policy(12, (16, 16, 16))
    torch.nn.init.normal_(pi.head[-1].weight)
    env, think = stacks.make("est_uncertainty", 1, f, 1), importlib.import_module("06_robot").think
    start = {"box": [0.1 * corner[0], 0.04 * corner[1], 0.5], "pusher": [0.1 * corner[0], -0.08 * corner[1]]}
    obs, infos = env.reset(seed=0, options=start)
    memory = recall = None
    for _ in range(20):
        o = infos["o"][0]
        row = {"seen": task.unscale_pose(o[:4]), "age": o[8], "pusher": o[4:6] * task.HALF, "force": o[6:8] * task.MAX_FORCE}
        s_hat, action, memory = think(f, pi, 1, row, memory)
        assert np.allclose(s_hat, symmetry.mirror(infos["belief"], env.env.sign)[0], atol=1e-4)
        with torch.no_grad():
            logits, recall = pi(torch.as_tensor(obs)[None], recall)
        mirrored = networks.mode(logits[0]).numpy()
        assert (symmetry.mirror_action(mirrored, env.env.sign)[0] == action).all()
        obs, _, _, _, infos = env.step(mirrored)


def test_a_mistake_does_not_keep_the_right_command_from_starting(robot):
    assert robot("--camera", "nothing.mp4", "--scenario", "natural", seed=21)[2] == 2
    assert robot("--scenario", "natural", seed=21)[2] == 0
    stdout, _, code, folder = robot("--scenario", "hand_full", "--runs", "2", seed=21)
    assert code == 0 and {path.stem for path in folder.glob("*.npz")} == {"natural_000", "hand_full_000", "hand_full_001"}
