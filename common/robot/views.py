"""What a run of the robot looked like: the scene, the camera's image with the detections, the top view with the estimate."""
import cv2
import numpy as np

from common import film, observation, task
from common.robot import scene

FOUND = (60, 220, 60)


def panels(row, tick):
    """RGB images of a tick: from outside, by the robot's camera, from above; without a true pose the estimate stands for it."""
    box = row["estimated"] if np.isnan(row["true"]).any() else row["true"]
    outside = scene.render(scene.OVERVIEW, box, row["points"], row["covered"], arm=True)
    seen = row["image"].copy()
    cv2.polylines(seen, list(np.round(16 * row["corners"]).astype(np.int32)), True, FOUND, 2, cv2.LINE_AA, 4)
    state, noisy, s_hat = (np.concatenate([pose, row["pusher"], row["force"]]) for pose in (box, row["seen"], row["estimated"]))
    o = observation.assemble(noisy[None], np.array([row["age"] > 0]))[0]
    above = film.frame(state, o, np.append(task.scale(s_hat), row["sigma"]), tick)
    return outside[..., ::-1], seen[..., ::-1], above[:film.WIDTH // 2]  # without its text, which tells of the truth


def columns(rows, count=5):
    """(time in s, occluded, panels) at `count` instants, evenly spaced from the first tick to the last."""
    return [(i / task.RATE, rows[i]["age"] > 0, panels(rows[i], i)) for i in np.linspace(0, len(rows) - 1, count).astype(int)]


def write(rows, path, camera_path):
    """Writes the three views of a run side by side as an mp4, and the robot's camera alone as another."""
    height = scene.SIZE[1]
    film.write_mp4(path, (np.hstack([cv2.resize(view, (view.shape[1] * height // view.shape[0], height))
                                     for view in panels(row, tick)]) for tick, row in enumerate(rows)))
    film.write_mp4(camera_path, (row["image"][..., ::-1] for row in rows))
