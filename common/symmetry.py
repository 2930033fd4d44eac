"""The task's two mirror symmetries: nets only ever see the quarter of the workspace in which their episode began."""
import gymnasium as gym
import numpy as np

from common.task import BINS

# Reflecting x (or y) negates these entries of s = x, y, sin, cos, pusher x, y, force x, y; the box is its own mirror image.
_FLIPS = np.array([[1, 0, 1, 0, 1, 0, 1, 0], [0, 1, 1, 0, 0, 1, 0, 1]], bool)


def signs(first):
    """(N, 2) of +-1 that carry the box of the first observations (N, >= 8) to x >= 0, y >= 0."""
    return np.where(first[:, :2] < 0, -1, 1)


def mirror(obs, sign):
    """Observations (..., N, >= 8) reflected by signs (N, 2); what follows the first 8 entries stays."""
    out = obs.copy()
    out[..., :8] *= np.where(_FLIPS[0], sign[:, :1], 1) * np.where(_FLIPS[1], sign[:, 1:], 1)
    return out


def mirror_action(action, sign):
    """Actions (N, 2) reflected by signs (N, 2)."""
    return np.where(sign < 0, BINS - 1 - action, action)


class Mirrored(gym.vector.VectorWrapper):
    """What is seen, and the actions, in the frame of each episode's first observation (`signs`)."""

    def reset(self, *, seed=None, options=None):
        obs, infos = self.env.reset(seed=seed, options=options)
        self.sign = signs(obs)
        return mirror(obs, self.sign), infos

    def step(self, action):
        obs, *rest, infos = self.env.step(mirror_action(action, self.sign))
        if "final_obs" in infos:
            infos["final_obs"] = mirror(infos["final_obs"], self.sign)
            self.sign = np.where(infos["_final_obs"][:, None], signs(obs), self.sign)
        return mirror(obs, self.sign), *rest, infos
