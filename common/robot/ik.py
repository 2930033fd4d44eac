"""Joint velocities for a wanted velocity of the pusher: a quadratic program, built here and solved by Clarabel.

    minimise    |W^1/2 (J_xy,yaw qd - v)|^2 + DAMPING |qd|^2 + POSTURE_WEIGHT |qd - POSTURE_GAIN (q_posture - q)|^2
    subject to  height and tilt held:              J_z,tilt qd = -HOLD * their errors
                joint speeds and positions:        lower(q) <= qd <= upper(q)
                the workspace and MARGIN beyond:   J_xy qd <= HOLD (limit - xy), and likewise below
"""
import copy
import functools
import warnings

import numpy as np
import qpsolvers
from scipy.sparse import csc_matrix

from common import task

warnings.filterwarnings("ignore", module="qpsolvers")  # what the solver says of a failure, solve returns

QP_RATE = 150  # QP steps a second
STEPS = QP_RATE // task.RATE  # of a control step
MARGIN = 0.010  # m, how far beyond the workspace the pusher may go
WEIGHTS = np.array([1e4, 1e4, 1e2])  # of x, y (m/s) and yaw (rad/s): far above the posture's, which would leak into the path
DAMPING, POSTURE_WEIGHT, POSTURE_GAIN = 1e-2, 1e-2, 0.2  # the gain in 1/s
HOLD = 10.0  # 1/s, decay of the errors of height, tilt and yaw; a limit is approached no faster than HOLD times its distance
LIMIT_GAP = np.deg2rad(2.0)  # rad, kept between a joint and its limit
CLIMB, TURN = 0.02, 0.2  # m/s and rad/s, most that errors of height and of angles may ask for


@functools.cache
def _full(shape):
    """Ones, in every place of a sparse matrix; nobody may take one out."""
    full = csc_matrix(np.ones(shape))
    full.indices.flags.writeable = full.indptr.flags.writeable = False
    return full


def _sparse(matrix):
    """A full matrix as Clarabel wants it; scipy, which looks for zeros, takes 20 times as long."""
    full = copy.copy(_full(matrix.shape))
    full.data = matrix.ravel("F")
    return full


def build(model, q, velocity):
    """The program of a model.Model at joint angles q (n,) rad for a wanted velocity (2,) m/s of the pusher, world frame."""
    axes, points, rotation = model.chain(q)
    j, xy, turn, one = model.jacobian(axes, points), points[-1, :2], HOLD * model.turned(rotation), np.eye(len(q))
    turn, rise = np.clip(turn, -TURN, TURN), np.clip(HOLD * (model.height - points[-1, 2]), -CLIMB, CLIMB)
    free, wanted = j[[0, 1, 5]], np.append(np.clip(velocity, -task.MAX_SPEED, task.MAX_SPEED), turn[2])
    hessian = free.T @ (WEIGHTS[:, None] * free) + (DAMPING + POSTURE_WEIGHT) * one
    gradient = -free.T @ (WEIGHTS * wanted) - POSTURE_WEIGHT * POSTURE_GAIN * (model.posture - q)
    upper, lower = (np.clip(HOLD * (side * (model.limits - LIMIT_GAP) - q), -model.speeds, model.speeds) for side in (1, -1))
    ahead, behind = (np.maximum(HOLD * (task.HALF + MARGIN - side * xy), -task.MAX_SPEED) for side in (1, -1))
    bounds = np.concatenate([one, -one, j[:2], -j[:2]])
    return qpsolvers.Problem(_sparse(hessian), gradient, _sparse(bounds), np.concatenate([upper, -lower, ahead, behind]),
                             _sparse(j[2:5]), np.append(rise, turn[:2]))


def solve(model, q, velocity):
    """Joint velocities (n,) rad/s, or None: an input is not finite, the program is infeasible, or was not solved."""
    if not (np.isfinite(q).all() and np.isfinite(velocity).all()):
        return None
    solution = qpsolvers.solve_problem(build(model, q, velocity), solver="clarabel")
    return solution.x if solution.found and np.isfinite(solution.x).all() else None  # x is filled even in failure
