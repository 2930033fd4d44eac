"""The observation model O of sec. 3.2: o = scale(clip(hold(s + bias + noise))) and the occlusion flag xi."""

import gymnasium as gym
import numpy as np

from common import task


class ObservationModel:
    """What camera and force sensor report of N true states, step by step.

    Correlated noise (the bias) is drawn per episode, uncorrelated noise per step, both with task.NOISE. During an occlusion
    the last noisy box pose is held, bit for bit, and xi is 1. The pusher is exact.

    Args:
        num: number of worlds or trajectories.
        seed: of the draws. Each `step` takes the same number of draws from its own stream, whatever the states are: runs
            with the same seed see the same noise and occlusions at the same step, up to their first `reset`.
        occlusion: duration in s of every occlusion; 0 for none, math.inf for "until the end", None for the paper's
            N(10, 5^2).
    """

    def __init__(self, num, seed=0, occlusion=None):
        self.num, self.occlusion = num, occlusion
        self.bias = np.zeros((num, 5), np.float32)
        self.held = np.zeros((num, 3), np.float32)  # m, m, rad
        self.left = np.zeros(num)  # frames that the running occlusion still lasts
        self.seed(seed)

    def seed(self, seed):
        self._rng_reset, self._rng_step = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))

    def reset(self, worlds, state):
        """First observations (k, 9) of new episodes in `worlds` (k,) from states (k, 7): never occluded."""
        noise, start, seconds = self._draw(self._rng_reset, len(worlds))
        self.bias[worlds] = self._rng_reset.standard_normal((len(worlds), 5), np.float32) * task.NOISE
        noisy = self._add(state, self.bias[worlds] + noise)
        self.held[worlds] = noisy[:, :3]
        self.left[worlds] = self._next_occlusion(start, seconds)
        return assemble(noisy, np.zeros(len(worlds), bool))

    def step(self, state):
        """Observations (N, 9) of states (N, 7), float32: the scaled state (8) with the box held in an occlusion, and xi."""
        noise, start, seconds = self._draw(self._rng_step, self.num)
        occluded = self.left > 0
        noisy = self._add(state, self.bias + noise)
        self.held = noisy[:, :3] = np.where(occluded[:, None], self.held, noisy[:, :3])
        self.left = np.where(occluded, self.left - 1, self._next_occlusion(start, seconds))
        return assemble(noisy, occluded)

    def trajectory(self, states):
        """Observations (T, N, 9) of stored trajectories (T, N, 7), each from its episode's start."""
        first = self.reset(np.arange(self.num), states[0])
        return np.stack([first, *(self.step(s) for s in states[1:])])

    def _draw(self, rng, count):
        return (rng.standard_normal((count, 5), np.float32) * task.NOISE.astype(np.float32), rng.random(count),
                rng.normal(task.OCCLUSION_MEAN, task.OCCLUSION_STD, count))

    def _next_occlusion(self, start, seconds):
        """Frames to hide after a visible one: round(15 d) with probability p, else 0."""
        if self.occlusion is not None:
            seconds = np.full_like(seconds, self.occlusion)
        frames = np.maximum(np.round(task.RATE * seconds), 0)
        return np.where(start < task.OCCLUSION_START, frames, 0)

    @staticmethod
    def _add(state, error):
        noisy = state.astype(np.float32)
        noisy[:, [0, 1, 2, 5, 6]] += error
        return noisy


def assemble(noisy, occluded):
    """Observations o (N, 9) of noisy states (N, 7) and occlusion flags (N,): scaled (8), and xi."""
    return np.concatenate([task.scale(noisy), occluded[:, None].astype(np.float32)], 1)


def show(wrapper, size):
    """Declares a vector wrapper's observations: (N, size) float32, unbounded."""
    wrapper.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
    wrapper.observation_space = gym.vector.utils.batch_space(wrapper.single_observation_space, wrapper.num_envs)


class Observed(gym.vector.VectorWrapper):
    """A PushVectorEnv seen through an ObservationModel: observations (N, 9), final_obs included.

    Infos: `o` (N, 9), the observation of this step; where an episode ended, of its end.
    """

    def __init__(self, env, occlusion=None):
        super().__init__(env)
        self.model = ObservationModel(env.num_envs, occlusion=occlusion)
        show(self, 9)

    def reset(self, *, seed=None, options=None):
        _, infos = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self.model.seed(seed)
        o = self.model.reset(np.arange(self.num_envs), infos["state"])
        return o, infos | {"o": o}

    def step(self, action):
        _, reward, terminated, truncated, infos = self.env.step(action)
        obs = infos["o"] = self.model.step(infos.get("final_state", infos["state"]))
        if "final_obs" in infos:  # the ended episode's bias and occlusion see its last state; only then are they cleared
            infos["final_obs"] = obs
            ended = np.flatnonzero(infos["_final_obs"])
            obs = obs.copy()
            obs[ended] = self.model.reset(ended, infos["state"][ended])
        return obs, reward, terminated, truncated, infos
