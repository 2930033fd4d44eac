"""What stage 06 needs of an arm and a camera, a simulated arm behind it, and a camera that OpenCV opens."""
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from common import geometry, simulator, speed, task
from common.files import UserError
from common.robot import ik, scene
from common.robot.iiwa import IIWA
from common.robot.model import Model


class Arm(Protocol):
    """The model and the five methods that attach an arm of n joints, a force sensor, a camera; SI units, time.monotonic().

    Joints and wrench are read and `command` is called 150 times a second by one thread, `grab` 15 times by another; `stop` may
    be any thread's, within a `command` only where that hangs. Readings are at most 50 ms old, no method waits.
    """

    model: Model

    def read_joints(self) -> tuple[float, np.ndarray]:
        """Time and joint angles (n,) in rad."""

    def read_wrench(self) -> tuple[float, np.ndarray]:
        """Time and the force (3,) in N that the pusher feels, tool frame, weight compensated."""

    def grab(self) -> tuple[float, np.ndarray]:
        """Time of exposure and the newest image (480, 640, 3) uint8 BGR, undistorted; the image is None where there is none."""

    def command(self, velocity: np.ndarray) -> None:
        """Joint velocities (n,) in rad/s, held until the next call; for safety zero where that does not come within 0.1 s."""

    def stop(self) -> None:
        """Zero velocity, and no other until the program has ended; may be called again."""


@dataclass
class Gaps:
    """What the simulated arm has and the training world has not; the force's errors are as large as the study's."""

    latency: float = 1.0  # camera latency in frames of 1/15 s
    hand_eye_mm: float = 1.0  # standard deviation of the calibrated camera position in mm, drawn once a run
    hand_eye_deg: float = 0.2  # standard deviation of the calibrated camera rotation in degrees, drawn once a run
    servo_lag: float = 0.02  # time constant in s of the joints' first-order response
    tool_mass: float = 0.3  # kg beyond the force sensor, whose inertia it feels (the paper's limitation)
    force_bias: float = 0.7  # standard deviation of its bias in N, drawn once a run (tab. occlusion_and_noise_params)
    force_noise: float = 0.7  # standard deviation in N of a control step's mean force (tab. occlusion_and_noise_params)


class SimulatedArm:
    """An arm, its camera and its force sensor over a pymunk world; its clock runs on with each command, by 1/ik.QP_RATE s."""

    model = IIWA

    def __init__(self, gaps: Gaps):
        self.gaps, self.worlds, self.stopped = gaps, simulator.Worlds(1, sub_steps=1, rate=ik.QP_RATE), False

    def place(self, rng, box, pusher, dynamics, hand=(np.inf, np.inf)):
        """Starts anew: box (3,), pusher (2,), dynamics as simulator.Worlds.place takes them, from when to when a hand (s)."""
        g, self.rng, self.time, self.hand = self.gaps, rng, 0.0, hand
        self.worlds.place(np.arange(1), box[None], pusher[None], dynamics)
        self.joints, self.speeds = self.model.joints_at(pusher), np.zeros(len(self.model.limits))
        self.points, self.rotation = self.model.chain(self.joints)[1:]
        self.velocity = self.acceleration = np.zeros(3)  # of the ball
        self.error = rng.normal(0, [g.hand_eye_mm / 1e3] * 3 + [np.deg2rad(g.hand_eye_deg)] * 3)
        self.bias, self.noise = rng.normal(0, g.force_bias, 3), rng.normal(0, g.force_noise, 3)  # N
        self.past = deque(maxlen=1 + round(g.latency * ik.STEPS))
        self.joined, self.ended, self.held, self.nudges = False, False, 0.0, deque(maxlen=100)
        self.since, self.coming = 0, (-np.inf, None)  # steps since the last image; the next one's time, and its future
        self.remember()

    @property
    def box(self):
        return self.worlds.box[0]  # the true pose (3,) in m, m, rad

    @property
    def covered(self):
        return self.hand[0] <= self.time < self.hand[1] or time.monotonic() < self.held  # whether a hand is over the tags

    def remember(self):
        self.past.append((self.time, self.box.copy(), self.joints, self.points, self.covered))

    def read_joints(self):
        return self.time, self.joints.copy()

    def read_wrench(self):
        felt = np.append(self.worlds.force[0], 0.0) - self.gaps.tool_mass * self.acceleration
        return self.time, self.rotation.T @ felt + self.bias + self.noise

    def expose(self, index):
        """Time of a state of the past, and the future of its image, which a thread draws."""
        taken, box, joints, points, covered = self.past[index]
        camera, rng = scene.wrist_camera(self.model, joints, self.error), self.rng.spawn(1)[0]
        return taken, speed.pool.submit(scene.photograph, camera, box, points, covered, rng)

    def look_ahead(self):
        """Has a thread draw the image that is due when the control step ends, where the camera is so late that it can be."""
        rest, full = ik.STEPS - self.since, self.past.maxlen
        if 0 <= rest < full:
            self.coming = self.expose(max(0, rest + len(self.past) - full))

    def grab(self):
        due = abs(self.coming[0] - self.past[0][0]) < 0.5 / task.RATE  # in real time a grab is a step early or late
        taken, image = self.coming if due else self.expose(0)
        self.since = 0
        return taken, image.result()

    def command(self, velocity):
        wanted, lag = np.zeros(len(self.joints)) if self.stopped else velocity, self.gaps.servo_lag
        self.speeds = wanted + (self.speeds - wanted) * (np.exp(-1 / ik.QP_RATE / lag) if lag else 0.0)
        self.joints = self.joints + self.speeds / ik.QP_RATE
        before, self.time = self.points[-1], self.time + 1 / ik.QP_RATE
        _, self.points, self.rotation = self.model.chain(self.joints)
        velocity = ik.QP_RATE * (self.points[-1] - before)
        self.acceleration, self.velocity = ik.QP_RATE * (velocity - self.velocity), velocity
        while self.nudges:
            box = self.box + np.append(self.nudges.popleft(), 0.0)
            if geometry.nearest(box, self.points[-1])[0] > 0 and not task.outside(box, self.worlds.pusher[0]):
                self.worlds.place(np.arange(1), box[None], self.worlds.pusher, {})
        self.worlds.step(ik.QP_RATE * (self.points[-1:, :2] - self.worlds.pusher))
        if round(self.time * ik.QP_RATE) % ik.STEPS == 1:  # one draw a control step, and no mean makes it less
            self.noise = self.rng.normal(0, self.gaps.force_noise, 3)
        self.remember()
        self.since += 1

    def stop(self):
        self.stopped, self.speeds = True, np.zeros(len(self.model.limits))

    def join(self, what, way=()):
        """Somebody "cover"s the tags for half a second, asks for the "next" run, or "nudge"s the box by (2,) m; any thread."""
        self.joined = True
        if what == "cover":
            self.held = time.monotonic() + 0.5
        if what == "next":
            self.ended = True
        if what == "nudge":
            self.nudges.append(way)


class VideoCamera:
    """A camera that OpenCV opens, by its number or address: always the newest image, for which nobody waits.

    `latency` is from an exposure to its reading, in s; UserError if OpenCV cannot open it. Leaving it ends its thread and gives
    the device back, unless the device hangs.
    """

    def __init__(self, source, latency):
        self.capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
        if not self.capture.isOpened():
            raise UserError(f"--camera {source}: OpenCV cannot open it; give a device number or an address")
        self.latency, self.left = latency, False
        self.newest = self.read()
        self.thread = threading.Thread(target=self.follow, daemon=True)
        self.thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.left = True
        self.thread.join(1.0)
        if not self.thread.is_alive():
            self.capture.release()

    def read(self):
        good, image = self.capture.read()
        return time.monotonic() - self.latency, image if good else None

    def follow(self):
        while not self.left and self.newest[1] is not None:
            self.newest = self.read()

    def grab(self):
        return self.newest
