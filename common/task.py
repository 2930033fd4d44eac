"""The task in SI units: every constant of the paper's simulated pushing task, with its unit and its source.

A state is the row (box x, box y, box theta, pusher x, pusher y, force x, force y) in m, m, rad, m, m, N, N. The frame lies
at the centre of the workspace with x along its long side; the target is the pose (0, 0, 0).
"""
from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np

# Geometry (appendix A), m
WORKSPACE = np.array([0.6, 0.3])
HALF = WORKSPACE / 2
BOX = np.array([0.12, 0.10, 0.07])
RADIUS = 0.013  # the spherical pusher

# Time and actions (sec. 4): 11 bins a velocity, bin k is (k - 5) * 0.01 m/s
RATE = 15  # control frequency, Hz
HORIZON = 300  # steps, 20 s
BINS = 11
MAX_SPEED = 0.05  # m/s, along each axis
SPEEDS = np.linspace(-MAX_SPEED, MAX_SPEED, BINS)

# Success and reward (sec. 4)
TOLERANCE = np.array([0.01, np.deg2rad(15)])  # m, rad
R_SUCCESS, R_OUT = 50.0, -10.0
K_TRANS, K_ROT, K_SPEED = 0.1, 0.02, 0.004

# Dynamics randomisation (appendix A, tab. dynamics_randomization): uniform in [low, high]
MASS = (3.0, 3.5)  # kg
MU_STATIC = (0.3, 0.5)
MU_DYNAMIC = (0.1, 0.3)  # box on table; the pusher on the box is drawn from the same row
RESTITUTION = (0.1, 0.7)
GRAVITY = 9.81  # m/s^2

# Sensing (tab. occlusion_and_noise_params); the per-episode bias and the per-step noise share one standard deviation
NOISE = np.array([0.0025, 0.0025, 0.05, 0.7, 0.7])  # box x, y (m), theta (rad), force x, y (N)
OCCLUSION_START = 1 / 30  # probability at each visible step
OCCLUSION_MEAN, OCCLUSION_STD = 10.0, 5.0  # s
MAX_FORCE = 10.0  # N, clip of each axis (appendix B)

# Starts
START_BOX = np.array([0.20, 0.059])  # m, half widths of the inner starts of a box's centre: the pusher gets behind it at once
START_GAP = 0.001  # m, least distance between pusher and box
STARTS = ("box", "centre", "inner")

C_060 = (0.4959084413236055,) * 2  # support of c = 0.060 m, the only one until c was drawn for each episode


def mean_distance(sides):
    """Mean distance of the points of a rectangle with sides (2,) from its centre, m."""
    x, y = np.asarray(sides) / 2
    return (2 * np.hypot(x, y) + x**2 / y * np.arcsinh(y / x) + y**2 / x * np.arcsinh(x / y)) / 6


def since(default, before):
    """A field that older runs do not know, whose code did `before`."""
    return field(default=default, metadata={"before": before})


@dataclass(frozen=True)
class World:
    """What is drawn for an episode, and from where. The defaults are the study's."""

    starts: Literal[STARTS] = since("box", "inner")  # what lies within the workspace: the box, its centre; inner: far from borders
    support: tuple[float, float] = since((0.0, 1.0), C_060)  # least and greatest c, from even pressure (0) to four corners (1)

    @classmethod
    def of(cls, settings):
        """The world that a record's settings name; what they do not know is what the code did then."""
        past = {known.name: settings.get(known.name, known.metadata.get("before", known.default)) for known in fields(cls)}
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in past.items()})

    @property
    def limit_surface_c(self):
        """Range (2,) of friction torque / friction force, m."""
        even, corners = mean_distance(BOX[:2]), np.linalg.norm(BOX[:2] / 2)
        return tuple(even + share * (corners - even) for share in self.support)

    @property
    def dynamics(self):
        """Ranges (2,) of what is drawn for an episode, uniformly, in this order: {name: (low, high)}, names and units of Worlds."""
        return {"mass": MASS, "mu_static": MU_STATIC, "mu_dynamic": MU_DYNAMIC, "mu_pusher": MU_DYNAMIC,
                "restitution": RESTITUTION, "limit_surface_c": self.limit_surface_c}

    def centre_range(self, angle):
        """Half widths (N, 2) in m of the rectangle about the target in which the centres of boxes at angles (N,) start."""
        cos, sin = np.abs(np.cos(angle)), np.abs(np.sin(angle))
        corners = np.stack([cos, sin, sin, cos], -1).reshape(-1, 2, 2) @ BOX[:2] / 2  # the farthest, along x and y
        return {"box": HALF - corners, "centre": HALF, "inner": START_BOX}[self.starts] + 0 * corners


def wrap(angle):
    """Angle in [-pi, pi), rad."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def scale(state):
    """States (..., 7) to network inputs (..., 8): x, y, sin, cos, pusher x, y, force x, y, each in [-1, 1] (appendix B)."""
    theta, force = state[..., 2:3], np.clip(state[..., 5:7], -MAX_FORCE, MAX_FORCE)
    parts = state[..., :2] / HALF, np.sin(theta), np.cos(theta), state[..., 3:5] / HALF, force / MAX_FORCE
    return np.concatenate(parts, -1, dtype=np.float32)


def unscale_pose(q):
    """Scaled poses (..., 4) = x, y, sin, cos to (..., 3) in m, m, rad."""
    return np.concatenate([q[..., :2] * HALF, np.arctan2(q[..., 2], q[..., 3])[..., None]], -1)


def reached(box, tolerance=1.0):
    """Whether poses (..., 3) lie within `tolerance` times 1 cm and 15 degrees of the target (sec. 4)."""
    distance, angle = np.linalg.norm(box[..., :2], axis=-1), np.abs(wrap(box[..., 2]))
    return (distance <= tolerance * TOLERANCE[0]) & (angle <= tolerance * TOLERANCE[1])


def outside(box, pusher):
    """Whether the centre of box (..., 3) or pusher (..., 2) has left the workspace (appendix A)."""
    return (np.abs(box[..., :2]) > HALF).any(-1) | (np.abs(pusher) > HALF).any(-1)


def reward(box, velocity, success, out):
    """r = r_term + k1 (1 - d_trans) + k2 (1 - d_rot) + k3 (1 - v_p) (sec. 4) of poses (N, 3), pusher velocities (N, 2)."""
    d_trans = np.linalg.norm(box[:, :2], axis=1) / np.linalg.norm(WORKSPACE)
    d_rot = np.abs(wrap(box[:, 2])) / np.pi
    v_p = np.linalg.norm(velocity, axis=1) / (MAX_SPEED * np.sqrt(2))
    r_term = R_SUCCESS * success + R_OUT * (out & ~success)
    return r_term + K_TRANS * (1 - d_trans) + K_ROT * (1 - d_rot) + K_SPEED * (1 - v_p)
