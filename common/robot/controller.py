"""The control loop below the policy: 150 times a second, solve for the last target, command, read joints and wrench."""
import contextlib
import gc
import sys
import threading
import time

import numpy as np

from common.robot import ik
from common.robot.safety import Stop

SILENCE = 0.1  # s without a new target, after which the arm is stopped


class Controller:
    """Moves the pusher of a safety.Guarded `arm` with the velocity that it was last told; as a context it is one run.

    With `threaded` a thread of its own does so at the clock's pace, whatever the caller does meanwhile, and stops the arm where
    that lasts for SILENCE. Without, aim() and tick() play the steps themselves, and the target follows those that fit into
    `think` (s): a simulation's clock runs on while the program thinks, always alike. `unsolved` counts a run's programs.
    """

    def __init__(self, arm, threaded, think=0.0):
        self.arm, self.late, self.beat = arm, int(np.ceil(think * ik.QP_RATE - 1e-9)), threading.Event()
        self.thread = threading.Thread(target=self._follow, daemon=True) if threaded else None

    def __enter__(self):
        self.running, self.unsolved = True, 0
        if self.thread:  # looking through all objects would keep every thread from its work for 0.2 s: those of now stay
            gc.collect()
            gc.freeze()
        self.arm.begin()
        self.target, self.aimed = np.zeros(2), time.monotonic()
        if self.thread:
            sys.setswitchinterval(0.001)  # s that one thread may keep the interpreter from the other
            self.thread.start()
        return self

    def __exit__(self, kind, error, trace):
        self.running = False
        try:
            if error:
                return self.arm.fail(error)
        finally:
            if self.thread:
                self.thread.join(2 * SILENCE)
                gc.unfreeze()
        if self.thread:
            self.arm.require(not self.thread.is_alive(), "the control thread hangs")
            self.arm.check()
        else:
            self.arm.command(self.arm.still)

    def aim(self, velocity):
        """The target from now on: the pusher's velocity (2,) in m/s."""
        if not self.thread:
            self._play(self.late)
        self.target, self.aimed = velocity, time.monotonic()

    def tick(self):
        """Returns at the end of the control step, with a simulated image begun, and for how long that was waited, in s."""
        if self.arm.simulated:
            self.arm.simulated.look_ahead()
        if not self.thread:
            self._play(ik.STEPS - self.late)
            return 0.0
        began = time.perf_counter()
        self.arm.require(self.beat.wait(2 * SILENCE), "the control thread hangs")
        self.beat.clear()
        self.arm.check()
        return time.perf_counter() - began

    def _play(self, steps, wait=lambda: None):
        for _ in range(steps):
            speeds = ik.solve(self.arm.model, self.arm.joints[1], self.target)
            self.unsolved += speeds is None
            self.arm.command(speeds)
            wait()
            self.arm.read_joints()
            self.arm.read_wrench()

    def _follow(self):
        """The thread: a Stop in it is the guard's, which tells the caller."""
        due, steps = time.monotonic(), 0

        def wait():
            nonlocal due
            due = max(due + 1 / ik.QP_RATE, time.monotonic())  # what is late is not made up for by a burst
            time.sleep(max(due - time.monotonic(), 0))
            self.arm.require(time.monotonic() - self.aimed <= SILENCE, f"no new target for {SILENCE} s")

        with contextlib.suppress(Stop):
            try:
                while self.running:
                    self._play(1, wait)
                    steps += 1
                    if steps % ik.STEPS == 0:
                        self.beat.set()
                self.arm.command(self.arm.still)
            except BaseException as error:
                self.arm.fail(error)
        self.beat.set()
