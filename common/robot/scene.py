"""Rendered cameras: table, tagged box, pusher, hand and, from outside, the arm; drawn with OpenCV, without any hardware."""
from dataclasses import dataclass

import cv2
import numpy as np

from common import draw, geometry, task
from common.robot import tags

NEAR = 0.03  # m, nothing nearer is drawn
STEM = 0.008  # m, radius of the pusher's stem
HAND = 0.11  # m above the table, where a hand covers the tags
BLUR, NOISE = 0.7, 3.0  # pixels, and grey levels: standard deviations in a camera image
WOOD, BOARD = (165, 195, 215), (120, 160, 200)  # colours are BGR
STEEL, ORANGE, SKIN, RED = (175, 170, 165), (40, 110, 235), (150, 180, 225), (40, 40, 200)


@dataclass
class Camera:
    """A pinhole camera, the centre in the middle of its image."""

    focal: float  # pixels
    size: tuple[int, int]  # width, height in pixels
    rotation: np.ndarray  # (3, 3), its axes (right, down, forward) as columns, world frame
    position: np.ndarray  # (3,) in m

    def project(self, points):
        """Pixels (..., 2) of points (..., 3) in m, and their depths (...) in m."""
        x = (np.asarray(points) - self.position) @ self.rotation
        return self.focal * x[..., :2] / x[..., 2:] + (np.array(self.size) - 1) / 2, x[..., 2]

    def on_plane(self, pixels, height):
        """Points (k, 2) in m where the rays of pixels (k, 2) meet the plane z = height."""
        rays = np.append((pixels - (np.array(self.size) - 1) / 2) / self.focal, np.ones((len(pixels), 1)), 1) @ self.rotation.T
        return self.position[:2] + rays[:, :2] * ((height - self.position[2]) / rays[:, 2:])

    def plane(self, height):
        """Homography (3, 3) from (x, y, 1) in m on the plane z = height to pixels."""
        k = np.array([[self.focal, 0, (self.size[0] - 1) / 2], [0, self.focal, (self.size[1] - 1) / 2], [0, 0, 1]])
        return k @ np.column_stack([self.rotation[:2].T, self.rotation.T @ ([0, 0, height] - self.position)])


def _looking(position, at, right):
    """Rotation of a camera at a position that looks at a point, its right axis as near as can be to `right`."""
    forward = (at - position) / np.linalg.norm(at - position)
    right = right - right @ forward * forward
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward])


# The robot's camera: beside the stem, 0.2 m above the ball and looking at it; 60 degrees wide. World frame, tool pointing down
FOCAL, SIZE = 550.0, (640, 480)
MOUNT = np.array([0.05, -0.05, 0.20])  # m, from the centre of the ball
LOOK = _looking(MOUNT, np.zeros(3), np.array([1.0, 0.0, 0.0]))  # its axes (right, down, forward) as columns
_BESIDE = np.array([0.75, 0.95, 0.75])  # where figures are seen from
OVERVIEW = Camera(780.0, SIZE, _looking(_BESIDE, np.array([0.0, -0.1, 0.2]), np.array([-1.0, 0.75, 0.0])), _BESIDE)


def wrist_camera(model, q, error=np.zeros(6)):
    """The robot's camera at joint angles (n,) of a model.Model.

    `error` (6,) is what hand-eye calibration missed: a shift in m and a rotation vector in rad about the camera, tool frame.
    """
    _, points, rotation = model.chain(q)
    turn = rotation @ cv2.Rodrigues(error[3:])[0] @ model.down.T
    return Camera(FOCAL, SIZE, turn @ LOOK, points[-1] + rotation @ (model.down.T @ MOUNT + error[:3]))


def _table():
    """Texture of 1.4 m x 1.2 m around (0, 0), 1 mm a pixel: wood, the workspace's border and the target's outline."""
    noise = np.random.default_rng(0).normal(0, 60, (1200, 1400)).astype(np.float32)
    grain = 2.5 * cv2.GaussianBlur(noise, (0, 0), sigmaX=40, sigmaY=1)
    image = np.clip(np.array(WOOD) + grain[..., None], 0, 255).astype(np.uint8)
    for corners, colour in ((draw.SQUARE * task.HALF, (110, 110, 110)), (draw.corners(np.zeros(3)), (190, 120, 40))):
        cv2.polylines(image, [np.round(corners * [1000, -1000] + [700, 600]).astype(np.int32)], True, colour, 2, cv2.LINE_AA)
    return image


_TABLE = _table()
_TABLE_TO_M = np.array([[0.001, 0, -0.6995], [0, -0.001, 0.5995], [0, 0, 1]])
_TOP = cv2.GaussianBlur(tags.sheet(), (0, 0), 1.5)
_LEFT, _UPPER = tags.SCALE * task.BOX[:2] / 2 - 0.5
_TOP_TO_M = np.array([[1, 0, -_LEFT], [0, -1, _UPPER], [0, 0, tags.SCALE]])
_GRAIN = np.random.default_rng(1).normal(0, NOISE, (2 * SIZE[1], 2 * SIZE[0], 3)).astype(np.int16)


def _fill(image, pixels, colour):
    cv2.fillConvexPoly(image, np.round(np.clip(pixels, -2000, 2000) * 16).astype(np.int32), colour, cv2.LINE_AA, 4)


def _limb(image, camera, a, b, radius_a, radius_b, colour):
    """A rounded cone from a to b, as much of it as lies before the camera."""
    pixels, depth = camera.project(np.stack([a, b]))
    if depth.max() < 2 * NEAR:
        return
    if depth.min() < NEAR:  # cut off what is too near
        if depth[0] >= depth[1]:
            a, b, radius_a, radius_b = b, a, radius_b, radius_a
        share = (2 * NEAR - depth.min()) / (depth.max() - depth.min())
        pixels, depth = camera.project(np.stack([a + share * (b - a), b]))
    along = pixels[1] - pixels[0]
    across = np.array([-along[1], along[0]]) / max(np.linalg.norm(along), 1e-9)
    radii = camera.focal * np.array([radius_a, radius_b]) / depth
    for share, light in ((1.0, 0.8), (0.8, 0.9), (0.5, 1.0)):  # brighter towards the middle
        wide, shade = share * radii, tuple(light * np.array(colour))
        for pixel, radius in zip(pixels, wide):
            if (np.abs(pixel) < 1500).all():
                cv2.circle(image, np.round(16 * pixel).astype(int).tolist(), int(16 * radius), shade, -1, cv2.LINE_AA, 4)
        side = across * wide[:, None]
        _fill(image, np.concatenate([pixels + side, (pixels - side)[::-1]]), shade)


def _box(image, camera, box):
    """The four sides that face the camera, and the top with its tags."""
    ground = draw.corners(box)
    for a, b in zip(ground, np.roll(ground, -1, 0)):
        out = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
        if out @ (camera.position[:2] - a) > 0:
            side = np.array([[*a, 0], [*b, 0], [*b, task.BOX[2]], [*a, task.BOX[2]]])
            shade = 0.62 + 0.18 * out[0] + 0.08 * out[1]
            _fill(image, camera.project(side)[0], tuple(shade * np.array(BOARD)))
    top, _ = camera.project(np.append(ground, np.full((4, 1), task.BOX[2]), 1))
    low = np.maximum(np.floor(top.min(0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(top.max(0)).astype(int) + 2, camera.size)
    if (high <= low).any():
        return
    to_world = np.vstack([np.column_stack([geometry.rotation(box[2]), box[:2]]), [0, 0, 1]]) @ _TOP_TO_M
    crop = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]])
    warp, size = crop @ camera.plane(task.BOX[2]) @ to_world, (high - low).tolist()
    texture = cv2.warpPerspective(_TOP, warp, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    mask = np.zeros(texture.shape, np.uint8)
    _fill(mask, top - low, 255)
    share, part = mask / np.float32(255), image[low[1]:high[1], low[0]:high[0]]
    part[:] = cv2.blendLinear(cv2.cvtColor(texture, cv2.COLOR_GRAY2BGR), part, share, 1 - share)


def render(camera, box, points, hand=False, arm=False):
    """Image (height, width, 3) uint8 BGR of a box pose (3,), the pusher at the arm's points (n + 2, 3), a hand and the arm."""
    image = cv2.warpPerspective(_TABLE, camera.plane(0.0) @ _TABLE_TO_M, camera.size, flags=cv2.INTER_LINEAR,
                                borderMode=cv2.BORDER_CONSTANT, borderValue=(225, 222, 218))
    ball, flange = points[-1], points[-2]
    waist = ball + (flange - ball) * np.clip((task.BOX[2] - ball[2]) / (flange[2] - ball[2]), 0, 1)
    point = box[:2] + geometry.rotation(box[2]) @ geometry.nearest(box, ball[:2])[1]
    behind = (ball[:2] - point) @ (camera.position[:2] - point) > 0  # the box, which a plane at `point` parts from the ball
    if behind:
        _box(image, camera, box)
    _limb(image, camera, ball, waist, STEM, STEM, STEEL)
    _limb(image, camera, ball, ball, task.RADIUS, task.RADIUS, RED)
    if not behind:
        _box(image, camera, box)
    _limb(image, camera, waist, flange, STEM, STEM, STEEL)
    if arm:
        joints = [points[0], *(b for a, b in zip(points[:-2], points[1:-1]) if np.linalg.norm(b - a) > NEAR)]
        for a, b, wide in zip(joints[:-1], joints[1:], np.linspace(0.09, 0.06, len(joints) - 1)):
            _limb(image, camera, a, b, wide, wide - 0.01, STEEL)
        for joint in joints[1:-1]:
            _limb(image, camera, joint, joint, 0.045, 0.045, ORANGE)
    if hand:  # flat over the tags, its arm coming from +x
        palm = np.array([*box[:2], HAND])
        _limb(image, camera, palm + [0.02, 0, 0], palm + [0.45, 0.12, 0.12], 0.05, 0.045, SKIN)
        for y in (-0.05, -0.017, 0.017, 0.05):
            _limb(image, camera, palm + [0.03, 0.9 * y, 0], palm + [-0.09, 1.2 * y, 0], 0.024, 0.016, SKIN)
        _limb(image, camera, palm + [0.03, -0.03, 0], palm + [-0.02, -0.085, 0], 0.028, 0.018, SKIN)
        _limb(image, camera, palm + [0.03, 0, 0], palm + [-0.02, 0, 0], 0.07, 0.068, SKIN)
    return image


def photograph(camera, box, points, hand, rng):
    """What the robot's camera delivers: `render` with blur and noise."""
    image = cv2.GaussianBlur(render(camera, box, points, hand), (0, 0), BLUR)
    x, y = rng.integers(SIZE[0]), rng.integers(SIZE[1])
    return cv2.add(image, _GRAIN[y:y + SIZE[1], x:x + SIZE[0]], dtype=cv2.CV_8U)
