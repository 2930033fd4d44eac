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
RADIUS = 0.013  # the spherical pusher

# Time and actions (sec. 4): 11 bins a velocity, bin k is (k - 5) * 0.01 m/s
RATE = 15  # control frequency, Hz
BINS = 11
MAX_SPEED = 0.05  # m/s, along each axis
SPEEDS = np.linspace(-MAX_SPEED, MAX_SPEED, BINS)

# Success and reward (sec. 4)
TOLERANCE = np.array([0.01, np.deg2rad(15)])  # m, rad
R_SUCCESS, R_OUT = 50.0, -10.0
K_TRANS, K_ROT, K_SPEED = 0.1, 0.02, 0.004

# Dynamics and starts
GRAVITY = 9.81  # m/s^2
INNER = np.array([0.20, 0.059])  # m, half widths of the inner starts of a box's centre
START_GAP = 0.001  # m, least distance between pusher and box
STARTS = ("box", "centre", "inner")

# Worlds
NOISE = (0.0025, 0.0025, 0.05, 0.7, 0.7)  # standard deviation, in m, rad, N (tab. occlusion_and_noise_params)
C_060 = (0.4959084413236055,) * 2  # support of c = 0.060 m, the only one until c was drawn for each episode
DRAWN = ("mass", "mu_static", "mu_dynamic", "mu_pusher", "restitution")  # for an episode, from ranges, in this order
Range = tuple[float, float]


def mean_distance(sides):
    """Mean distance of the points of a rectangle with sides (2,) from its centre, m."""
    x, y = np.asarray(sides) / 2
    return (2 * np.hypot(x, y) + x**2 / y * np.arcsinh(y / x) + y**2 / x * np.arcsinh(x / y)) / 6


@dataclass(frozen=True)
class World:
    """What is drawn for an episode, and from where; ranges are uniform. The defaults are the study's, and `before` is
    what the code did in runs that do not know a field. Raises ValueError: no such world.
    """

    # within the workspace: the box, its centre; inner: far from the borders
    starts: Literal[STARTS] = field(default="box", metadata={"before": "inner"})
    box: tuple[float, float, float] = (0.12, 0.10, 0.07)  # length, width, height in m (appendix A)
    mass: Range = (3.0, 3.5)  # of the box, kg (tab. dynamics_randomization)
    mu_static: Range = (0.3, 0.5)  # box on table, at least its mu_dynamic (tab. dynamics_randomization)
    mu_dynamic: Range = (0.1, 0.3)  # box on table (tab. dynamics_randomization)
    mu_pusher: Range = (0.1, 0.3)  # pusher on box; the paper's table has one row for all dynamic friction
    restitution: Range = (0.1, 0.7)  # pusher on box (tab. dynamics_randomization)
    # friction's c, from even pressure under the box (0) to all on its corners (1)
    support: Range = field(default=(0.0, 1.0), metadata={"before": C_060})
    # distance of friction's centre from the box's in m, in a random direction: a push at half height moves the pressure
    support_offset: Range = field(default=(0.0, 0.008), metadata={"before": (0.0, 0.0)})
    pusher_height: float = 0.035  # of its centre above the table, m
    noise: tuple[float, float, float, float, float] = NOISE  # of a step: box x, y (m), theta (rad), force x, y (N)
    bias: tuple[float, float, float, float, float] = NOISE  # of an episode, likewise (tab. occlusion_and_noise_params)
    occlusion_start: float = 1 / 30  # probability at each visible step (tab. occlusion_and_noise_params)
    occlusion: Range = (10.0, 5.0)  # mean and standard deviation of its duration in s (tab. occlusion_and_noise_params)
    max_force: float = 10.0  # clip of each axis, N (appendix B)
    time_limit: float = 20.0  # of an episode, s (sec. 4)
    late, gain, surface = 0, 1.0, 2.0  # see Other

    def __post_init__(self):
        for name, value in vars(self).items():
            if name != "starts" and not np.isfinite(value).all():
                raise ValueError(f"--{name.replace('_', '-')} {value}: finite numbers")
        diagonal = float(np.hypot(*self.box[:2]))
        if min(self.box) <= 0 or diagonal >= min(WORKSPACE):
            raise ValueError(f"--box {self.box}: of its diagonal, {diagonal:.2f} m, the workspace leaves no room to start")
        largest = {"restitution": 1.0, "support": 1.0, "support_offset": min(self.box[:2]) / 2}
        for name in (*DRAWN, "support", "support_offset"):
            (low, high), most = getattr(self, name), largest.get(name, np.inf)
            if not 0 <= low <= high <= most or name == "mass" and not low:
                upper = f", up to {most:g}" if name in largest else ""
                raise ValueError(f"--{name.replace('_', '-')} {low} {high}: a range, the least first{upper}")
        if not RADIUS <= self.pusher_height <= self.box[2]:
            raise ValueError(f"--pusher-height {self.pusher_height}: in m, from its radius, {RADIUS}, to the box's height")
        if self.max_force <= 0:
            raise ValueError(f"--max-force {self.max_force}: above 0")
        if not 1 <= self.time_limit <= 3600:
            raise ValueError(f"--time-limit {self.time_limit}: in s, 1 to 3600")
        if not self.occlusion_start <= 1:
            raise ValueError(f"--occlusion-start {self.occlusion_start}: at most 1")

    @classmethod
    def of(cls, settings):
        """The world that a record's settings name; what they do not know is what the code did then."""
        past = {known.name: settings.get(known.name, known.metadata.get("before", known.default)) for known in fields(cls)}
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in past.items()})

    @property
    def horizon(self):
        """Steps of an episode."""
        return round(RATE * self.time_limit)

    @property
    def dynamics(self):
        """Ranges of what is drawn for an episode, in this order: names and units as in simulator.Worlds."""
        even, corners = mean_distance(self.box[:2]), np.linalg.norm(self.box[:2]) / 2
        return {name: getattr(self, name) for name in DRAWN} | {
            "limit_surface_c": tuple(even + share * (corners - even) for share in self.support)}

    def draw(self, rng, count, given={}):
        """Dynamics of `count` episodes, {name: (count,)} as simulator.Worlds takes them, around those that are given."""
        drawn = {name: rng.uniform(*limits, count) for name, limits in self.dynamics.items()}
        distance, angle = rng.uniform(*self.support_offset, count), rng.uniform(-np.pi, np.pi, count)
        drawn |= {"support_x": distance * np.cos(angle), "support_y": distance * np.sin(angle)}
        drawn["mu_static"] = np.maximum(drawn["mu_static"], (drawn | given)["mu_dynamic"])
        return drawn | given

    def centre_range(self, angle):
        """Half widths (N, 2) in m of the rectangle about the target in which the centres of boxes at angles (N,) start."""
        cos, sin = np.abs(np.cos(angle)), np.abs(np.sin(angle))
        corners = np.stack([cos, sin, sin, cos], -1).reshape(-1, 2, 2) @ self.box[:2] / 2  # the farthest, along x and y
        return {"box": HALF - corners, "centre": HALF, "inner": INNER}[self.starts] + 0 * corners


@dataclass(frozen=True)
class Other(World):
    """A world with what no training knows, to evaluate in."""

    late: int = World.late  # steps by which the camera's frames are
    gain: float = World.gain  # of the force sensor
    surface: float = World.surface  # exponent of the limit surface; 2 is an ellipsoid


BOX = np.array(World.box)  # the one that the robot's tags, arm and pictures are made for


def wrap(angle):
    """Angle in [-pi, pi), rad."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def scale(state, max_force=World.max_force):
    """States (..., 7) to network inputs (..., 8): x, y, sin, cos, pusher x, y, force x, y, each in [-1, 1] (appendix B)."""
    theta, force = state[..., 2:3], np.clip(state[..., 5:7], -max_force, max_force)
    parts = state[..., :2] / HALF, np.sin(theta), np.cos(theta), state[..., 3:5] / HALF, force / max_force
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
