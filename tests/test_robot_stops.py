"""Stage 06: the control thread, and each thing besides a bad reading that must stop the arm."""
import fcntl
import hashlib
import importlib
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from robot_arms import STILL, Driver, mistakes, placed, stopped_for_good

from common import runs, task
from common.robot import controller, hardware, ik, safety


class Taped(Driver):
    """A real arm that notes when it was told what: `tape` of (time, moving or not). `last` is the one that was made last."""

    def __init__(self, config=None):
        super().__init__(config)
        Taped.last, self.tape = self, []
        drive, stop = self.command, self.stop
        self.command = lambda velocity: (self.tape.append((time.monotonic(), bool(velocity.any()))), drive(velocity))
        self.stop = lambda: (self.tape.append((time.monotonic(), False)), stop(), self.stopped())

    def stopped(self):
        """For a test to see."""


@pytest.fixture
def nobody(monkeypatch):
    """At the terminal: who places the box has done so."""
    monkeypatch.setattr("builtins.input", lambda words: None)


def last_move(arm):
    """When the arm was told to move for the last time, and when to stand still after it."""
    k = max(i for i, (_, moving) in enumerate(arm.tape) if moving)
    return arm.tape[k][0], arm.tape[k + 1][0]


@pytest.fixture
def patient(monkeypatch):
    """On a busy machine a target may be late."""
    monkeypatch.setattr(controller, "SILENCE", 1.0)


# The control thread


def test_the_thread_keeps_the_pace_while_the_program_thinks(patient):
    arm = Taped()
    with controller.Controller(guard := safety.Guarded(arm), threaded=True) as drive:
        drive.aim(np.zeros(2))
        drive.tick()
        before, took = guard.joints[0], []
        for _ in range(6):
            time.sleep(0.04)
            drive.aim(np.array([0.0, 0.03]))
            drive.tick()
            took.append(guard.joints[0] - before)
            before = guard.joints[0]
    moments = np.diff([moment for moment, _ in arm.tape])
    assert np.median(moments) == pytest.approx(1 / ik.QP_RATE, rel=0.1)
    assert np.median(took) == pytest.approx(1 / task.RATE, abs=1.5 / ik.QP_RATE)
    assert arm.simulated.points[-1, 1] > 0.005 and not arm.tape[-1][1]


def test_the_force_is_the_mean_over_the_whole_control_step(patient):
    arm = Taped()
    arm.read_wrench = lambda: (time.monotonic(), np.array([round(150 * arm.simulated.time) % 10, 0, 0]))  # 0 to 9
    for threaded in (False, True):
        with controller.Controller(guard := safety.Guarded(arm), threaded, think=0.03) as drive:
            for _ in range(4):
                time.sleep(0.02)
                drive.aim(np.zeros(2))
                drive.tick()
                assert guard.force[0] == 4.5
        arm = Taped()
        arm.read_wrench = lambda: (time.monotonic(), np.array([round(150 * arm.simulated.time) % 10, 0, 0]))


@pytest.mark.parametrize("think, late", [(0.0, 0), (0.02, 3), (0.03, 5)])
def test_until_the_program_has_thought_the_last_target_holds(monkeypatch, think, late):
    arm, targets = placed(pusher=(-0.25, 0.0)), []
    monkeypatch.setattr(ik, "solve", lambda arm, q, v: targets.append(v[0]) or np.zeros(7))
    with controller.Controller(safety.Guarded(arm), threaded=False, think=think) as drive:
        for target in (1.0, 2.0):
            drive.aim(np.array([target, 0.0]))
            assert drive.tick() == 0.0
    assert targets == late * [0.0] + 10 * [1.0] + (10 - late) * [2.0]
    assert np.isclose(arm.time, 21 / ik.QP_RATE)


def test_the_mean_of_a_control_step_is_as_noisy_as_the_training_worlds_force():
    arm = placed(hardware.Gaps(**vars(STILL) | {"force_noise": 0.7}), pusher=(-0.25, 0.0))
    with controller.Controller(guard := safety.Guarded(arm), threaded=False) as drive:
        means = [(drive.aim(np.zeros(2)), drive.tick(), guard.force)[2] for _ in range(200)]
    assert np.std(means) == pytest.approx(0.7, rel=0.1)
    assert abs(np.corrcoef(np.ravel(means[:-1]), np.ravel(means[1:]))[0, 1]) < 0.15


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


def test_the_first_target_comes_a_step_after_the_first_sight_not_two(robot, monkeypatch):
    module, order = importlib.import_module("06_robot"), []
    for room, name in ((module, "sense"), (module, "think"), (controller.Controller, "tick"), (controller.Controller, "aim")):
        monkeypatch.setattr(room, name, lambda *words, act=getattr(room, name), name=name: order.append(name) or act(*words))
    robot("--scenario", "natural")
    steady = ["sense", "think", "aim", "tick"]
    assert order[:11] == ["think", "tick", "aim", *steady, *steady]  # the first of all is made before there is an arm


# Stops


def busy(seconds):
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        pass


@pytest.mark.parametrize("hang", [time.sleep, busy, lambda s: hashlib.pbkdf2_hmac("sha256", b"a", b"b", int(2e6 * s))],
                         ids=["a sleep", "a Python loop", "a C call"])
def test_the_arm_stands_still_while_the_main_thread_hangs(robot, nobody, patient, monkeypatch, hang):
    module, began = importlib.import_module("06_robot"), []
    think = module.think

    def hanging(f, pi, passes, row, memory):
        if row.get("time", 0) > 0.5:
            began.append(time.monotonic())
            monkeypatch.setattr(controller, "SILENCE", 0.1)
            hang(0.5)
        return think(f, pi, passes, row, memory)

    monkeypatch.setattr(module, "think", hanging)
    monkeypatch.setattr(task, "SPEEDS", np.full(11, 0.03))
    _, stderr, code, _ = robot("--arm", f"{__name__}:Taped", "--scenario", "natural")
    arm = Taped.last
    stood = last_move(arm)[1]
    assert code == 2 and mistakes(stderr) == ["error: arm stopped: no new target for 0.1 s"] and stopped_for_good(arm.simulated)
    assert len(began) == 1 and 0 < stood - began[0] < 0.2


@pytest.mark.parametrize("number, words", [(signal.SIGHUP, "SIGHUP, the terminal was closed"), (signal.SIGQUIT, "SIGQUIT"),
                                           (signal.SIGTERM, "SIGTERM"), (signal.SIGINT, "Ctrl-C")])
@pytest.mark.parametrize("threaded", [False, True])
def test_a_signal_stops_the_arm(robot, patient, monkeypatch, number, words, threaded):
    module, made, kept = importlib.import_module("06_robot"), [], lambda *args: None
    before = signal.signal(number, kept)  # which may be ignored, where the tests run in the background
    think, make = module.think, hardware.SimulatedArm.__init__

    def struck(f, pi, passes, row, memory):
        if "time" in row:  # from the first tick on: some runs have but three
            os.kill(os.getpid(), number)
        return think(f, pi, passes, row, memory)

    def struck_again(arm, stop=hardware.SimulatedArm.stop):
        os.kill(os.getpid(), signal.SIGINT)  # changes nothing
        stop(arm)

    monkeypatch.setattr(module, "think", struck)
    monkeypatch.setattr(hardware.SimulatedArm, "stop", struck_again)
    monkeypatch.setattr(hardware.SimulatedArm, "__init__", lambda arm, gaps: made.append(arm) or make(arm, gaps))
    _, stderr, code, folder = robot("--scenario", "natural", *["--realtime"] * threaded)
    assert code == 2 and mistakes(stderr) == [f"error: arm stopped: {words}"] and stopped_for_good(made[0])
    assert not list(folder.glob("*.npz")) and signal.signal(number, before) is kept  # the run is played again


def test_a_second_signal_loses_no_run_of_a_real_arm(robot, nobody, patient, monkeypatch):
    module, kept = importlib.import_module("06_robot"), lambda *args: None
    before, think, stop = signal.signal(signal.SIGTERM, kept), module.think, Taped.stopped
    strike = lambda: os.kill(os.getpid(), signal.SIGTERM)  # noqa: E731
    monkeypatch.setattr(module, "think", lambda *args: ("time" in args[3] and strike(), think(*args))[1])
    monkeypatch.setattr(Taped, "stopped", lambda arm: (strike(), stop(arm)))
    _, stderr, code, folder = robot("--arm", f"{__name__}:Taped", "--scenario", "natural")
    assert code == 2 and mistakes(stderr) == ["error: arm stopped: SIGTERM"] and stopped_for_good(Taped.last.simulated)
    assert np.load(folder / "natural_000.npz")["ended"] == "stopped" and signal.signal(signal.SIGTERM, before) is kept


def test_a_signal_after_a_stop_ends_what_waits():
    """As at the prompt before a run, when the page's button has stopped the arm."""
    guard, before = safety.Guarded(placed()), signal.signal(signal.SIGTERM, lambda *args: None)
    with pytest.raises(safety.Stop, match="arm stopped: a reason"), guard:
        guard.halt("a reason")
        os.kill(os.getpid(), signal.SIGTERM)  # changes nothing
        guard.waiting = True
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("nothing happened")
    signal.signal(signal.SIGTERM, before)


class Written(hardware.SimulatedArm):
    """An arm in a process of its own, that writes each word into the file `tape` beside its runs."""

    def __init__(self, config):
        super().__init__(config)
        controller.SILENCE = 1.0
        self.file = open(config.out / "tape", "w", buffering=1)

    def command(self, velocity):
        super().command(velocity)
        print("moves" if np.any(velocity) else "stands", file=self.file)

    def stop(self):
        super().stop()
        try:
            os.write(2, b"")
            print("stopped", file=self.file)
        except OSError:
            print("stopped without a terminal", file=self.file)


def test_a_closed_terminal_stops_the_arm_before_anything_is_printed(nets):
    master, terminal = pty.openpty()
    arguments = [sys.executable, ROOT / "06_robot.py", "smoke", "--out", nets, "--arm", f"{__name__}:Written", "--runs", "50",
                 "--realtime", "--seed", "99"]

    def own_the_terminal():
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # tests under nohup ignore it, and the program keeps to that

    process = subprocess.Popen(arguments, stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True,
                               env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)}, preexec_fn=own_the_terminal)
    os.close(terminal)
    tape, until = nets / "tape", time.monotonic() + 60
    while not (tape.exists() and tape.read_text().count("\n") > 50) and time.monotonic() < until and process.poll() is None:
        time.sleep(0.05)
    os.close(master)
    try:
        assert process.wait(30) == 2
    finally:
        process.kill()
    lines = tape.read_text().split("\n")[:-1]
    first = lines.index("stopped without a terminal")
    assert first > 50 and set(lines[first:]) == {"stopped without a terminal"}


@pytest.mark.parametrize("where", ["runs.Run", "06_robot.prepare"])
def test_an_error_before_the_first_run_stops_the_arm(robot, nobody, monkeypatch, where):
    module = runs if where == "runs.Run" else importlib.import_module("06_robot")
    monkeypatch.setattr(module, where.rpartition(".")[2], lambda *args, **settings: 1 / 0)
    _, stderr, code, _ = robot("--arm", f"{__name__}:Taped", "--scenario", "natural")
    assert code == 2 and len(mistakes(stderr)) == 1 and "ZeroDivisionError in test_robot_stops.py" in stderr
    assert stopped_for_good(Taped.last.simulated)


def test_a_camera_that_cannot_be_opened_stops_the_arm(robot, nobody):
    _, stderr, code, _ = robot("--arm", f"{__name__}:Taped", "--camera", "nothing.mp4")
    assert code == 2 and len(mistakes(stderr)) == 1 and "cannot open" in stderr and stopped_for_good(Taped.last.simulated)


@pytest.mark.parametrize("tip, good", [((0.079, 0, 0), True), ((0.081, 0, 0), False), ((0.06, 0.06, 0), False),
                                       ((0, 0, 0.099), True), ((0, 0, -0.101), False), ((0.07, 0, 0.08), False)])
def test_a_tip_that_would_move_too_fast_stops_the_arm(model, tip, good):
    arm = placed(model=model)
    guard = safety.Guarded(arm)
    guard.begin()
    speeds = np.linalg.pinv(arm.model.jacobian(*arm.model.chain(arm.joints)[:2])) @ [*tip, 0, 0, 0]
    if good:
        guard.command(speeds)
        return
    with pytest.raises(safety.Stop, match="the pusher would move at"):
        guard.command(speeds)
    assert stopped_for_good(arm) and arm.time == 1 / ik.QP_RATE


@pytest.mark.parametrize("share, steps, good", [(1.05, 1, True), (1.15, 1, False), (1.05, 0, True), (1.15, 0, False),
                                                (1.05, 1.3, True), (1.15, 1.3, False)])
def test_joints_that_move_faster_than_they_can_stop_the_arm(model, share, steps, good):
    arm = placed(model=model)
    guard = safety.Guarded(arm)
    guard.begin()
    arm.joints[-1] += share * model.speeds[-1] * max(steps, 1) / ik.QP_RATE
    arm.time += steps / ik.QP_RATE
    if good:
        guard.read_joints()
        return
    with pytest.raises(safety.Stop, match=r"joint \d is over its speed"):
        guard.read_joints()
    assert stopped_for_good(arm)


def test_after_a_stop_nothing_reaches_the_arm_from_any_thread():
    """Four threads command as fast as they can; each of 50 times a fifth stops the arm amid them."""
    for _ in range(50):
        arm, told = placed(), []
        arm.command = lambda velocity: (time.sleep(1e-4), told.append("moves"))
        arm.stop = lambda: told.append("stop")
        guard = safety.Guarded(arm)
        guard.begin()

        def hammer():
            with pytest.raises(safety.Stop):
                while True:
                    guard.command(np.full(7, 1e-3))

        threads = [threading.Thread(target=hammer) for _ in range(4)]
        for thread in threads:
            thread.start()
        time.sleep(0.003)
        guard.halt("enough")
        for thread in threads:
            thread.join()
        assert set(told[told.index("stop"):]) == {"stop"} and told[0] == "moves"


def test_a_driver_that_hangs_in_its_command_is_stopped_all_the_same(patient):
    arm, hang = Taped(), threading.Event()
    guard = safety.Guarded(arm)
    drive, began = arm.command, []
    arm.command = lambda velocity: (drive(velocity), began.append(1), len(began) > 15 and hang.wait(5))
    with pytest.raises(safety.Stop, match="the control thread hangs"), controller.Controller(guard, threaded=True) as moving:
        while True:
            moving.aim(np.zeros(2))
            moving.tick()
    assert arm.simulated.stopped
    hang.set()
    moving.thread.join(5)
    assert not arm.tape[-1][1] and len(began) == 16  # what came of the hanging command was stopped once more
