"""Logs of the robot's runs: what is kept of each, read back, and which is worth a figure."""
import zipfile

import numpy as np

from common.files import UserError


def log_of(rows, ended, joined):
    """A run as arrays with a row a tick, in s, rad, m, N and the workspace's frame, how it `ended`, and if somebody `joined`.

    `seen` is the last fit of the tags, `age` how many frames ago that was, `residual` (m) of this frame's; `sigma` is of x, y,
    sin, cos as the nets have them; `covered` is the hand; `unsolved` counts programs without a solution; `busy` is computing.
    """
    kept = [key for key in (rows[0] if rows else ()) if key not in ("corners", "image", "points")]
    return {"ended": np.array(ended), "joined": np.array(joined)} | {key: np.array([row[key] for row in rows]) for key in kept}


def read(folder, scenario):
    """Logs of a scenario, {number of the run: log}; UserError if one is damaged."""
    logs = {}
    for path in sorted(folder.glob(f"{scenario}_[0-9]*.npz")):
        try:
            with np.load(path) as file:
                logs[int(path.stem.rpartition("_")[2])] = dict(file)
        except (ValueError, OSError, EOFError, zipfile.BadZipFile):
            raise UserError(f"{path} is damaged: delete it, and the same command plays that run again") from None
    return logs


def worth(log):
    """Rank of a run as an example for the figure: a success, under a hand, half of the time seen and half of it occluded."""
    share = (log["age"] > 0).mean()
    return str(log["ended"]).startswith("success"), bool(log["covered"].any()), min(share, 1 - share)
