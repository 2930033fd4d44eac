"""Stage 02: the dataset D, clean trajectories of all checkpoints of pi_priv (sec. 3.2, "Data Collection").

    python 02_collect.py [smoke|quick|laptop|paper] [--field value ...]

Reads the checkpoints of 01. Writes runs/<preset>/02_collect/seed0/: for the sets train, validation, test (all checkpoints,
the same number of whole episodes each) and teacher_train, teacher_validation (the last checkpoint) <set>_states.npy
(steps, 7) float32 in SI units and <set>_offsets.npy (n + 1,); metrics.csv and success.png of the checkpoints. With --drifting,
a share of train and validation is played by checkpoints that see the box where it is not (their success is left out).
"""
import time
from dataclasses import dataclass

import numpy as np

from common import command, networks, plots, ranks, runs, trajectories, weights
from common.collection import collect
from common.files import UserError, write_atomic
from common.progress import bar

SETS = ("train", "validation", "test", "teacher_train", "teacher_validation")


@dataclass
class Config(command.Stage):
    train: int = 750_000  # trajectories of all checkpoints to train on, and as many of the last one (appendix B.2, B.3)
    validation: int = 150_000  # trajectories to validate on, likewise (appendix B.2, B.3)
    test: int = 150_000  # trajectories to test the estimators on (appendix B.2)
    drifting: float = 0.0  # share of train and validation whose players see the box where it is not; 0 is none
    num_envs: int = 2500  # most worlds at once


PRESETS = {
    "smoke": dict(train=48, validation=12, test=12, drifting=0.5, num_envs=16),
    "quick": dict(train=20_000, validation=1000, test=2000, drifting=0.5, num_envs=1000),
    "laptop": dict(train=100_000, validation=1000, test=1000, drifting=0.5, num_envs=1000),
    "paper": {},
}


def jobs(cfg, checkpoints):
    """(set, checkpoint, episodes, drifting ones) of every part: at most cfg.num_envs whole episodes of one checkpoint."""
    for name in SETS:
        count = getattr(cfg, name.removeprefix("teacher_"))
        players = [checkpoints - 1] if name.startswith("teacher") else range(checkpoints)
        for i, player in enumerate(players):
            share = count * (i + 1) // len(players) - count * i // len(players)
            for first in range(0, share, cfg.num_envs):
                worlds = min(cfg.num_envs, share - first)
                yield name, player, worlds, round(cfg.drifting * worlds) if name in ("train", "validation") else 0


def join(run, name, parts):
    """Writes a set, its parts one behind the other; returns the lengths."""
    lengths = [np.load(part)["length"] for part in parts]
    offsets = np.concatenate([[0], *lengths]).cumsum()

    def write(path):
        states = np.lib.format.open_memmap(path, "w+", np.float32, (int(offsets[-1]), 7))
        ends = np.cumsum([length.sum() for length in lengths])
        for part, rows in zip(parts, np.split(states, ends[:-1])):
            rows[:] = np.load(part)["states"]
        states.flush()

    for file, writer in zip(trajectories.files(name), (write, lambda path: np.save(path, offsets))):
        write_atomic(run.dir / file, writer)
    return np.diff(offsets)


def remove_parts(run):
    for part in run.dir.glob("part_*.npz"):
        part.unlink(missing_ok=True)


def main(cfg):
    if not 0 <= cfg.drifting <= 1:
        raise UserError(f"--drifting {cfg.drifting}: a share, 0 to 1")
    if cfg.seed:
        raise UserError(f"--seed {cfg.seed}: only 0, the later stages read seed 0's trajectories")
    folder = runs.find(cfg, "01_train_privileged", "policy.safetensors").parent
    names = [name for name in runs.record_of(cfg, folder)["outputs"] if name.startswith("checkpoint_")]
    paths = [runs.find(cfg, "01_train_privileged", name) for name in sorted(names)]
    device, run = command.device_of(cfg), runs.Run(cfg, "02_collect", {path.name: path for path in paths})
    if run.skip():
        return remove_parts(run)
    todo = {run.dir / f"part_{k:05d}.npz": (k, *job) for k, job in enumerate(jobs(cfg, len(paths)))}
    unplayed = ranks.lead(lambda: [part for part in todo if not part.exists()])()
    clock, total = time.perf_counter(), sum(todo[part][3] for part in unplayed)
    progress = bar(total, "02_collect", unit="trajectory")

    def play(part):
        k, _, player, count, drifting = todo[part]
        seed = int(np.random.SeedSequence([cfg.seed, k, 1]).generate_state(1)[0])  # training.begin has [seed, k, 0, rank]
        return collect(weights.load(networks.Recurrent, paths[player], device), run.world, count, seed, drifting)

    for parts in trajectories.batches(unplayed, ranks.COUNT):
        for part, (states, length, success) in zip(parts, ranks.spread(parts, play)):
            write_atomic(part, lambda path: np.savez(path, states=states, length=length, success=success))
            progress.update(len(length))
        if run.out_of_time():
            return run.stop()
    if ranks.RANK:
        return
    rate = total / (time.perf_counter() - clock)
    progress.close()

    success = [[] for _ in paths]
    for part, (_, _, player, count, drifting) in todo.items():
        success[player] += np.load(part)["success"][:count - drifting].tolist()
    for player, ended in enumerate(success):
        run.log(checkpoint=player, episodes=len(ended), success=np.mean(ended))
    for name in SETS:
        lengths = join(run, name, [part for part, job in todo.items() if job[1] == name])
        quartiles = np.percentile(lengths, [0, 25, 50, 75, 100]).astype(int)
        size = (run.dir / trajectories.files(name)[0]).stat().st_size / 2**20
        print(f"{name}: {len(lengths):,} trajectories, {lengths.sum():,} steps, lengths {quartiles}, {size:,.0f} MiB")
    plots.checkpoints(run.rows(), run.dir / "success.png")
    print(f"{run.dir}: {rate:,.0f} trajectories/s; success of the checkpoints", *(f"{np.mean(x):.0%}" for x in success))
    run.finish([file for name in SETS for file in trajectories.files(name)])
    remove_parts(run)


if __name__ == "__main__":
    command.main(Config, PRESETS, main, __doc__)
