"""What 05 measures: so many episodes of its fixed list, by one policy in one kind of world."""
import math
from contextlib import suppress
from dataclasses import asdict, dataclass, replace

from common.stacks import METHODS
from common.task import C_060, DRAWN, STARTS, Other, World

DURATIONS = {"0": 0.0, "2.5": 2.5, "5": 5.0, "10": 10.0, "full": math.inf}  # s; the paper's own grid is in its plot only
FILTERED = ("c=0.042", "c=0.078", "support_offset=8mm")  # other worlds in which the particle filter is measured
SENSED = ("noise", "bias", "force", "late")  # other worlds that only an observation tells from the nets'


@dataclass
class Measurement:
    """So many episodes of a fixed list, that of so many worlds at once, played by one policy in one kind of world."""

    method: str
    episodes: int
    seed: int = 0
    occlusion: float | None = None
    world: World | None = None  # another one than the nets'
    greedy: bool = True
    switches: bool = False
    errors: bool = False
    filtered: bool = False  # the particle filter is in the loop
    worlds: int | None = None  # at once; none: as many as the setting says

    def width(self, cfg):
        """Episodes of a chunk."""
        return self.worlds or cfg.num_envs


def measurements(cfg, policies, world):
    """{where it goes in results.json: Measurement} of {(method, seed): path}, in the order in which they are made."""
    methods = [m for m in METHODS if (m, 0) in policies]
    todo = {f"success_rate/{m}/{k}": Measurement(m, cfg.episodes, k) for m, k in policies}
    todo |= {f"occlusion_duration/{m}/{name}": Measurement(m, cfg.sweep_episodes, occlusion=seconds)
             for m in methods if METHODS[m].reads != "s" for name, seconds in DURATIONS.items()}
    for m in [m for m in ("priv_on_state", "est_uncertainty") if m in methods]:
        others = [replace(world, starts=starts) for starts in STARTS if starts != world.starts]
        todo |= {f"starts/{other.starts}/{m}": Measurement(m, cfg.episodes, world=other) for other in others}
        todo[f"contact_switches/{m}"] = Measurement(m, cfg.switch_episodes, switches=True)
    todo |= {f"other_worlds/{row}/{m}": Measurement(m, cfg.other_episodes, world=other)
             for row, other in ({"as trained": world} | other_worlds(world)).items() if cfg.other_episodes for m in methods
             if METHODS[m].estimator or METHODS[m].reads == "s" and not row.startswith(SENSED)}
    todo |= {f"in_the_loop/{m}": Measurement(m, cfg.episodes, errors=True) for m in methods if METHODS[m].estimator}
    todo |= {f"filter_loop/{name}/{m}": Measurement(m, 2 * cfg.filter_trajectories, filtered=name == "filter", worlds=1)
             for m in ("est_uncertainty", "priv_on_estimate") if m in methods and cfg.filter_trajectories
             for name in ("ours", "filter")}
    if "est_uncertainty" in methods:
        todo["sampled_actions/est_uncertainty"] = Measurement("est_uncertainty", cfg.episodes, greedy=False)
    return todo


def other_worlds(world):
    """{row: task.Other} of a task.World, those left out that are none, or the world itself. c's rows have its values under the
    study's box; `paper` has the ranges of the paper's table, where training draws from wider ones.
    """
    base, (length, width, height) = Other(**asdict(world)), world.box
    changes = {
        "paper": {name: getattr(World, name) for name in DRAWN},
        "c=0.042": {"support": (0.0, 0.0)}, "c=0.060": {"support": C_060}, "c=0.078": {"support": (1.0, 1.0)},
        "support_offset=8mm": {"support_offset": (0.008, 0.008)},
        "mass=1-1.5": {"mass": (1.0, 1.5)}, "mass=5-6": {"mass": (5.0, 6.0)},
        "mu=0.05-0.1": {"mu_dynamic": (0.05, 0.1)}, "mu=0.3-0.6": {"mu_dynamic": (0.3, 0.6)},
        "mu_pusher=0.6-0.9": {"mu_pusher": (0.6, 0.9)},
        "box=-2cm": {"box": (length - 0.02, width, height)}, "box=+2cm": {"box": (length + 0.02, width, height)},
        "box=+2cm_wide": {"box": (length, width + 0.02, height)},
        "noise=2x": {"noise": tuple(2 * x for x in world.noise)}, "bias=2x": {"bias": tuple(2 * x for x in world.bias)},
        "force=0.7x": {"gain": 0.7}, "force=1.3x": {"gain": 1.3}, "late=1": {"late": 1}, "late=2": {"late": 2},
        "surface=1.5": {"surface": 1.5}, "surface=4": {"surface": 4.0}, "time=30s": {"time_limit": 30.0}}
    worlds = {}
    for row, change in changes.items():
        with suppress(ValueError):
            worlds[row] = replace(base, **change)
    return {row: other for row, other in worlds.items() if other != base}
