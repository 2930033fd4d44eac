"""The task from above (fig. sim): the workspace, the target, the box, the pusher."""
import cv2
import numpy as np

from common import geometry, task
from common.task import World

VIEW = 1.1 * task.WORKSPACE[0]  # m, the width of a top view
SQUARE = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
TARGET_COLOUR, BOX_COLOUR, PUSHER_COLOUR, BORDER_COLOUR = (170, 205, 240), (30, 60, 130), (210, 40, 40), (150, 150, 150)  # RGB


def corners(pose, size=World.box):
    """Corners (4, 2) of the box at a pose (3,), m."""
    return SQUARE * size[:2] / 2 @ geometry.rotation(pose[2]).T + pose[:2]


def front(pose, size=World.box):
    """From the centre of the box at a pose (3,) to the middle of its +x side: points (2, 2), m."""
    return np.stack([pose[:2], pose[:2] + geometry.rotation(pose[2])[:, 0] * size[0] / 2])


def pixels(points, width):
    """Points (..., 2) in m as integer 1/16 pixels, OpenCV's shift of 4, of a top view that is `width` pixels wide."""
    return np.round(16 * (np.asarray(points) * [1, -1] * width / VIEW + [width / 2, width / 4])).astype(np.int32)


def outline(image, pose, colour, size=World.box):
    """Draws the box at a pose (3,), with a line to its +x side."""
    cv2.polylines(image, [pixels(corners(pose, size), image.shape[1])], True, colour, 3, cv2.LINE_AA, 4)
    cv2.line(image, *pixels(front(pose, size), image.shape[1]).tolist(), colour, 3, cv2.LINE_AA, 4)


def top_view(state, width=800, size=World.box):
    """Image (width / 2, width, 3) uint8 RGB of a state (7,): target light blue, box dark blue, pusher red (fig. sim)."""
    image = np.full((width // 2, width, 3), 255, np.uint8)
    cv2.polylines(image, [pixels(SQUARE * task.HALF, width)], True, BORDER_COLOUR, 2, cv2.LINE_AA, 4)
    cv2.fillPoly(image, [pixels(corners(np.zeros(3), size), width)], TARGET_COLOUR, cv2.LINE_AA, 4)
    cv2.fillPoly(image, [pixels(corners(state[:3], size), width)], BOX_COLOUR, cv2.LINE_AA, 4)
    cv2.line(image, *pixels(front(state[:3], size), width).tolist(), (255, 255, 255), 2, cv2.LINE_AA, 4)
    cv2.circle(image, pixels(state[3:5], width).tolist(), int(16 * task.RADIUS * width / VIEW), PUSHER_COLOUR, -1, cv2.LINE_AA, 4)
    return image
