"""The estimator in the loop: o_t -> (s_hat, sigma)."""
import gymnasium as gym
import numpy as np
import torch

from common.networks import autocast
from common.observation import show


@torch.no_grad()
def believe(estimator, o, hidden, passes):
    """One step of the estimator in the loop.

    Args:
        o: (N, 9) observations.
        hidden: state of the LSTM, None at an episode's start.
        passes: M, the number of stochastic forward passes.
    Returns:
        belief (N, 12): s_hat = (q_hat, pusher, noisy force) without xi, and the four standard deviations sqrt(diag Sigma)
        in scaled units, clipped to [0, 1] (appendix B.1); and the next hidden state.
    """
    device = next(estimator.parameters()).device
    with autocast(device):
        q, variance, hidden = estimator.predict(torch.as_tensor(o, device=device)[None], hidden, passes)
    sigma = variance[0].sqrt().clamp(max=1.0)
    return np.concatenate([q[0].cpu().numpy(), o[:, 4:8], sigma.cpu().numpy()], 1), hidden


class Believed(gym.vector.VectorWrapper):
    """An Observed env whose box pose is the estimator's: observations s_hat (N, 8), with sigma (N, 12), final_obs included.

    s_hat and sigma as `believe` returns them. The estimator keeps a hidden state per world and forgets it at episode ends.
    Infos: `belief` (N, 12), s_hat and sigma of this step in the frame of the env below; where an episode ended, of its end.

    Args:
        env: an Observed env, Mirrored.
        estimator: networks.Estimator.
        passes: M, the number of stochastic forward passes.
        sigma: append the standard deviations.
    """

    def __init__(self, env, estimator, passes, sigma):
        super().__init__(env)
        self.estimator, self.passes, self.size = estimator, passes, 12 if sigma else 8
        show(self, self.size)
        self.hidden = None

    def reset(self, *, seed=None, options=None):
        o, infos = self.env.reset(seed=seed, options=options)
        belief, self.hidden = self._believe(o, None)
        return belief[:, :self.size], infos | {"belief": belief}

    def step(self, action):
        o, reward, terminated, truncated, infos = self.env.step(action)
        if "final_obs" not in infos:
            infos["belief"], self.hidden = self._believe(o, self.hidden)
            return infos["belief"][:, :self.size], reward, terminated, truncated, infos
        final, self.hidden = self._believe(infos["final_obs"], self.hidden)  # elsewhere final_obs is the observation
        infos |= {"final_obs": final[:, :self.size], "belief": final}
        worlds = np.flatnonzero(infos["_final_obs"])
        first, hidden = self._believe(o[worlds], None)
        belief = final.copy()
        belief[worlds] = first
        for all_worlds, new in zip(self.hidden, hidden):
            all_worlds[:, worlds] = new.to(all_worlds.dtype)
        return belief[:, :self.size], reward, terminated, truncated, infos

    def _believe(self, o, hidden):
        return believe(self.estimator, o, hidden, self.passes)
