"""Stage 02: the dataset D, clean trajectories of all checkpoints of pi_priv (sec. 3.2, "Data Collection").

    python 02_collect.py [smoke|quick|laptop|paper] [--field value ...]

Reads the checkpoints of 01. Writes runs/<preset>/02_collect/seed<k>/: for the sets train, validation, test (all checkpoints,
the same number of whole episodes each) and teacher_train, teacher_validation (the last checkpoint) <set>_states.npy
(steps, 7) float32 in SI units and <set>_offsets.npy (n + 1,); metrics.csv and success.png of the checkpoints. With --drifting,
a share of train and validation is played by checkpoints that see the box where it is not (their success is left out).
"""
import time
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch

from common import artifacts, episodes, networks, plots, task, trajectories
from common.env import PushVectorEnv
from common.symmetry import Mirrored

SETS = ("train", "validation", "test", "teacher_train", "teacher_validation")
DRIFT = np.array([0.03, 0.03, 0.4])  # m, m, rad: the largest standard deviations of a drifting pose
DRIFT_TIME = 4.0  # s, in which a drifting pose forgets its error


@dataclass
class Config(artifacts.Stage):
    train: int = 750_000
    """trajectories to train on, of all checkpoints; the teacher set of the last one has as many (appendix B.2, B.3)"""
    validation: int = 150_000
    """trajectories to validate on, likewise (appendix B.2, B.3)"""
    test: int = 150_000
    """trajectories to test the estimators on (appendix B.2)"""
    drifting: float = 0.0
    """aid: share of train and validation whose players see the box where it is not; 0 is none"""
    num_envs: int = 2500
    """most worlds at once"""


PRESETS = {
    "smoke": dict(train=48, validation=12, test=12, drifting=0.5, num_envs=16),
    "quick": dict(train=20_000, validation=1000, test=2000, drifting=0.5, num_envs=1000),
    "laptop": dict(train=100_000, validation=1000, test=1000, drifting=0.5, num_envs=1000),
    "paper": {},
}


class Drifting(gym.vector.VectorWrapper):
    """A PushVectorEnv whose last `count` worlds show the box off its pose, by a random error of another size in each.

    A player that believes it moves as one that acts on an estimate: its motion does not betray the true pose. The error is an
    Ornstein-Uhlenbeck process that begins small. For the first episode of each world, which is what is collected.
    """

    def __init__(self, env, count):
        super().__init__(env)
        self.count = count

    def reset(self, *, seed, options=None):
        _, infos = self.env.reset(seed=seed, options=options)
        self.rng = np.random.default_rng([seed, 2])
        self.size = self.rng.random((self.num_envs, 1)) * DRIFT
        self.size[:self.num_envs - self.count] = 0
        self.error = 0.3 * self.size * self.rng.standard_normal(self.size.shape)
        return self.show(infos), infos

    def step(self, action):
        _, *rest, infos = self.env.step(action)
        keep = np.exp(-1 / (task.RATE * DRIFT_TIME))
        self.error = keep * self.error + np.sqrt(1 - keep**2) * self.size * self.rng.standard_normal(self.size.shape)
        return self.show(infos), *rest, infos

    def show(self, infos):
        seen = infos["state"].copy()
        seen[:, :3] += self.error
        return task.scale(seen)


def jobs(cfg, checkpoints):
    """(set, checkpoint, episodes, drifting ones) of every part: at most cfg.num_envs whole episodes of one checkpoint."""
    for name in SETS:
        count = getattr(cfg, name.removeprefix("teacher_"))
        players = [checkpoints - 1] if name.startswith("teacher") else range(checkpoints)
        share = [count * (i + 1) // len(players) - count * i // len(players) for i in range(len(players))]
        for player, part in zip(players, share):
            for first in range(0, part, cfg.num_envs):
                worlds = min(cfg.num_envs, part - first)
                yield name, player, worlds, round(cfg.drifting * worlds) if name in ("train", "validation") else 0


def collect(policy, num_envs, seed, drifting=0):
    """States (steps, 7) and lengths of one episode in each of `num_envs` worlds, actions sampled; and their success.

    In the last `drifting` worlds the policy sees the box where it is not.
    """
    states = np.empty((task.HORIZON, num_envs, 7), np.float32)

    def record(t, obs, env, running):
        states[t] = env.unwrapped.state

    torch.manual_seed(seed)
    env = Mirrored(Drifting(PushVectorEnv(num_envs), drifting))
    success, length = episodes.play(env, policy, seed, greedy=False, record=record)
    valid = np.arange(task.HORIZON)[:, None] < length
    return states.swapaxes(0, 1)[valid.T], length, success


def join(run, name, parts):
    """Parts of a set as one array of states and one of offsets; returns the lengths."""
    lengths = np.concatenate([np.load(p)["length"] for p in parts])
    offsets = np.concatenate([[0], lengths.cumsum()])

    def write(path):
        states = np.lib.format.open_memmap(path, "w+", np.float32, (int(offsets[-1]), 7))
        end = 0
        for part in parts:
            chunk = np.load(part)["states"]
            states[end:end + len(chunk)] = chunk
            end += len(chunk)
        states.flush()

    for file, writer in zip(trajectories.files(name), (write, lambda path: np.save(path, offsets))):
        artifacts.write_atomic(run.dir / file, writer)
    return lengths


def remove_parts(run):
    for part in run.dir.glob("part_*.npz"):
        part.unlink()


def main(cfg):
    if not 0 <= cfg.drifting <= 1:
        raise artifacts.UserError(f"--drifting {cfg.drifting}: a share, 0 to 1")
    folder = artifacts.find(cfg, "01_train_privileged", "policy.safetensors").parent
    names = [name for name in artifacts.record_of(cfg, folder)["outputs"] if name.startswith("checkpoint_")]
    paths = [artifacts.find(cfg, "01_train_privileged", name) for name in sorted(names)]
    device = artifacts.device_of(cfg)
    run = artifacts.Run(cfg, "02_collect", {p.name: p for p in paths})
    if run.skip():
        return remove_parts(run)
    todo = list(jobs(cfg, len(paths)))
    parts = [run.dir / f"part_{k:05d}.npz" for k in range(len(todo))]
    left = [k for k, part in enumerate(parts) if not part.exists()]
    clock = time.perf_counter()
    bar = artifacts.bar(sum(todo[k][2] for k in left), "02_collect", unit="trajectory")
    for k in left:
        _, player, count, drifting = todo[k]
        policy = networks.load_recurrent(paths[player], device)
        seed = int(np.random.SeedSequence([cfg.seed, k, 1]).generate_state(1)[0])  # ppo.train has [seed, k]
        states, length, success = collect(policy, count, seed, drifting)
        artifacts.write_atomic(parts[k], lambda path: np.savez(path, states=states, length=length, success=success))
        bar.update(count)
        if run.out_of_time():
            return run.stop()
    rate = sum(todo[k][2] for k in left) / (time.perf_counter() - clock)
    bar.close()

    success = [[] for _ in paths]
    for (_, player, count, drifting), part in zip(todo, parts):
        success[player] += np.load(part)["success"][:count - drifting].tolist()
    for player, ended in enumerate(success):
        run.log(checkpoint=player, episodes=len(ended), success=np.mean(ended))
    for name in SETS:
        lengths = join(run, name, [part for job, part in zip(todo, parts) if job[0] == name])
        quartiles = np.percentile(lengths, [0, 25, 50, 75, 100])
        size = (run.dir / trajectories.files(name)[0]).stat().st_size / 2**20
        print(f"{name}: {len(lengths):,} trajectories, {lengths.sum():,} steps, lengths {quartiles.astype(int)}, "
              f"{size:,.0f} MiB")
    plots.checkpoints(run.rows(), run.dir / "success.png")
    rates = " ".join(f"{np.mean(ended):.0%}" for ended in success)
    print(f"{run.dir}: {rate:,.0f} trajectories/s; success of the checkpoints {rates}")
    run.finish([file for name in SETS for file in trajectories.files(name)])
    remove_parts(run)


if __name__ == "__main__":
    artifacts.main(Config, PRESETS, main, __doc__)
