"""Another arm, for the tests: six joints with the lengths of a UR5e, and no elbow to spare."""
import numpy as np

from common.robot import hardware
from common.robot.model import Model

SIX = Model(
    axes=np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 1, 0], [0, 0, -1], [0, 1, 0]], float),
    offsets=np.array([[0, 0, 0.1625], [0.425, 0, 0], [0.3922, 0, 0], [0, 0.1333, 0], [0, 0, -0.0997], [0, 0.0996, 0]]),
    limits=np.deg2rad([180.0, 180.0, 165.0, 180.0, 180.0, 270.0]),
    speeds=np.deg2rad([120.0, 120.0, 150.0, 180.0, 180.0, 180.0]),
    base=np.array([0.0, -0.6, 0.3]),
    facing=np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    tool=np.array([0.0, 0.15, 0.0]),
    down=np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]),
    posture=np.deg2rad([-12.8, 68.1, -101.6, -56.5, -90.0, -12.8]),
)


class SixJoints(hardware.SimulatedArm):
    model = SIX
