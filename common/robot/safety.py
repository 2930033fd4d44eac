"""Between the program and the arm: everything read is looked at, and the first doubt stops the arm for good."""
import os
import signal
import threading
import time as wall
import traceback
from collections import deque
from pathlib import Path

import numpy as np

from common import task
from common.files import UserError
from common.robot import hardware, ik, scene

# N, of the mean over a control step, and of one reading: 5 kg struck at full speed have 5 * 0.07 * 1.7 * 150 = 90 N, and friction
FORCE, PEAK = 40.0, 150.0
SENSOR_AGE, CAMERA_AGE = 0.05, 0.5  # s, of the newest joint angles and wrench, and of the newest image
EARLY = 0.02  # s that a time may be ahead of that of the joint angles
FROZEN = 5  # equal images in a row: a live camera's noise never repeats
PARTS = "model", *(name for name in vars(hardware.Arm) if not name.startswith("_"))  # of an arm
STUCK, MOVES = 15, 0.005  # equal joint angles in a row, while the pusher is told to move, at more than so many m/s
UNSOLVED = 3  # programs in a row
JOINT_GAP = np.deg2rad(0.5)  # rad to a joint's limit; the program keeps 2 degrees
OVERSPEED = 1.1  # times a joint's largest speed: what its readings may show
TIP, TIP_XY = 0.1, 0.08  # m/s, of the pusher in any direction, and in the plane; the policy asks for 0.071 at most
HEIGHT_GAP, TILT = 0.005, np.deg2rad(2.0)  # m and rad from the pusher's height and direction; the program keeps 0.1 mm
BORDER = task.HALF + ik.MARGIN + 0.001  # m, farthest place of the pusher: the program's limit, and 1 mm
SIGNALS = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM", signal.SIGQUIT: "SIGQUIT",
           signal.SIGHUP: "SIGHUP, the terminal was closed"}


class Stop(UserError):
    """The arm has been stopped; the message tells why."""


class Guarded:
    """An Arm whose readings are whole, new and within limits, or which has stopped for good and raised Stop.

    As a context it is the time in which the arm can move: a signal or an exception inside is a Stop, and it ends with the
    arm's own stop. `arm` is a hardware.Arm, `simulated` the same if it is a SimulatedArm, else None; `camera` has grab(), and
    is the arm itself until it is set; `waiting` says that the program waits for somebody, outside all runs. Joints, wrench and
    commands may be one thread's and images another's; `halt` is any thread's. Raises TypeError: the arm lacks a method.
    """

    def __init__(self, arm):
        missing = [name for name in PARTS if not hasattr(arm, name)]
        if missing:
            raise TypeError(f"it has no {', '.join(missing)} as hardware.Arm has")
        self.arm, self.camera, self.model, self.stopped = arm, arm, arm.model, ""
        self.simulated = arm if isinstance(arm, hardware.SimulatedArm) else None
        self.still, self._lock, self.waiting = np.zeros(len(arm.model.limits)), threading.Lock(), False

    def __enter__(self):
        self._handlers = {number: signal.signal(number, self._signalled) for number in SIGNALS
                          if signal.getsignal(number) is not signal.SIG_IGN}  # as nohup has it
        return self

    def __exit__(self, kind, error, trace):
        try:
            for number in self._handlers:
                signal.signal(number, signal.SIG_IGN)  # the arm is stopped here, whatever is asked
            if error:
                self.fail(error)
        finally:
            self.halt("the program has ended")
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
            _let_print()
        if not self.stopped.startswith("arm stopped"):
            raise Stop(self.stopped)

    def _signalled(self, number, frame):
        """Only notes the reason, and lets the exception stop the arm: the signal may have come within a call of the driver.

        After the first reason to stop another signal changes nothing, but ends a wait.
        """
        first, self.stopped = not self.stopped, self.stopped or f"arm stopped: {SIGNALS[number]}"
        if first or self.waiting:
            raise KeyboardInterrupt

    def begin(self):
        """A run begins: what was read before does not count."""
        self._joints, self._forces = deque(maxlen=ik.QP_RATE), deque(maxlen=ik.STEPS)  # a second's, a tick's
        self._moving, self._still, self._unsolved, self._equal, self._image = False, 0, 0, 0, None
        self.read_joints(), self.read_wrench()

    def halt(self, reason):
        """Stops the arm for good; the first reason stays. The lock orders it and commands: after it none reaches the arm."""
        self.stopped = self.stopped or f"arm stopped: {reason}"
        mine = self._lock.acquire(timeout=0.1)  # no longer: a driver may hang in its command
        try:
            self.arm.stop()
        except BaseException as error:
            failure = f"the arm's own stop() failed ({type(error).__name__}: {error})"
            self.stopped = self.stopped if failure in self.stopped else f"{failure}; {self.stopped}"
        finally:
            if mine:
                self._lock.release()

    def stop(self, reason):
        """Stops the arm for good, and raises Stop."""
        self.halt(reason)
        raise Stop(self.stopped)

    def fail(self, error):
        """Stops the arm for an exception, and raises Stop with one line of it; not where it is a line already, a UserError."""
        if isinstance(error, UserError):
            return self.halt(error)
        *_, (frame, line) = traceback.walk_tb(error.__traceback__)  # reads no file
        failure = f"{type(error).__name__} in {Path(frame.f_code.co_filename).name}, line {line}: {error}"
        self.stop("Ctrl-C" if isinstance(error, KeyboardInterrupt) else failure)

    def require(self, good, reason):
        """Stops the arm unless `good`."""
        if not good:
            self.stop(reason)

    def read_joints(self):
        """Looks at the arm's joint angles, which are `joints` then."""
        time, q = self.arm.read_joints()
        whole = np.shape(q) == self.model.limits.shape and np.isfinite(time) and np.isfinite(q).all()
        self.require(whole, f"joint angles: not {len(self.model.limits)} numbers")
        if not self.simulated:
            self._check_age("joint angles", time, SENSOR_AGE)
        q = np.array(q, float)
        for i in np.flatnonzero(np.abs(q) > self.model.limits - JOINT_GAP):
            self.stop(f"joint {i + 1} is at its limit, {np.rad2deg(q[i]):.1f} degrees")
        axes, points, rotation = self.model.chain(q)
        self._jacobian = self.model.jacobian(axes, points)[:3]
        x, y, rise = points[-1] - [0, 0, self.model.height]
        tilt = np.arccos(np.clip((np.trace(rotation.T @ self.model.down) - 1) / 2, -1, 1))
        self.require(abs(x) <= BORDER[0] and abs(y) <= BORDER[1], f"the pusher is beyond the border, at {x:.3f}, {y:.3f} m")
        self.require(abs(rise) <= HEIGHT_GAP and tilt <= TILT,
                     f"the pusher is {1e3 * rise:.1f} mm above its height and turned by {np.rad2deg(tilt):.1f} degrees")
        last, before = self._joints[-1] if self._joints else (time, q)
        within = np.clip(time - last, 1 / ik.QP_RATE, SENSOR_AGE)
        for i in np.flatnonzero(np.abs(q - before) > OVERSPEED * self.model.speeds * within):
            self.stop(f"joint {i + 1} is over its speed, {np.rad2deg(q - before)[i]:.1f} degrees in {within:.3f} s")
        self._still = (self._still + self._moving) * np.array_equal(q, before)
        self.require(self._still < STUCK, "joint angles: the same, while they are told to move")
        if not self._joints or time > last:
            self._joints.append((time, q))

    @property
    def joints(self):
        """Time and joint angles (n,) in rad that were read last."""
        return self._joints[-1]

    def joints_then(self, time):
        """Joint angles (n,) at an earlier time, between those that were read."""
        times, q = zip(*tuple(self._joints))
        return np.array([np.interp(time, times, angle) for angle in zip(*q)])

    def _check_age(self, sensor, time, oldest):
        age = (self._joints[-1][0] if self.simulated else wall.monotonic()) - time
        self.require(-EARLY <= age <= oldest, f"{sensor}: the newest is {age:.2f} s old")

    def read_wrench(self):
        """Looks at the arm's force, of which `force` is the mean then. Call it after read_joints."""
        time, force = self.arm.read_wrench()
        self.require(np.shape(force) == (3,) and np.isfinite(force).all(), "wrench: not three numbers")
        self._check_age("wrench", time, SENSOR_AGE)
        self._forces.append(np.array(force, float))
        mean, peak = np.linalg.norm(self.force), np.linalg.norm(force)
        self.require(mean <= FORCE, f"force of {mean:.0f} N, over {FORCE:.0f} N")
        self.require(peak <= PEAK, f"force of {peak:.0f} N in one reading, over {PEAK:.0f} N")

    @property
    def force(self):
        """Mean force (3,) in N of the last control step's readings, tool frame."""
        return np.mean(tuple(self._forces), 0)

    def grab(self):
        """Time and image (480, 640, 3) uint8 BGR, a copy. Call it after read_joints."""
        time, image = self.camera.grab()
        self.require(image is not None, "camera: no image")
        shape, due = np.shape(image), (*scene.SIZE[::-1], 3)
        self.require(shape == due, f"camera: images of shape {shape}, not {due} as common/robot/scene.py has it")
        self._check_age("camera", time, CAMERA_AGE)
        self._equal = self._equal + 1 if np.array_equal(image, self._image) else 0
        self._image = image.copy()
        self.require(self._equal < FROZEN, f"camera: frozen, {FROZEN + 1} equal images")
        return time, self._image

    def command(self, velocity):
        """Joint velocities (n,) in rad/s, or zero where the program was not solved (None)."""
        self.check()
        self._unsolved = self._unsolved + 1 if velocity is None else 0
        self.require(self._unsolved < UNSOLVED, f"{UNSOLVED} programs in a row were not solved")
        velocity = self.still if velocity is None else velocity
        within = np.shape(velocity) == self.model.limits.shape and (np.abs(velocity) <= 1.001 * self.model.speeds).all()
        self.require(within, "a joint velocity is not within its limit")
        tip = self._jacobian @ velocity
        speed, speed_xy = np.linalg.norm(tip), np.linalg.norm(tip[:2])
        self.require(speed <= TIP and speed_xy <= TIP_XY, f"the pusher would move at {speed:.3f} m/s")
        with self._lock:
            self.check()
            self.arm.command(velocity)
            if self.stopped:  # by a thread that waited no longer for the driver
                self.arm.stop()
        self._moving = speed > MOVES

    def check(self):
        """Raises Stop where the arm has been stopped."""
        if self.stopped:
            raise Stop(self.stopped)


def _let_print():
    """Prints into nothing from now on where the terminal is gone: the exit code still tells."""
    for descriptor in (1, 2):
        try:
            os.write(descriptor, b"")
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
