"""The KUKA LBR iiwa 14 R820 with a pusher on its flange: 0.4 m above the table, behind the workspace's long side, facing it."""
import numpy as np

from common.robot.model import Model

UP = np.array([0.0, 0.0, 1.0])
FACING = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

IIWA = Model(
    # data sheet
    axes=np.array([[0, 0, 1], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 1]], float),
    offsets=np.outer([0.36, 0.0, 0.42, 0.0, 0.40, 0.0, 0.126], UP),
    limits=np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0]),
    speeds=np.deg2rad([85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0]),
    # where it stands and what it carries
    base=np.array([0.0, -0.5, 0.4]),
    facing=FACING,
    tool=0.25 * UP,
    down=FACING @ np.diag([-1.0, 1.0, -1.0]),
    posture=np.deg2rad([0.0, 84.0, 0.0, -84.0, 0.0, 12.0, 0.0]),
)
