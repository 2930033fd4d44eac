"""What a run of the robot looked like: the scene, the camera's image with the detections, the top view with the estimate."""
import cv2
import numpy as np

from common import film, observation, task
from common.robot import scene

FOUND = (60, 220, 60)
WIDTH, TOP = 960, 360  # pixels of a composite: scene and camera above, as high as TOP; below, from above and the curves
SPAN = 20 * task.RATE  # the newest ticks, which the curves show
CURVES = (("force", 15.0, "N"), ("sigma", 30.0, "mm"), ("age of the sight", 10.0, "s"))  # with the top of each scale


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


def curves_of(row):
    """The values of a tick in CURVES: the force felt, the estimate's standard deviation in the plane, the sight's age."""
    return np.linalg.norm(row["force"]), 1e3 * np.linalg.norm(row["sigma"][:2] * task.HALF), row["age"] / task.RATE


def composite(row, tick, history):
    """RGB image (600, WIDTH, 3) of a tick: its three panels, and the curves of `history`, a list of curves_of."""
    half, strip = WIDTH // 2, WIDTH // 12
    outside, seen, above = (cv2.resize(view, (half, height)) for view, height in zip(panels(row, tick), (TOP, TOP, half // 2)))
    plot, values = np.full((half // 2, half, 3), 255, np.uint8), np.array(history).reshape(-1, len(CURVES))
    x = np.linspace(0, half, SPAN)[:len(values)]
    for i, (name, top, unit) in enumerate(CURVES):
        bottom = (i + 1) * strip - 1
        y = bottom - 3 - (strip - 8) * np.clip(values[:, i] / top, 0, 1)
        points = np.round(16 * np.column_stack([x, y])).astype(np.int32)
        cv2.line(plot, (0, bottom), (half, bottom), (220, 220, 220), 1)
        cv2.polylines(plot, [points], False, film.ESTIMATE, 2, cv2.LINE_AA, 4)
        words = f"{name} {values[-1, i]:.1f} {unit} (of {top:.0f})"
        cv2.putText(plot, words, (8, i * strip + 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, film.TEXT, 1, cv2.LINE_AA)
    return np.vstack([np.hstack([outside, seen]), np.hstack([above, plot])])
