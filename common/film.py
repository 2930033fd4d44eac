"""Recorded episodes, with what the policy's stack saw and believed, and a film of one (mp4 and GIF)."""
import cv2
import numpy as np
from PIL import Image

from common import draw, symmetry, task
from common.files import UserError, write_atomic
from common.task import World
from common.wrappers import EpisodeWrapper, state_of

WIDTH, HEIGHT = 960, 600  # pixels: the top view, and 120 rows of text below
HELD, ESTIMATE, FORCE, TEXT = (230, 159, 0), (0, 158, 115), (0, 0, 0), (60, 60, 60)  # RGB


class Recorded(EpisodeWrapper):
    """The topmost wrapper of a stack: `rows` of each step's `state` (N, 7) and, if there are, `o` (N, 9), `belief` (N, 12).

    They go on after a world's first episode, which is all that `episode` gives.
    """

    def reset(self, *, seed=None, options=None):
        self.rows = []
        obs, infos = super().reset(seed=seed, options=options)
        return self.observe(obs, infos), infos

    def observe(self, obs, infos):
        row = {"state": state_of(infos)} | {k: infos[k] for k in ("o", "belief") if k in infos}
        self.rows.append({name: x.astype(np.float32) for name, x in row.items()})
        return obs

    def episode(self, world, length):
        """Arrays (length + 1, ...) of a world's first episode, its last state included, in the frame of the world."""
        kept = {name: np.stack([row[name][world] for row in self.rows[:length + 1]]) for name in self.rows[0]}
        if "belief" in kept:
            kept["belief"] = symmetry.mirror(kept["belief"], symmetry.signs(kept["o"][:1]))
        return kept


def frame(state, o, belief, step, world=World()):
    """Image (HEIGHT, WIDTH, 3) uint8 RGB of a state (7,), what was seen of it (9,) and what was believed (12,)."""
    image = np.vstack([draw.top_view(state, WIDTH, world.box), np.full((HEIGHT - WIDTH // 2, WIDTH, 3), 255, np.uint8)])
    held, q_hat, occluded = task.unscale_pose(o[:4]), task.unscale_pose(belief[:4]), o[8] > 0
    force, deviation = o[6:8] * world.max_force, 2 * belief[8:10] * task.HALF
    draw.outline(image, held, HELD, world.box)
    draw.outline(image, q_hat, ESTIMATE, world.box)
    axes = np.maximum(np.round(16 * WIDTH / draw.VIEW * deviation), 32).astype(int).tolist()
    cv2.ellipse(image, draw.pixels(q_hat[:2], WIDTH).tolist(), axes, 0, 0, 360, ESTIMATE, 3, cv2.LINE_AA, 4)
    arrow = draw.pixels([state[3:5], state[3:5] + 0.008 * force], WIDTH) // 16  # 8 mm a newton
    cv2.arrowedLine(image, *arrow.tolist(), FORCE, 3, cv2.LINE_AA, tipLength=0.25)

    def text(words, x, y, colour=TEXT):
        cv2.putText(image, words, (x, WIDTH // 2 + y), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 1, cv2.LINE_AA)

    for x, words, colour in ((20, "true box", draw.BOX_COLOUR), (240, "target", draw.TARGET_COLOUR), (460, "observed", HELD),
                             (680, "estimate, 2 sigma", ESTIMATE)):
        cv2.rectangle(image, (x, WIDTH // 2 + 10), (x + 24, WIDTH // 2 + 28), colour, -1)
        text(words, x + 34, 26)
    text(f"t = {step / task.RATE:4.1f} s", 20, 62)
    text(f"force = {np.hypot(*force):4.1f} N", 240, 62)
    text("xi = 1, occluded: the observation is held" if occluded else "xi = 0", 460, 62, HELD if occluded else TEXT)
    error, spread = np.linalg.norm(q_hat[:2] - state[:2]), np.linalg.norm(deviation / 2)
    text(f"estimate: error {1e3 * error:4.1f} mm, standard deviation {1e3 * spread:4.1f} mm", 20, 98)
    if occluded:
        cv2.rectangle(image, (0, 0), (WIDTH - 1, WIDTH // 2 - 1), HELD, 6)
    return image


def write(episode, mp4, gif, world=World()):
    """Writes an episode of Recorded as an mp4 at 15 frames a second, and as a GIF of half its width and rate."""
    frames = [frame(*row, step, world) for step, row in enumerate(zip(*(episode[k] for k in ("state", "o", "belief"))))]
    frames += frames[-1:] * task.RATE  # the end stands for a second
    write_mp4(mp4, frames)
    small = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in frames[::2]]
    palette = Image.fromarray(np.concatenate(small[::10])).quantize(128)
    first, *rest = (Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE) for image in small)
    write_atomic(gif, lambda path: first.save(path, save_all=True, append_images=rest, duration=2000 / task.RATE, loop=0))


def write_mp4(path, frames):
    """Writes an iterable of images (height, width, 3) uint8 RGB as an mp4 at 15 frames a second."""
    def video(temporary):
        writer = None
        for image in frames:
            writer = writer or cv2.VideoWriter(str(temporary), cv2.VideoWriter_fourcc(*"mp4v"), task.RATE, image.shape[1::-1])
            if not writer.isOpened():
                raise UserError("this build of opencv has no mp4 encoder: install opencv-python-headless from requirements.txt")
            writer.write(image[..., ::-1])
        writer.release()

    write_atomic(path, video)
