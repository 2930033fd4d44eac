"""Stage 06: every fault of an arm, a camera or the program that must stop the arm."""
import gc
import json
import threading
import time

import cv2
import numpy as np
import pytest
from robot_arms import Driver, mistakes, placed, stopped_for_good
from six_joints import SIX

from common import belief, task
from common.robot import controller, hardware, ik, safety
from common.robot.iiwa import IIWA


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


class Struck(Faulty):
    def read_wrench(self):
        time, force = super().read_wrench()
        return time, force + [200.0 * (len(self.commands) == 26), 0, 0]


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


class JointsStuck(Faulty):
    kept = None

    def read_joints(self):
        self.kept = self.kept if self.wrong else self.joints.copy()
        return self.time, self.kept.copy()


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
          Struck: "N in one reading, over 150 N",
          JointAtLimit: "joint 4 is at its limit", Beyond: "beyond the border", JointsOld: "wrench: the newest is -",
          TooFast: "is over its speed", JointsStuck: "the same, while they are told to move",
          Lifted: "above its height", Broken: "BrokenPipeError in test_robot_faults.py", CtrlC: "Ctrl-C"}


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


def test_a_run_goes_on_after_a_stop_and_counts_it(robot):
    assert robot("--scenario", "natural", "--runs", "2", "--arm", f"{__name__}:Broken", seed=7)[2] == 2
    Broken.read_wrench, broken = Faulty.read_wrench, Broken.read_wrench
    try:
        _, _, code, folder = robot("--scenario", "natural", "--runs", "2", "--arm", f"{__name__}:Broken", seed=7)
    finally:
        Broken.read_wrench = broken
    row = json.loads((folder / "summary.json").read_text())["natural"]
    assert code == 0 and row["stops"] == 1 and row["runs"] == 2


@pytest.mark.parametrize("late, good", [(0.04, True), (0.3, False), (-0.3, False)])
def test_a_real_arms_readings_are_of_this_machines_clock(late, good):
    driver = Driver(None)
    guard, read = safety.Guarded(driver), driver.read_joints
    driver.read_joints = lambda: (read()[0] - late, read()[1])
    driver.read_wrench = lambda: (read()[0] - late, np.zeros(3))
    if good:
        return guard.begin()
    with pytest.raises(safety.Stop, match="joint angles: the newest is -?0.30 s old"):
        guard.begin()
    assert driver.simulated.stopped


def test_a_collection_of_garbage_looks_at_nothing_older_than_a_run():
    heap = [[k] for k in range(10**5)]
    before = gc.get_freeze_count()
    with controller.Controller(safety.Guarded(placed()), threaded=True):
        assert gc.get_freeze_count() - before > len(heap)
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize("velocity", [np.zeros(6), np.zeros((7, 1)), np.full(7, np.nan), np.full(7, 9.0), "fast"], ids=str)
def test_velocities_that_are_not_the_arms_stop_it(velocity):
    guard = safety.Guarded(arm := placed())
    guard.begin()
    with pytest.raises(safety.Stop, match="a joint velocity is not within its limit"):
        guard.command(velocity)
    assert arm.time == 0 and stopped_for_good(arm)


def test_the_guard_itself_refuses_after_a_stop():
    driver = Driver(None)
    driver.stop, guard = lambda: 1 / 0, safety.Guarded(driver)
    guard.begin()
    with pytest.raises(safety.Stop, match=r"own stop\(\) failed \(ZeroDivisionError.*arm stopped: a reason"), guard:
        guard.stop("a reason")
    with pytest.raises(safety.Stop, match="arm stopped: a reason"):
        guard.command(np.zeros(7))
    assert guard.stopped.count("own stop") == 1


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
    began = time.monotonic()
    camera = hardware.VideoCamera("0", 0.5)
    time.sleep(0.1)
    (first, image), (again, _) = camera.grab(), camera.grab()
    assert first == again and began <= first + 0.5 <= time.monotonic() and image[0, 0, 0] == 2


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
    with hardware.VideoCamera("0", 0.0) as camera:
        assert camera.thread.is_alive()
    assert not camera.thread.is_alive() and camera.capture.released


def test_the_heaviest_box_of_the_study_may_be_struck():
    arm, readings = placed(), []
    arm.worlds.place(np.arange(1), np.zeros((1, 3)), np.array([[-0.1, 0.0]]), {"mass": 5.0, "restitution": 0.7})
    read = arm.read_wrench
    arm.read_wrench = lambda: (readings.append(read()), readings[-1])[1]
    with controller.Controller(safety.Guarded(arm), threaded=False) as drive:
        for _ in range(20):
            drive.aim(np.array([task.MAX_SPEED, 0.0]))
            drive.tick()
    struck = max(np.linalg.norm(force) for _, force in readings)
    assert 5.0 * 1.7 * task.MAX_SPEED * ik.QP_RATE < struck < safety.PEAK
