"""Guard and control loop between an arm that fails at random and a solver and program that do too; the arm judges them.

    python tests/robot_fuzz.py [ticks] [seed]

A tick is a control step: an image, a target, ten steps of the control loop. Prints how many ticks had a fault, what stopped the
arm how often, and every command that was unsafe: not finite, too fast for a joint or the pusher, any movement after a stop or
after a reading that had to stop the arm, and any that brought the true arm out of its limits.
"""
import re
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
from common import task
from common.progress import bar
from common.robot import controller, ik, safety
from common.robot.iiwa import IIWA

RUN = 60  # ticks at most
SLACK = 1.1  # the guard knows the arm by its readings, of which small errors cannot be seen
IMAGES = np.random.default_rng(0).integers(0, 255, (8, 480, 640, 3), np.uint8)
WRONG = (np.nan, np.inf, -np.inf)


def shapes(rng, x):
    """What a driver may return instead of an array (n,)."""
    return [None, x[:-1], np.append(x, 0.0), x[None], 0.0, [[0.0], [0.0, 1.0]], "joints", []][rng.integers(8)]


class Arm:
    """Moves as it is told, at once. `must` names a fault after which it may not be told to move; `unsafe` collects what was."""

    def __init__(self, model, rng, start, rate):
        self.model, self.rng, self.rate, self.joints, self.clock = model, rng, rate, start.copy(), 0.0
        self.stopped, self.must, self.faults, self.unsafe, self.equal, self.stale = False, "", 0, [], 0, 0
        self.kept, self.image, self.frozen = (0.0, start.copy()), -1, False
        self.stuck, self.moves, self.alike = False, False, 0

    def fault(self, share=1.0):
        happens = self.rng.random() < self.rate * share
        self.faults += happens
        return happens

    def fatal(self, kind):
        self.must = self.must or kind

    def raised(self, where):
        if self.fault(0.1):
            self.fatal(f"exception in {where}")
            raise [ValueError, OSError, KeyError, RuntimeError, TimeoutError, KeyboardInterrupt][self.rng.integers(6)](where)

    def read_joints(self):
        self.raised("read_joints")
        time, q = self.clock, self.joints.copy()
        if self.fault():
            kind = self.rng.choice(["value", "shape", "time", "jump", "small", "backward"])
            if kind == "value":
                q[self.rng.integers(len(q))] = self.rng.choice(WRONG)
            if kind == "shape":
                q = shapes(self.rng, q)
            if kind == "time":
                time = self.rng.choice(WRONG)
            if kind in ("jump", "small"):
                i, most = self.rng.integers(len(q)), safety.OVERSPEED * safety.SENSOR_AGE
                size = most * (1 + self.rng.random()) if kind == "jump" else self.rng.uniform(0, 0.5) / ik.QP_RATE
                q[i] += self.rng.choice([-1, 1]) * self.model.speeds[i] * size
            if kind == "backward":
                time -= self.rng.choice([1e-3, 0.1, 1e3])
            if kind in ("value", "shape", "time", "jump"):
                self.fatal(f"joints: {kind}")
        elif self.stale or self.fault(0.2):  # the driver delivers its last reading for a while
            self.stale = self.stale - 1 if self.stale else self.rng.integers(1, 40)
            time, q = self.kept
        elif self.stuck or self.fault(0.05):  # the encoders stand still, and their times do not
            self.stuck, q = True, self.kept[1]
        self.alike = (self.alike + self.moves) * (q is self.kept[1])
        if self.alike > safety.STUCK:
            self.fatal("joints: stuck")
        if time < self.clock - safety.SENSOR_AGE - 1 / ik.QP_RATE:
            self.fatal("joints: stale")
        self.kept = time, q
        return time, q

    def read_wrench(self):
        self.raised("read_wrench")
        time, force = self.clock, self.rng.normal(0, 1, 3)
        if self.fault():
            kind = self.rng.choice(["value", "shape", "time", "old", "huge"])
            if kind == "value":
                force[self.rng.integers(3)] = self.rng.choice(WRONG)
            if kind == "shape":
                force = shapes(self.rng, force)
            if kind == "time":
                time = self.rng.choice(WRONG)
            if kind == "old":
                time -= self.rng.uniform(0.3, 10)
            if kind == "huge":
                force *= 10 ** self.rng.uniform(4, 300)
            self.fatal(f"wrench: {kind}")
        return time, force

    def grab(self):
        self.raised("grab")
        self.frozen = self.frozen or self.fault(0.5)
        self.image, self.equal = (self.image, self.equal + 1) if self.frozen and self.image >= 0 else ((self.image + 1) % 8, 0)
        time, image = self.clock - self.rng.uniform(0, 0.1), IMAGES[self.image]
        if self.fault():
            kind = self.rng.choice(["none", "shape", "time", "old", "future"])
            image = {"none": None, "shape": image[:, :self.rng.integers(640)]}.get(kind, image)
            time = {"time": self.rng.choice(WRONG), "old": time - 1, "future": time + 1}.get(kind, time)
            self.fatal(f"image: {kind}")
        if self.equal >= safety.FROZEN:
            self.fatal("image: frozen")
        return time, image

    def command(self, velocity):
        velocity = np.asarray(velocity, float)
        moves = velocity.shape != self.joints.shape or bool(velocity.any())
        if moves and (self.stopped or self.must):
            self.unsafe.append(f"moved after {'a stop' if self.stopped else self.must}")
        if not np.isfinite(velocity).all() or (np.abs(velocity) > 1.001 * self.model.speeds).any():
            self.unsafe.append(f"joint speeds {velocity}")
            return
        axes, points, _ = self.model.chain(self.joints)
        tip = self.model.jacobian(axes, points)[:3] @ velocity
        if np.linalg.norm(tip) > SLACK * safety.TIP or np.linalg.norm(tip[:2]) > SLACK * safety.TIP_XY:
            self.unsafe.append(f"pusher at {tip} m/s")
        self.moves = np.linalg.norm(tip) > SLACK * safety.MOVES
        self.joints = self.joints + velocity / ik.QP_RATE
        place = self.model.chain(self.joints)[1][-1]
        beyond, rise = (np.abs(place[:2]) > safety.BORDER + 0.002).any(), abs(place[2] - self.model.height)
        if moves and (beyond or rise > safety.HEIGHT_GAP + 0.002 or (np.abs(self.joints) > self.model.limits).any()):
            self.unsafe.append(f"at {place} m, {np.rad2deg(self.joints)} degrees")
        self.clock += 1 / ik.QP_RATE
        self.raised("command")

    def stop(self):
        self.stopped = True
        self.raised("stop")


def solver(rng, rate, real):
    """The quadratic program, or the same velocities without its limits, at a fifth of the time; each fails at random."""
    def solve(model, q, velocity):
        if rng.random() < rate:
            return [None, None, np.full(len(q), np.nan), rng.normal(0, 10 ** rng.uniform(-2, 3), len(q))][rng.integers(4)]
        if real:
            return program(model, q, velocity)
        axes, points, rotation = model.chain(q)
        wanted = np.concatenate([velocity, [10 * (model.height - points[-1, 2])], 10 * model.turned(rotation)])
        j = model.jacobian(axes, points)
        return j.T @ np.linalg.solve(j @ j.T, wanted)

    program = ik.solve
    return solve


def fuzz(ticks, seed=0, model=IIWA):
    """Returns how many ticks had a fault, how often each reason stopped the arm, unsafe commands, exceptions but Stop."""
    rng, played, faulty, reasons, unsafe, escaped = np.random.default_rng(seed), 0, 0, Counter(), [], []
    starts = [model.joints_at(xy) for xy in rng.uniform(-1, 1, (50, 2)) * task.HALF]
    wall, program, progress = safety.wall, ik.solve, bar(ticks, "fuzz", unit="tick")
    zeros, small = np.zeros(len(model.limits)), np.full(len(model.limits), 0.01)
    try:
        while played < ticks:
            rate = 10 ** rng.uniform(-3, -1)
            arm = Arm(model, rng, starts[rng.integers(50)], rate)
            safety.wall = SimpleNamespace(monotonic=lambda: arm.clock)
            ik.solve = solver(rng, 0.3 * rate, rng.random() < 0.05)
            before = played
            guard = safety.Guarded(arm)
            try:
                with guard, controller.Controller(guard, threaded=False, think=0.03) as drive:
                    for _ in range(RUN):
                        faults, played = arm.faults, played + 1
                        guard.grab()
                        drive.aim(rng.choice(task.SPEEDS, 2))
                        arm.raised("the program")
                        drive.tick()
                        faulty += arm.faults > faults
            except safety.Stop as stop:
                faulty += arm.faults > 0
                reasons[re.sub(r"-?\d[\d.]*|inf|nan", "#", str(stop)).partition("arm stopped: ")[2][:50]] += 1
            except BaseException as error:
                escaped.append(repr(error))
            arm.must, arm.rate = arm.must or "the end", 0.0
            for late in (zeros, small) if played > before else ():  # as a thread that has not noticed
                try:
                    guard.command(late)
                except safety.Stop:
                    pass
            unsafe += arm.unsafe
            progress.update(played - before)
    finally:
        safety.wall, ik.solve = wall, program
    return SimpleNamespace(ticks=played, faulty=faulty, reasons=reasons, unsafe=unsafe, escaped=escaped)


if __name__ == "__main__":
    result = fuzz(*(int(word) for word in sys.argv[1:]))
    print(f"{result.ticks} ticks, {result.faulty} with a fault, {sum(result.reasons.values())} stops:")
    for reason, count in result.reasons.most_common(40):
        print(f"{count:8d} {reason}")
    print(f"unsafe commands: {len(result.unsafe)}", *result.unsafe[:10], sep="\n")
    print(f"exceptions other than Stop: {len(result.escaped)}", *result.escaped[:10], sep="\n")
    sys.exit(bool(result.unsafe or result.escaped))
