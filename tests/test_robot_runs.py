"""Stage 06: its runs, every fault that must stop the arm, and a real arm's driver."""
import importlib
import itertools
import json
import sys
import threading
import time

import cv2
import numpy as np
import pytest
import torch
from six_joints import SIX
from test_robot import placed

from common import belief, command, networks, runs, stacks, symmetry, task, weights
from common.robot import controller, hardware, ik, safety, scene, tags
from common.robot.iiwa import IIWA

@pytest.fixture(scope="module")
def nets(tmp_path_factory):
    """A root with an untrained estimator and policy, as stages 03 and 04 leave them."""
    torch.manual_seed(2)  # some untrained nets drive the box to where its film cannot be tracked anew
    out = tmp_path_factory.mktemp("robot") / "runs"
    cfg = command.Stage(preset="smoke", out=out)
    for stage, method, name, net in (
            ("03_train_estimator", "ours", "estimator.safetensors", networks.Estimator((16, 16, 16))),
            ("04_train_policy", "est_uncertainty", "policy.safetensors", networks.policy(12, (16, 16, 16)))):
        run = runs.Run(cfg, stage, {}, method)
        weights.save(run.dir / name, net)
        run.finish([name])
    return out


@pytest.fixture
def robot(nets, call):
    """Runs 06 in this process; returns stdout, stderr, the exit code and the run's folder."""
    def of(*args, seed=None):
        done = nets / "smoke" / "06_robot"
        seed = str(1000 + len([*done.glob("*")]) if seed is None else seed)  # unused, and the same whatever other files ran before
        return *call(nets, "06_robot", "--seed", seed, *args), done / f"seed{seed}"
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
        return self.time, np.where(self.wrong * (np.arange(len(self.joints)) == 3), -self.model.limits, self.joints)


class Beyond(Faulty):
    def read_joints(self):
        return self.time, self.model.joints_at([0.32, 0.0]) if self.wrong else self.joints.copy()


class TooFast(Faulty):
    def read_joints(self):
        last = np.arange(len(self.joints)) == len(self.joints) - 1
        return self.time, self.joints + 1.2 * self.wrong * last * self.model.speeds / ik.QP_RATE


class JointsOld(Faulty):
    def read_joints(self):
        return min(self.time, 0.1), self.joints.copy()


class Lifted(Faulty):
    def read_joints(self):
        return self.time, self.joints - 0.02 * self.wrong * (np.arange(len(self.joints)) == 1)


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
          TooFast: "is over its speed",
          Lifted: "above its height", Broken: "BrokenPipeError in test_robot_runs.py", CtrlC: "Ctrl-C"}


def stopped_for_good(arm):
    before = arm.joints.copy()
    arm.command(np.full(7, 0.1))
    return arm.stopped and not arm.speeds.any() and (arm.joints == before).all()


OF_ANOTHER_ARM = (JointsNaN, JointAtLimit, Beyond, Lifted, TooFast)


@pytest.mark.parametrize("fault, model", [*((fault, IIWA) for fault in FAULTS), *((fault, SIX) for fault in OF_ANOTHER_ARM)],
                         ids=lambda x: x.__name__ if isinstance(x, type) else len(x.limits))
def test_every_fault_stops_the_arm(robot, monkeypatch, fault, model):
    monkeypatch.setattr(Faulty, "model", model)
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
    monkeypatch.setattr(ik, "solve", lambda *args: None if Faulty.last.wrong else solve(*args))
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
    summary = json.loads((folder / "summary.json").read_text())["natural"]
    assert summary["tick_p99_ms"] is None and summary["runs"] == 0 and summary["not_begun"] == 1 and "1 not begun" in stdout


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
        sight = tracker.update(image, scene.wrist_camera(IIWA, joints))
        if log["age"][tick] == 0 and sight.age == 0 and tick:
            misses.append(np.linalg.norm(sight.seen[:2] - log["seen"][tick, :2]))
    assert np.median(misses) < 1e-3 and camera.grab()[1] is None

    film.rename(film := nets / "film.mp4")
    _, stderr, code, _ = robot("--scenario", "hand_5s", "--camera", str(film), "--force", seed=3)
    again = np.load(folder / "hand_5s_000.npz")
    assert code == 0 or "camera: no image" in mistakes(stderr)[0]  # the second run may be the longer one
    assert len(again["time"]) >= ticks - 3
    assert np.linalg.norm((again["true"] - log["true"][:len(again["true"])])[:20, :2]).max() < 2e-3


def test_force_deletes_no_other_scenario(robot):
    folder = robot("--scenario", "natural", seed=23)[3]
    _, stderr, code, _ = robot("--scenario", "hand_5s", "--force", seed=23)
    assert code == 2 and "--scenario all" in mistakes(stderr)[0] and (folder / "natural_000.npz").exists()


def test_the_video_of_a_finished_run_is_said_to_do_nothing(robot):
    assert "--video" not in robot("--scenario", "natural", seed=24)[0]
    stdout, _, code, folder = robot("--scenario", "natural", "--video", seed=24)
    assert code == 0 and "--video: does nothing for 1 finished runs" in stdout and not list(folder.glob("*.mp4"))


@pytest.mark.parametrize("words", [("--arm", "six_joints:SixJoints"), ("--latency", "2"), ("--think", "0")])
def test_another_arm_or_gap_needs_another_seed(robot, words):
    folder = robot("--scenario", "natural", seed=25)[3]
    _, stderr, code, _ = robot("--scenario", "natural", *words, seed=25)
    assert code == 2 and words[0][2:] in stderr and "or another --seed" in mistakes(stderr)[0]
    assert len(list(folder.glob("*.npz"))) == 1


def test_a_damaged_log_is_named(robot):
    folder = robot("--scenario", "natural", seed=22)[3]
    (folder / "natural_000.npz").write_bytes(b"")
    _, stderr, code, _ = robot("--scenario", "natural", seed=22)
    assert code == 2 and len(mistakes(stderr)) == 1 and "natural_000.npz is damaged: delete it" in stderr


@pytest.mark.parametrize("args, words", [(("--latency", "inf"), "finite"), (("--arm", "json:loads"), "TypeError"),
                                         (("--camera", "nothing.mp4"), "cannot open"), (("--think", "0.07"), "below 1/15"),
                                         (("--arm", "nothing:Arm"), "module:Class"), (("--arm", "nothing"), "module:Class"),
                                         (("--runs", "0"), "at least 1")])
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

    model = IIWA

    def __init__(self, config):
        self.simulated = placed(box=(0.0, 0.03, 0.2), pusher=(-0.09, 0.0))
        for name in ("read_joints", "read_wrench", "grab", "command", "stop"):
            setattr(self, name, getattr(self.simulated, name))


@pytest.fixture
def at_once(monkeypatch):
    """A real arm is driven without a thread, as fast as it goes."""
    make = controller.Controller
    monkeypatch.setattr(controller, "Controller", lambda arm, threaded, think: make(arm, False))


def test_the_guard_itself_refuses_after_a_stop():
    driver = Driver(None)
    driver.stop, guard = lambda: 1 / 0, safety.Guarded(driver)
    guard.begin()
    with pytest.raises(safety.Stop, match=r"own stop\(\) failed \(ZeroDivisionError.*arm stopped: a reason"), guard:
        guard.stop("a reason")
    with pytest.raises(safety.Stop, match="arm stopped: a reason"):
        guard.command(np.zeros(7))
    assert guard.stopped.count("own stop") == 1


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


def test_a_camera_that_is_left_ends_its_thread_and_gives_the_device_back(monkeypatch):
    class Steady:
        released = False

        def __init__(self, source):
            pass

        def isOpened(self):
            return True

        def read(self):
            time.sleep(0.01)
            return True, np.zeros((480, 640, 3), np.uint8)

        def release(self):
            self.released = True

    monkeypatch.setattr(cv2, "VideoCapture", Steady)
    with hardware.VideoCamera("0", time.monotonic, 0.0) as camera:
        assert camera.thread.is_alive()
    assert not camera.thread.is_alive() and camera.capture.released


@pytest.mark.parametrize("corner", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_the_program_thinks_as_the_training_stack_does(corner, float32):
    """The same observations, estimates and actions as Mirrored, Believed and the policy."""
    torch.manual_seed(1)
    f, pi = networks.Estimator((16, 16, 16), dropout=0.0).requires_grad_(False), networks.policy(12, (16, 16, 16))
    torch.nn.init.normal_(pi.head[-1].weight)
    env, think = stacks.make(stacks.METHODS["est_uncertainty"], 1, f, 1), importlib.import_module("06_robot").think
    start = {"box": [0.1 * corner[0], 0.04 * corner[1], 0.5], "pusher": [0.1 * corner[0], -0.08 * corner[1]]}
    obs, infos = env.reset(seed=0, options=start)
    memory = recall = None
    for _ in range(20):
        o = infos["o"][0]
        row = {"seen": task.unscale_pose(o[:4]), "age": o[8], "pusher": o[4:6] * task.HALF,
               "force": o[6:8] * task.World.max_force}
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


def test_an_arm_of_six_joints_plays_a_run(robot):
    _, _, code, folder = robot("--arm", "six_joints:SixJoints", "--scenario", "natural")
    log = np.load(folder / "natural_000.npz")
    assert code == 0 and log["joints"].shape[1] == 6 and not log["unsolved"].any() and log["ended"] != "stopped"
