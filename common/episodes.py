"""Whole episodes: the first of every world after a seeded reset, so that a seed names a fixed list of them."""
import numpy as np
import torch

from common import task
from common.networks import autocast, mode, sample


@torch.no_grad()
def play(env, actor, seed, greedy=True, record=None):
    """Plays one whole episode in every world: the first after `reset(seed)`.

    Args:
        actor: policy net on the env's observations.
        greedy: the mode of each categorical, else a sample.
        record: called as record(t, obs, env, running) before each action.
    Returns:
        success (N,) bool and length (N,) in steps.
    """
    device = next(actor.parameters()).device
    obs, _ = env.reset(seed=seed)
    running, success = np.ones(len(obs), bool), np.zeros(len(obs), bool)
    length, hidden = np.zeros(len(obs), int), None
    for t in range(task.HORIZON):
        if record:
            record(t, obs, env, running)
        with autocast(device):
            logits, hidden = actor(torch.as_tensor(obs, device=device)[None], hidden)
        action = (mode if greedy else sample)(logits[0])
        obs, _, terminated, truncated, infos = env.step(action.cpu().numpy())
        length += running
        success |= running & infos["success"]
        running &= ~(terminated | truncated)
        if not running.any():
            break
    return success, length
