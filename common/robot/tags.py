"""The tags on the box: a sheet to print, their detection, and a planar fit of the box pose to what was detected."""
from dataclasses import dataclass

import cv2
import numpy as np
from PIL import Image

from common import task
from common.artifacts import write_atomic

SIZE = 0.022  # m, side of a tag's black square; so small that the white between them keeps the outlines apart
SCALE = 8000  # pixels a m of the sheet's image: a tag of 8 x 8 squares is 176 wide
COLUMNS, ROWS = 4, 3
PITCH = np.array([0.0284, 0.0305])  # m between centres: white margins of 6.4 and 8.5 mm
LEAST = 2  # tags for a fit
DISTORTION = 0.03  # of a tag's side; a tag that is worse is rejected
RESIDUAL = 0.001  # m, rms of the corners; a worse fit is rejected
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)


def _corners():
    column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    centres = np.stack([column.ravel() - (COLUMNS - 1) / 2, (ROWS - 1) / 2 - row.ravel()], 1) * PITCH
    return centres[:, None] + np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * SIZE / 2


CORNERS = _corners()  # (12, 4, 2) in m, box frame, in the order in which OpenCV reports a tag's corners


def sheet():
    """The top of the box as an image (rows, columns) uint8 with SCALE pixels a m, +x to the right, +y up."""
    width, height = np.round(task.BOX[:2] * SCALE).astype(int)
    image = np.full((height, width), 255, np.uint8)
    side = round(SIZE * SCALE)
    for i, corners in enumerate(CORNERS):
        left, top = np.round((corners[0] * [1, -1] + task.BOX[:2] / 2) * SCALE).astype(int)
        image[top:top + side, left:left + side] = cv2.aruco.generateImageMarker(DICTIONARY, i, side)
    return image


def print_sheet(path):
    """Writes an A4 page (PDF) at true scale: the sheet, a line to cut along and a ruler of 100 mm."""
    page = np.full((round(0.297 * SCALE), round(0.210 * SCALE)), 255, np.uint8)
    image = sheet()
    top, left = 300, (page.shape[1] - image.shape[1]) // 2
    page[top:top + image.shape[0], left:left + image.shape[1]] = image
    cv2.rectangle(page, (left - 2, top - 2), (left + image.shape[1] + 1, top + image.shape[0] + 1), 0, 3)
    below, first = top + image.shape[0] + 150, (page.shape[1] - SCALE // 10) // 2
    cv2.line(page, (first, below), (first + SCALE // 10, below), 0, 3)
    for x in range(first, first + SCALE // 10 + 1, SCALE // 100):
        cv2.line(page, (x, below - 20), (x, below + 20), 0, 3)
    for i, words in enumerate(("Print at 100 %: this ruler is 100 mm long. Cut along the line.",
                               "+x of the box is to the right, +y up; glue it to the top of the box, 120 mm x 100 mm.")):
        cv2.putText(page, words, (first - 220, below + 90 + 50 * i), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 0, 2, cv2.LINE_AA)
    write_atomic(path, lambda temporary: Image.fromarray(page > 127).save(temporary, resolution=SCALE * 0.0254))


def detector():
    """OpenCV's, with one threshold window (a third of the time) and corners refined within 0.7 of a tag's small squares.

    OpenCV's own 0.3 are one pixel here: ten times the error, 0.5 mm.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = 13
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.relativeCornerRefinmentWinSize = 0.7
    return cv2.aruco.ArucoDetector(DICTIONARY, parameters)


def fit(corners, ids, camera):
    """Pose of the box from detected corners, which lie in the known plane of its top: Kabsch's rigid fit.

    Args:
        corners: (k, 4, 2) pixels; ids: (k,).
        camera: scene.Camera.
    Returns:
        pose (3,) in m, m, rad and the residual, the rms distance in m of the corners.
    """
    seen, known = camera.on_plane(corners.reshape(-1, 2), task.BOX[2]), CORNERS[ids].reshape(-1, 2)
    a, b = known - known.mean(0), seen - seen.mean(0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.append(seen.mean(0) - turn @ known.mean(0), angle), np.sqrt(np.square(b - a @ turn.T).sum(1).mean())


def square(corners, camera):
    """Which of the detected corners (k, 4, 2) are of a tag whose sides are as long as they should be: nothing half hides it."""
    seen = camera.on_plane(corners.reshape(-1, 2), task.BOX[2]).reshape(-1, 4, 2)
    return (np.abs(np.linalg.norm(seen - np.roll(seen, 1, 1), axis=2) / SIZE - 1) <= DISTORTION).all(1)


@dataclass
class Sight:
    """What the camera knows of the box after a frame."""

    seen: np.ndarray | None
    """pose (3,) in m, m, rad: of this frame, or the last one seen; None before the first"""
    age: int
    """frames since that was; above 0 the box is occluded"""
    residual: float
    """of this frame's fit, m; nan without one"""
    corners: np.ndarray
    """(k, 4, 2) pixels, detected in this frame"""


class Tracker:
    """Follows the box from frame to frame; an episode's start needs a new one."""

    def __init__(self):
        self.detector, self.pose, self.age = detector(), None, 0

    def update(self, image, camera):
        """Sight after an image (rows, columns, 3) uint8, taken by `camera` where it was then."""
        corners, ids, _ = self.detector.detectMarkers(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
        ids = np.zeros(0, int) if ids is None else ids.ravel()
        ours = ids < len(CORNERS)
        corners, ids = np.array(corners, float).reshape(-1, 4, 2)[ours], ids[ours]
        whole = square(corners, camera)
        corners, ids = corners[whole], ids[whole]
        pose, residual = fit(corners, ids, camera) if len(ids) >= LEAST else (None, np.nan)
        if residual <= RESIDUAL:
            self.pose, self.age = pose, 0
        else:
            self.age += 1
        return Sight(self.pose, self.age, residual, corners)
