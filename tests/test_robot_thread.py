"""Stage 06: the control thread: its pace, and that it stops the arm whatever hangs."""
import hashlib
import importlib
import threading
import time

import numpy as np
import pytest
from robot_arms import STILL, Taped, mistakes, placed, stopped_for_good

from common import task
from common.robot import controller, hardware, ik, safety


def last_move(arm):
    """When the arm was told to move for the last time, and when to stand still after it."""
    k = max(i for i, (_, moving) in enumerate(arm.tape) if moving)
    return arm.tape[k][0], arm.tape[k + 1][0]


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


def test_the_first_target_comes_a_step_after_the_first_sight_not_two(robot, monkeypatch):
    module, order = importlib.import_module("06_robot"), []
    for room, name in ((module, "sense"), (module, "think"), (controller.Controller, "tick"), (controller.Controller, "aim")):
        monkeypatch.setattr(room, name, lambda *words, act=getattr(room, name), name=name: order.append(name) or act(*words))
    robot("--scenario", "natural")
    steady = ["sense", "think", "aim", "tick"]
    assert order[:11] == ["think", "tick", "aim", *steady, *steady]  # the first of all is made before there is an arm


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
    _, stderr, code, _ = robot("--arm", "robot_arms:Taped", "--scenario", "natural")
    arm = Taped.last
    stood = last_move(arm)[1]
    assert code == 2 and mistakes(stderr) == ["error: arm stopped: no new target for 0.1 s"] and stopped_for_good(arm.simulated)
    assert len(began) == 1 and 0 < stood - began[0] < 0.2


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
