"""The KUKA LBR iiwa 14 R820 with a pusher on its flange: forward kinematics, Jacobian, limits.

World frame: the workspace's (task.py), z up from the table. Tool frame: the flange's, moved along z to the pusher's ball.
"""
import numpy as np

from common import task

# Data sheet of the arm: axes and the way from each to the next, along z (m); limits of angle (rad) and speed (rad/s)
AXES = np.array([[0, 0, 1], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 1]], float)
LENGTHS = np.array([0.36, 0.0, 0.42, 0.0, 0.40, 0.0, 0.126])
LIMITS = np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0])
SPEEDS = np.deg2rad([85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0])

# Where it stands: 0.4 m above the table, behind the middle of the workspace's long side, facing it
BASE = np.array([0.0, -0.5, 0.4])  # m
FACING = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
TOOL = 0.25  # m, from the flange to the centre of the ball
HEIGHT = task.World.pusher_height  # m, of the ball's centre above the table: half of the box's height
DOWN = FACING @ np.diag([-1.0, 1.0, -1.0])  # rotation of a tool that points down
POSTURE = np.deg2rad([0.0, 84.0, 0.0, -84.0, 0.0, 12.0, 0.0])  # over the middle of the workspace

_SKEW = np.array([[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in AXES])  # cross products with the axes
_SKEW2 = _SKEW @ _SKEW
_CROSS = np.array([[[(i - j) * (j - k) * (k - i) / 2 for k in range(3)] for j in range(3)] for i in range(3)])


def chain(q):
    """Kinematics at joint angles (7,), world frame.

    Returns axes (7, 3) of the joints; points (8, 3) in m, one on each axis and the ball's centre; the tool's rotation (3, 3).
    """
    turns = np.eye(3) + np.sin(q)[:, None, None] * _SKEW + (1 - np.cos(q))[:, None, None] * _SKEW2  # Rodrigues
    rotation, point, axes, points = FACING, BASE, np.empty((7, 3)), np.empty((8, 3))
    for i, length in enumerate(LENGTHS):
        axes[i], points[i] = rotation @ AXES[i], point
        rotation = rotation @ turns[i]
        point = point + length * rotation[:, 2]
    points[7] = point + TOOL * rotation[:, 2]
    return axes, points, rotation


def _cross(a, b):
    """np.cross of (n, 3) and (n, 3), at a fifth of its time."""
    return np.einsum("ijk,nj,nk->ni", _CROSS, a, b)


def jacobian(axes, points):
    """(6, 7): velocity of the ball's centre and angular velocity of the tool, world frame, for each joint's rate."""
    return np.concatenate([_cross(axes, points[7] - points[:7]), axes], 1).T


def turned(rotation):
    """Rotation vector (3,) in rad, world frame, to first order, that brings the tool's rotation (3, 3) to DOWN."""
    return 0.5 * _cross(rotation.T, DOWN.T).sum(0)


def joints_at(xy):
    """Joint angles (7,) with the ball over (2,) at HEIGHT, pointing down, near POSTURE; ValueError if that is out of reach."""
    q, goal = POSTURE.copy(), np.array([*xy, HEIGHT])
    for _ in range(200):
        axes, points, rotation = chain(q)
        error, j = np.concatenate([goal - points[7], turned(rotation)]), jacobian(axes, points)
        if np.abs(error).max() < 1e-9:
            return q
        inverse = np.linalg.pinv(j, rcond=1e-3)
        q = q + inverse @ np.clip(error, -0.05, 0.05) + 0.1 * (np.eye(7) - inverse @ j) @ (POSTURE - q)
    raise ValueError(f"no joint angles put the pusher over {xy}")
