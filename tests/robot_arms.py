"""Simulated arms for the tests of stage 06, and what is asked of them."""
import time

import numpy as np

from common.robot import hardware
from common.robot.iiwa import IIWA

STILL = hardware.Gaps(latency=0, hand_eye_mm=0, hand_eye_deg=0, servo_lag=0, tool_mass=0, force_bias=0, force_noise=0)
DYNAMICS = {"mass": 3.2, "mu_static": 0.4, "mu_dynamic": 0.2, "mu_pusher": 0.2, "restitution": 0.3, "limit_surface_c": 0.06}


def placed(gaps=STILL, box=(0.0, 0.0, 0.0), pusher=(-0.1, 0.0), hand=(np.inf, np.inf), seed=0, model=IIWA):
    arm = hardware.SimulatedArm(gaps)
    arm.model = model
    dynamics = {name: np.array([value]) for name, value in DYNAMICS.items()}
    arm.place(np.random.default_rng(seed), np.array(box, float), np.array(pusher, float), dynamics, hand)
    return arm


class Driver:
    """A SimulatedArm that the program does not know for one, with a real one's times."""

    model = IIWA

    def __init__(self, config):
        self.simulated = placed(box=(0.0, 0.03, 0.2), pusher=(-0.09, 0.0))
        self.command, self.stop = self.simulated.command, self.simulated.stop
        for name in ("read_joints", "read_wrench", "grab"):
            setattr(self, name, lambda read=getattr(self.simulated, name): (time.monotonic(), read()[1]))


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


def stopped_for_good(arm):
    before = arm.joints.copy()
    arm.command(np.full(7, 0.1))
    return arm.stopped and not arm.speeds.any() and (arm.joints == before).all()


def mistakes(stderr):
    """Lines that tell one; the others are the progress bar's."""
    return [line for line in stderr.splitlines() if line.startswith("error: ")]
