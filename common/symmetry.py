"""The task's two mirror symmetries: nets only ever see the quarter of the workspace in which their episode began."""
import numpy as np

from common.task import BINS
from common.wrappers import EpisodeWrapper

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


class Mirrored(EpisodeWrapper):
    """What is seen, and the actions, in the frame of each episode's first observation (`signs`).

    Infos: `sign` (N, 2), the frame of this step; where an episode ended, of that one. Attribute `sign`: of running episodes.
    """

    def __init__(self, env):
        super().__init__(env)
        self.sign = np.ones((env.num_envs, 2), int)

    def begin(self, worlds, obs, infos):
        self.sign = self.sign.copy()  # the last one stays in the infos of its step
        self.sign[worlds] = signs(obs)
        infos.setdefault("sign", self.sign)
        return mirror(obs, self.sign[worlds])

    def observe(self, obs, infos):
        infos["sign"] = self.sign
        return mirror(obs, self.sign)

    def act(self, action):
        return mirror_action(action, self.sign)
