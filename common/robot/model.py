"""An arm in numbers, and what follows from them: forward kinematics, Jacobian, joint angles for a place of the pusher.

World frame: the workspace's (task.py), z up from the table. Tool frame: the flange's, moved to the pusher's ball; at angles of
zero all frames of an arm are parallel to its base's.
"""
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from common import task

_CROSS = np.array([[[(i - j) * (j - k) * (k - i) / 2 for k in range(3)] for j in range(3)] for i in range(3)])


def _cross(a, b):
    """np.cross of (n, 3) and (n, 3), at a fifth of its time."""
    return np.einsum("ijk,nj,nk->ni", _CROSS, a, b)


@dataclass(frozen=True, eq=False)
class Model:
    """An arm of n joints that turn, and where it stands; axes and offsets in the base's frame, at angles of zero.

    Its arrays are not to be changed: `chain` remembers.
    """

    axes: np.ndarray  # (n, 3), unit vectors along the joints
    offsets: np.ndarray  # (n, 3) in m, from each joint to the next, and from the last to the flange
    limits: np.ndarray  # (n,) in rad, to either side
    speeds: np.ndarray  # (n,) in rad/s, of the joints
    base: np.ndarray  # (3,) in m, of the first joint, world frame
    facing: np.ndarray  # (3, 3), rotation of the base, world frame
    tool: np.ndarray  # (3,) in m, from the flange to the centre of the ball, tool frame
    down: np.ndarray  # (3, 3), rotation of the tool when it points down, world frame
    posture: np.ndarray  # (n,) in rad, that it keeps near to: over the middle of the workspace
    height: float = task.World.pusher_height  # m, of the ball's centre above the table

    @cached_property
    def _skew(self):
        """Cross products with the axes (n, 3, 3), and their squares."""
        skew = np.array([[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in self.axes])
        return skew, skew @ skew

    def chain(self, q):
        """Kinematics at joint angles (n,), world frame.

        Returns axes (n, 3) of the joints; points (n + 2, 3) in m: one on each axis, the flange, the ball's centre; the tool's
        rotation (3, 3). All are read-only, and kept for a while: arm, guard and program ask for the same angles.
        """
        return self._chain(np.asarray(q, float).tobytes())

    @lru_cache(maxsize=64)
    def _chain(self, angles):
        q, n, (skew, skew2) = np.frombuffer(angles), len(self.limits), self._skew
        turns = np.eye(3) + np.sin(q)[:, None, None] * skew + (1 - np.cos(q))[:, None, None] * skew2  # Rodrigues
        rotation, point, axes, points = self.facing, self.base, np.empty((n, 3)), np.empty((n + 2, 3))
        for i, offset in enumerate(self.offsets):
            axes[i], points[i] = rotation @ self.axes[i], point
            rotation = rotation @ turns[i]
            point = point + rotation @ offset
        points[n:] = point, point + rotation @ self.tool
        for part in (axes, points, rotation):
            part.flags.writeable = False
        return axes, points, rotation

    def jacobian(self, axes, points):
        """(6, n): velocity of the ball's centre and angular velocity of the tool, world frame, for each joint's rate."""
        return np.concatenate([_cross(axes, points[-1] - points[:-2]), axes], 1).T

    def turned(self, rotation):
        """Rotation vector (3,) in rad, world frame, to first order, that brings the tool's rotation (3, 3) to `down`."""
        return 0.5 * _cross(rotation.T, self.down.T).sum(0)

    def joints_at(self, xy):
        """Joint angles (n,) with the ball over (2,), pointing down, near the posture; ValueError if that is out of reach."""
        q, goal = self.posture.copy(), np.array([*xy, self.height])
        for _ in range(200):
            axes, points, rotation = self.chain(q)
            error, j = np.concatenate([goal - points[-1], self.turned(rotation)]), self.jacobian(axes, points)
            if np.abs(error).max() < 1e-9:
                return q
            inverse = np.linalg.pinv(j, rcond=1e-3)
            nearer = 0.1 * (np.eye(len(q)) - inverse @ j) @ (self.posture - q)
            q = q + inverse @ np.clip(error, -0.05, 0.05) + nearer
        raise ValueError(f"no joint angles put the pusher over {xy}")
