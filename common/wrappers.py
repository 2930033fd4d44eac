"""The one place that knows gymnasium's SAME_STEP autoreset: what an episode's end and the next one's start look like.

Where an episode ends in a step, `final_obs` of the infos holds its end and the observation is the next one's start. So a
wrapper observes every world's step first, with what it keeps of the running episodes, and only then begins the new ones.
"""
import gymnasium as gym
import numpy as np


class EpisodeWrapper(gym.vector.VectorWrapper):
    """A vector wrapper that tells of observations at a start (`begin`) and at a step, an end included (`observe`)."""

    def begin(self, worlds, obs, infos):
        """Observations (k, D) of episodes that start in `worlds` (k,), from (k, .) of the env below and all worlds' infos."""
        return obs

    def observe(self, obs, infos):
        """Observations (N, D) of a step from (N, .) of the env below: of an ended episode its last one, as state_of(infos)."""
        return obs

    def act(self, action):
        """Actions for the env below."""
        return action

    def seed(self, seed):
        """Seeds what `begin` and `observe` draw."""

    def reset(self, *, seed=None, options=None):
        obs, infos = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self.seed(seed)
        return self.begin(np.arange(self.num_envs), obs, infos), infos

    def step(self, action):
        obs, reward, terminated, truncated, infos = self.env.step(self.act(action))
        seen = self.observe(infos.get("final_obs", obs), infos)
        if "final_obs" in infos:
            infos["final_obs"] = seen
            ended = np.flatnonzero(infos["_final_obs"])
            seen = seen.copy()
            seen[ended] = self.begin(ended, obs[ended], infos)
        return seen, reward, terminated, truncated, infos


def state_of(infos):
    """True states (N, 7) of a step in SI units: where an episode ended, of its end."""
    return infos.get("final_state", infos["state"])


def declare_observations(wrapper, size):
    """Declares a vector wrapper's observations: (N, size) float32, unbounded."""
    wrapper.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
    wrapper.observation_space = gym.vector.utils.batch_space(wrapper.single_observation_space, wrapper.num_envs)
