"""Whole episodes: the first of every world after a seeded reset, so that a seed names a fixed list of them."""
import numpy as np
import torch

from common import task
from common.networks import mode, sample
from common.speed import autocast, fewer


@torch.no_grad()
def play(env, actor, seed, greedy=True, record=None):
    """Success (N,) bool and length (N,) in steps of one whole episode in every world: the first after `reset(seed)`.

    Actions are the mode of each categorical if greedy, else a sample; record(t, env) is called before each. Worlds whose
    episode is over rest, and the nets leave them out, but for some that fill up the width (speed.fewer).
    """
    device = next(actor.parameters()).device
    obs, _ = env.reset(seed=seed)
    running, success, length, hidden = np.ones(len(obs), bool), np.zeros(len(obs), bool), np.zeros(len(obs), int), None
    watched = env.unwrapped.watched
    for t in range(env.unwrapped.world.horizon):
        if record:
            record(t, env)
        with autocast(device):
            logits, hidden = actor(torch.as_tensor(obs[watched], device=device)[None], hidden)
        action = np.full((len(obs), 2), task.BINS // 2)
        action[watched] = (mode if greedy else sample)(logits[0]).cpu().numpy()
        obs, _, terminated, truncated, infos = env.step(action)
        length += running
        success |= running & infos["success"]
        running &= ~(terminated | truncated)
        if not running.any():
            break
        if len(kept := fewer(running[watched])) < len(watched):
            env.unwrapped.watched = watched = watched[kept]
            hidden = tuple(h[:, kept] for h in hidden)
    return success, length
