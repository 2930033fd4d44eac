"""The tags on the box: a sheet to print, their detection, and a planar fit of the box pose to what was detected."""
from dataclasses import dataclass

import cv2
import numpy as np
from PIL import Image

from common import geometry, task
from common.files import write_atomic

SIZE = 0.022  # m, side of a tag's black square; so small that the white between them keeps the outlines apart
SCALE = 8000  # pixels a m of the sheet's image: a tag of 8 x 8 squares is 176 wide
PITCH = np.array([0.0284, 0.0305])  # m between centres: white margins of 6.4 and 8.5 mm
LEAST = 2  # tags for a fit
DISTORTION = 0.03  # of a tag's side; a tag that is worse is half hidden, and rejected
RESIDUAL = 0.001  # m, rms of the corners; a worse fit is rejected
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)

# (12, 4, 2) in m, box frame: three rows of four tags, the corners in the order in which OpenCV reports them
CORNERS = (np.array([[[x, y]] for y in (1, 0, -1) for x in (-1.5, -0.5, 0.5, 1.5)]) * PITCH
           + np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * SIZE / 2)


def sheet():
    """The top of the box as an image (rows, columns) uint8 with SCALE pixels a m, +x to the right, +y up."""
    image = np.full(np.round(task.BOX[1::-1] * SCALE).astype(int), 255, np.uint8)
    side = round(SIZE * SCALE)
    for i, corners in enumerate(CORNERS):
        left, top = np.round((corners[0] * [1, -1] + task.BOX[:2] / 2) * SCALE).astype(int)
        image[top:top + side, left:left + side] = cv2.aruco.generateImageMarker(DICTIONARY, i, side)
    return image


def print_sheet(path):
    """Writes an A4 page (PDF) at true scale: the sheet, a line to cut along and a ruler of 100 mm."""
    page, image = np.full((round(0.297 * SCALE), round(0.210 * SCALE)), 255, np.uint8), sheet()
    top, left = 300, (page.shape[1] - image.shape[1]) // 2
    bottom, right = top + image.shape[0], left + image.shape[1]
    page[top:bottom, left:right] = image
    cv2.rectangle(page, (left - 2, top - 2), (right + 1, bottom + 1), 0, 3)
    below, first = bottom + 150, (page.shape[1] - SCALE // 10) // 2
    cv2.line(page, (first, below), (first + SCALE // 10, below), 0, 3)
    for x in range(first, first + SCALE // 10 + 1, SCALE // 100):
        cv2.line(page, (x, below - 20), (x, below + 20), 0, 3)
    for i, words in enumerate(("Print at 100 %: this ruler is 100 mm long. Cut along the line.",
                               "+x of the box is to the right, +y up; glue it to the top of the box, 120 mm x 100 mm.")):
        cv2.putText(page, words, (first - 220, below + 90 + 50 * i), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 0, 2, cv2.LINE_AA)
    write_atomic(path, lambda temporary: Image.fromarray(page > 127).save(temporary, resolution=SCALE * 0.0254))


def detector():
    """OpenCV's detector of the tags, with settings for their size in the image."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = 13  # one window: a third of the time
    parameters.minMarkerPerimeterRate = 0.08  # of the image's width: 13 pixels a side; what is smaller is grain, half the time
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.relativeCornerRefinmentWinSize = 0.7  # small squares; OpenCV's 0.3, a pixel, has ten times the error: 0.5 mm
    return cv2.aruco.ArucoDetector(DICTIONARY, parameters)


def fit(corners, ids, camera):
    """Kabsch's rigid fit of the box to detected corners (k, 4, 2) in pixels, which lie in the known plane of its top.

    Returns the pose (3,) in m, m, rad and the residual, the rms distance of the corners in m.
    """
    seen, known = camera.on_plane(corners.reshape(-1, 2), task.BOX[2]), CORNERS[ids].reshape(-1, 2)
    a, b = known - known.mean(0), seen - seen.mean(0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    turn = geometry.rotation(angle)
    return np.append(seen.mean(0) - turn @ known.mean(0), angle), np.sqrt(np.square(b - a @ turn.T).sum(1).mean())


@dataclass
class Sight:
    """What the camera knows of the box after a frame."""

    seen: np.ndarray | None  # pose (3,) in m, m, rad: of this frame, or the last one seen; None before the first
    age: int  # frames since that was; above 0 the box is occluded
    residual: float  # of this frame's fit, m; nan without one
    corners: np.ndarray  # (k, 4, 2) pixels, detected in this frame


class Tracker:
    """Follows the box from frame to frame; an episode's start needs a new one."""

    def __init__(self):
        self.detector, self.pose, self.age = detector(), None, 0

    def update(self, image, camera):
        """Sight after an image (rows, columns, 3) uint8, taken by `camera` where it was then."""
        corners, ids, _ = self.detector.detectMarkers(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
        corners, ids = np.array(corners, float).reshape(-1, 4, 2), np.array([] if ids is None else ids, int).ravel()
        seen = camera.on_plane(corners.reshape(-1, 2), task.BOX[2]).reshape(-1, 4, 2)
        sides = np.linalg.norm(seen - np.roll(seen, 1, 1), axis=2)
        good = (ids < len(CORNERS)) & (np.abs(sides / SIZE - 1) <= DISTORTION).all(1)
        corners, ids = corners[good], ids[good]
        pose, residual = fit(corners, ids, camera) if len(ids) >= LEAST else (None, np.nan)
        self.pose, self.age = (pose, 0) if residual <= RESIDUAL else (self.pose, self.age + 1)
        return Sight(self.pose, self.age, residual, corners)
