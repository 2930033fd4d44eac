"""The estimator in the loop: o_t -> (s_hat, sigma)."""
import numpy as np
import torch

from common.speed import autocast
from common.wrappers import EpisodeWrapper, declare_observations


@torch.no_grad()
def believe(estimator, o, hidden, passes):
    """Belief (N, 12) of observations (N, 9) by M = `passes` stochastic passes, and the LSTM's next state (at a start None).

    A belief is s_hat = (q_hat, pusher, noisy force), without xi, and the four standard deviations sqrt(diag Sigma) in scaled
    units, clipped to [0, 1] (appendix B.1).
    """
    device = next(estimator.parameters(), torch.empty(0)).device  # a filter has none
    with autocast(device):
        q, variance, hidden = estimator.predict(torch.as_tensor(o, device=device)[None], hidden, passes)
    sigma = variance[0].sqrt().clamp(max=1.0)
    return np.concatenate([q[0].cpu().numpy(), o[:, 4:8], sigma.cpu().numpy()], 1), hidden


class Believed(EpisodeWrapper):
    """An Observed env, Mirrored, whose box pose is the estimator's: observations s_hat (N, 8), with `sigma` all of `believe`.

    Infos: `belief` (N, 12), s_hat and sigma of this step in the frame of the env below; where an episode ended, of its end;
    of a world that is not watched, an older one.
    """

    def __init__(self, env, estimator, passes, sigma):
        super().__init__(env)
        self.estimator, self.passes, self.size = estimator, passes, 12 if sigma else 8
        declare_observations(self, self.size)

    def begin(self, worlds, obs, infos):
        belief, hidden = believe(self.estimator, obs, None, self.passes)
        self.remember(worlds, hidden)
        infos.setdefault("belief", belief)
        return belief[:, :self.size]

    def observe(self, obs, infos):
        watched = self.unwrapped.watched
        if len(watched) == self.num_envs:
            self.belief, hidden = believe(self.estimator, obs, self.hidden, self.passes)
        else:
            hidden = tuple(h[:, watched] for h in self.hidden)
            self.belief = self.belief.copy()  # the last one stays in the infos of its step
            self.belief[watched], hidden = believe(self.estimator, obs[watched], hidden, self.passes)
        self.remember(watched, hidden)
        infos["belief"] = self.belief
        return self.belief[:, :self.size]

    def remember(self, worlds, hidden):
        """Puts the hidden state of `worlds` (k,) in its place."""
        if len(worlds) == self.num_envs:
            self.hidden = hidden
            return
        for all_worlds, new in zip(self.hidden, hidden):
            all_worlds[:, worlds] = new.to(all_worlds.dtype)
