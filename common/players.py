"""Players of the fixed list of episodes: a policy with what is in its loop, in one kind of world (sec. 5)."""
from functools import cache

import torch

from common import episodes, film, geometry, networks, stacks, trajectories, weights
from common.stacks import METHODS
from common.task import World

LIST = 2**40  # first seed of the fixed list: no training draws one as large


class Players:
    """Plays Measurements with the nets at `paths`, a chunk of cfg.num_envs episodes of the fixed list at a time."""

    def __init__(self, cfg, paths, device, world=World()):
        self.cfg, self.device, self.world = cfg, device, world
        self.policy = cache(lambda m, seed: weights.load(networks.Recurrent, paths[m, seed], device))
        self.estimator = cache(lambda kind: weights.load(networks.Estimator, paths[kind], device) if kind else None)

    def chunk(self, m, number):
        """Success (N,), length (N,) and film.Recorded of a chunk: starts, dynamics, noise, occlusions as for all."""
        seed = LIST * (1 + self.cfg.seed) + number
        torch.manual_seed(seed)
        method = METHODS[m.method]
        estimator = self.estimator(method.estimator)
        num, world = min(m.episodes, self.cfg.num_envs), m.world or self.world
        env = film.Recorded(stacks.make(method, num, estimator, self.cfg.passes, m.occlusion, world=world))
        return *episodes.play(env, self.policy(m.method, m.seed), seed, m.greedy), env

    def measure(self, m, number):
        """Of each episode of a chunk: 1 for success, its contact switches, or its errors (trajectories.in_the_loop)."""
        success, length, env = self.chunk(m, number)
        told = success.astype(int).tolist()
        if m.switches:
            told = [geometry.contact_switches(env.episode(i, n)["state"], self.world.box) for i, n in enumerate(length)]
        if m.errors:
            told = trajectories.in_the_loop(env.rows, length).tolist()
        return told[:m.episodes - number * self.cfg.num_envs]

    def episode(self, m, index):
        """Episode `index` of the list: states, observations, beliefs and success."""
        number, world = divmod(index, self.cfg.num_envs)
        success, length, env = self.chunk(m, number)
        return env.episode(world, length[world]) | {"success": bool(success[world])}
