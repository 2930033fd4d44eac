"""Stage 06: each thing besides a bad reading that must stop the arm."""
import fcntl
import importlib
import os
import pty
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from robot_arms import Taped, mistakes, placed, stopped_for_good

from common import runs
from common.robot import controller, hardware, ik, safety


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
    _, stderr, code, folder = robot("--arm", "robot_arms:Taped", "--scenario", "natural")
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
    _, stderr, code, _ = robot("--arm", "robot_arms:Taped", "--scenario", "natural")
    assert code == 2 and len(mistakes(stderr)) == 1 and "ZeroDivisionError in test_robot_stops.py" in stderr
    assert stopped_for_good(Taped.last.simulated)


def test_a_camera_that_cannot_be_opened_stops_the_arm(robot, nobody):
    _, stderr, code, _ = robot("--arm", "robot_arms:Taped", "--camera", "nothing.mp4")
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
