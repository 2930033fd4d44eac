"""Players of the fixed list of episodes: a policy with what is in its loop, in one kind of world (sec. 5)."""
from functools import cache

import numpy as np
import torch

from common import collection, episodes, film, geometry, measurements, networks, particles, stacks, trajectories, weights
from common.files import UserError
from common.stacks import METHODS
from common.task import World

LIST = 2**40  # first seed of the fixed list: no training draws one as large


def first_seed(cfg):
    """Of the list of cfg.seed. Raises UserError: torch has no seed as large."""
    if cfg.seed >= 2**22:
        raise UserError(f"--seed {cfg.seed}: say less than {2**22}")
    return LIST * (1 + cfg.seed)


class Players:
    """Plays Measurements with the nets at `paths`, a chunk of cfg.num_envs episodes of the fixed list at a time."""

    def __init__(self, cfg, paths, device, world=World()):
        self.cfg, self.paths, self.device, self.world = cfg, paths, device, world
        self.policy = cache(lambda m, seed: weights.load(networks.Recurrent, paths[m, seed], device))
        self.estimator, self.trajectories = cache(self.estimator), cache(self.trajectories)

    def estimator(self, kind):
        """Of none, none; "ours/1" is ours of seed 1, "filter" the particle filter."""
        if kind == "filter":
            return particles.Filters(self.cfg.particles, self.world)
        return stacks.load_estimator(kind.partition("/")[0], self.paths[kind], self.device) if kind else None

    def chunk(self, m, number):
        """Success (N,), length (N,) and film.Recorded of a chunk: starts, dynamics, noise, occlusions as for all policies."""
        seed = first_seed(self.cfg) + number
        torch.manual_seed(seed)
        method = METHODS[m.method]
        estimator = self.estimator("filter" if m.filtered else method.estimator)
        num, world = min(m.episodes, m.width(self.cfg)), m.world or self.world
        env = film.Recorded(stacks.make(method, num, estimator, self.cfg.passes, m.occlusion, world=world))
        return *episodes.play(env, self.policy(m.method, m.seed), seed, m.greedy), env

    def measure(self, m, number):
        """Of each episode of a chunk: 1 for success, its contact switches, or its errors (trajectories.in_the_loop)."""
        success, length, env = self.chunk(m, number)
        told = success.astype(int).tolist()
        if m.switches:
            told = [geometry.contact_switches(env.episode(i, n)["state"], self.world.box) for i, n in enumerate(length)]
        if m.errors:
            scale = getattr(self.estimator(METHODS[m.method].estimator), "scale", None)
            told = trajectories.in_the_loop(env, length, success, scale)
        return told[:m.episodes - number * m.width(self.cfg)]

    def trajectories(self, row):
        """Trajectories of pi_priv on drifting poses, in one of `other_worlds` or, as "drifting", in the nets'."""
        world = self.world if row == "drifting" else measurements.other_worlds(self.world)[row]
        count = self.cfg.filter_trajectories
        states, length, _ = collection.collect(self.policy("priv_on_state", 0), world, count, first_seed(self.cfg), count)
        return states, np.concatenate([[0], length]).cumsum()

    def episode(self, m, index):
        """Episode `index` of the list: states, observations, beliefs and success."""
        number, world = divmod(index, m.width(self.cfg))
        success, length, env = self.chunk(m, number)
        return env.episode(world, length[world]) | {"success": bool(success[world])}
