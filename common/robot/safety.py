"""Between the program and the arm: everything read is looked at, and the first doubt stops the arm for good."""
import time as wall
import traceback
from collections import deque
from pathlib import Path

import numpy as np

from common import task
from common.files import UserError
from common.robot import iiwa, ik, scene

FORCE, PEAK = 40.0, 100.0  # N: of the mean over a control step, and of one reading
SENSOR_AGE, CAMERA_AGE = 0.05, 0.5  # s, of the newest joint angles and wrench, and of the newest image
EARLY = 0.02  # s that a time may be ahead of that of the joint angles
FROZEN = 5  # equal images in a row: a live camera's noise never repeats
UNSOLVED = 3  # programs in a row
JOINT_GAP = np.deg2rad(0.5)  # rad to a joint's limit; the program keeps 2 degrees
HEIGHT_GAP, TILT = 0.005, np.deg2rad(2.0)  # m and rad from the pusher's height and direction; the program keeps 0.1 mm
BORDER = task.HALF + ik.MARGIN + 0.001  # m, farthest place of the pusher: the program's limit, and 1 mm


class Stop(UserError):
    """The arm has been stopped; the message tells why."""


class Guarded:
    """An Arm whose readings are whole, new and within limits, or which has stopped for good and raised Stop.

    As a context it is one run: it begins with nothing read, ends with zero velocity, and an exception inside is a Stop.
    `arm` is a hardware.Arm; `grab` the camera's, if that is not the arm's own.
    """

    def __init__(self, arm, grab=None):
        self.arm, self._grab, self.stopped = arm, grab or arm.grab, ""

    def __enter__(self):
        self._joints, self._forces = deque(maxlen=ik.QP_RATE), deque(maxlen=ik.QP_RATE // task.RATE)  # a second's, a tick's
        self._renewed, self._again, self._unsolved, self._equal, self._image = wall.monotonic(), 0, 0, 0, None
        return self

    def __exit__(self, kind, error, trace):
        if kind is None:
            return self.command(np.zeros(7))
        if not issubclass(kind, Stop):
            place = traceback.extract_tb(trace)[-1]
            failure = f"{kind.__name__} in {Path(place.filename).name}, line {place.lineno}: {error}"
            self.stop("Ctrl-C" if kind is KeyboardInterrupt else failure)

    def stop(self, reason=""):
        """Stops the arm for good; a Stop if there is a reason (none at the program's end), or the arm's own stop failed."""
        self.stopped = self.stopped or reason and f"arm stopped: {reason}"
        try:
            self.arm.stop()
        except Exception as error:
            self.stopped = f"the arm's own stop() failed ({type(error).__name__}: {error}); {self.stopped}".rstrip("; ")
        if self.stopped:
            raise Stop(self.stopped)

    def require(self, good, reason):
        """Stops the arm unless `good`."""
        if not good:
            self.stop(reason)

    def read_joints(self):
        """Time and joint angles (7,) in rad."""
        time, q = self.arm.read_joints()
        self.require(np.isfinite(time) and np.shape(q) == (7,) and np.isfinite(q).all(), "joint angles: not seven numbers")
        if not self._joints or time > self._joints[-1][0]:
            self._joints.append((time, q))
            self._renewed, self._again = wall.monotonic(), 0
        self._again += 1
        self.require(self._again <= 8 or wall.monotonic() - self._renewed <= SENSOR_AGE, "joint angles: nothing new")
        for i in np.flatnonzero(np.abs(q) > iiwa.LIMITS - JOINT_GAP):
            self.stop(f"joint {i + 1} is at its limit, {np.rad2deg(q[i]):.1f} degrees")
        _, points, rotation = iiwa.chain(q)
        x, y, rise = points[7] - [0, 0, iiwa.HEIGHT]
        tilt = np.arccos(np.clip((np.trace(rotation.T @ iiwa.DOWN) - 1) / 2, -1, 1))
        self.require(abs(x) <= BORDER[0] and abs(y) <= BORDER[1], f"the pusher is beyond the border, at {x:.3f}, {y:.3f} m")
        self.require(abs(rise) <= HEIGHT_GAP and tilt <= TILT,
                     f"the pusher is {1e3 * rise:.1f} mm above its height and turned by {np.rad2deg(tilt):.1f} degrees")
        return time, q

    def joints_then(self, time):
        """Joint angles (7,) at an earlier time, between those that were read."""
        times, q = zip(*self._joints)
        return np.array([np.interp(time, times, angle) for angle in zip(*q)])

    def _check_age(self, sensor, time, oldest):
        age = self._joints[-1][0] - time
        self.require(-EARLY <= age <= oldest, f"{sensor}: the newest is {age:.2f} s old")

    def read_wrench(self):
        """Time and force (3,) in N, tool frame. Call it after read_joints."""
        time, force = self.arm.read_wrench()
        self.require(np.shape(force) == (3,) and np.isfinite(force).all(), "wrench: not three numbers")
        self._check_age("wrench", time, SENSOR_AGE)
        self._forces.append(force)
        mean, peak = np.linalg.norm(self.force), np.linalg.norm(force)
        self.require(mean <= FORCE and peak <= PEAK, f"force of {mean:.0f} N, over {FORCE:.0f} N, or peak of {peak:.0f} N")
        return time, force

    @property
    def force(self):
        """Mean force (3,) in N of the last control step's readings, tool frame."""
        return np.mean(self._forces, 0)

    def grab(self):
        """Time and image (480, 640, 3) uint8 BGR, a copy. Call it after read_joints."""
        time, image = self._grab()
        self.require(image is not None, "camera: no image")
        shape, due = np.shape(image), (*scene.SIZE[::-1], 3)
        self.require(shape == due, f"camera: images of shape {shape}, not {due} as common/robot/scene.py has it")
        self._check_age("camera", time, CAMERA_AGE)
        self._equal = self._equal + 1 if self._image is not None and np.array_equal(image, self._image) else 0
        self._image = image.copy()
        self.require(self._equal < FROZEN, f"camera: frozen, {FROZEN + 1} equal images")
        return time, self._image

    def command(self, velocity):
        """Joint velocities (7,) in rad/s, or zero where the program was not solved (None)."""
        if self.stopped:
            raise Stop(self.stopped)
        self._unsolved = self._unsolved + 1 if velocity is None else 0
        self.require(self._unsolved < UNSOLVED, f"{UNSOLVED} programs in a row were not solved")
        velocity = np.zeros(7) if velocity is None else velocity
        self.require((np.abs(velocity) <= 1.001 * iiwa.SPEEDS).all(), "a joint velocity is not within its limit")
        self.arm.command(velocity)
