"""Players of the fixed list of episodes: a policy with what is in its loop, in one kind of world (sec. 5)."""
from dataclasses import dataclass, replace
from functools import cache

import torch

from common import episodes, film, geometry, networks, stacks, weights
from common.stacks import METHODS
from common.task import World

LIST = 2**40  # first seed of the fixed list: no training draws one as large


@dataclass
class Measurement:
    """So many episodes of the fixed list, played by one policy in one kind of world."""

    method: str
    episodes: int
    seed: int = 0
    occlusion: float | None = None
    starts: str | None = None  # other ones than the world's
    greedy: bool = True
    switches: bool = False


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
        world = replace(self.world, starts=m.starts or self.world.starts)
        env = stacks.make(method, self.cfg.num_envs, estimator, self.cfg.passes, m.occlusion, world=world)
        env = film.Recorded(env)
        return *episodes.play(env, self.policy(m.method, m.seed), seed, m.greedy), env

    def measure(self, m, number):
        """One number an episode of a chunk: 1 for success, or its contact switches."""
        success, length, env = self.chunk(m, number)
        if m.switches:
            success = [geometry.contact_switches(env.episode(i, n)["state"]) for i, n in enumerate(length)]
        return [int(x) for x in success[:m.episodes - number * self.cfg.num_envs]]

    def episode(self, m, index):
        """Episode `index` of the list: states, observations, beliefs and success."""
        number, world = divmod(index, self.cfg.num_envs)
        success, length, env = self.chunk(m, number)
        return env.episode(world, length[world]) | {"success": bool(success[world])}
