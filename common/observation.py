"""The observation model O of sec. 3.2: o = scale(clip(hold(s + bias + noise))) and the occlusion flag xi."""
from collections import deque

import numpy as np

from common import task
from common.task import World
from common.wrappers import EpisodeWrapper, declare_observations, state_of


class ObservationModel:
    """What camera and force sensor report of `num` true states, step by step.

    Correlated noise (the bias) is drawn per episode, uncorrelated noise per step, and occlusions, all as in `world`. An
    occlusion holds the last noisy box pose, bit for bit, with xi at 1, for N(10, 5^2) s or for `occlusion` s: 0 for none,
    math.inf for "until the end". The pusher is exact. In a task.Other the camera may be late and the force have a gain. Each
    `step` takes the same number of draws from its own stream, whatever the states are: with the same seed noise and
    occlusions of the same step are the same, up to the first `reset`.
    """

    def __init__(self, num, seed=0, occlusion=None, world=World()):
        self.num, self.occlusion, self.world = num, occlusion, world
        self.deviation = np.array(world.noise, np.float32)
        self.bias, self.held = np.zeros((num, 5), np.float32), np.zeros((num, 3), np.float32)  # SI units
        self.frames = deque(np.zeros((world.late, num, 3)))  # the boxes that the camera has not shown yet
        self.hidden = np.zeros(num)  # frames for which the running occlusion still hides the box
        self.seed(seed)

    def seed(self, seed):
        self._rng_reset, self._rng_step = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))

    def reset(self, worlds, state):
        """First observations (k, 9) of new episodes in `worlds` (k,) from states (k, 7): never occluded."""
        for frame in self.frames:  # the box was at rest before
            frame[worlds] = state[:, :3]
        noise, frames = self._draw(self._rng_reset, len(worlds))
        self.bias[worlds] = self._rng_reset.standard_normal((len(worlds), 5), np.float32) * self.world.bias
        noisy = self._add(state, self.bias[worlds] + noise)
        self.held[worlds], self.hidden[worlds] = noisy[:, :3], frames
        return assemble(noisy, np.zeros(len(worlds), bool), self.world.max_force)

    def step(self, state):
        """Observations (N, 9) of states (N, 7), float32: the scaled state (8) with the box held in an occlusion, and xi."""
        noise, frames = self._draw(self._rng_step, self.num)
        if self.world.late:
            self.frames.append(state[:, :3].copy())
            state = np.concatenate([self.frames.popleft(), state[:, 3:]], 1)
        occluded = self.hidden > 0
        noisy = self._add(state, self.bias + noise)
        self.held = noisy[:, :3] = np.where(occluded[:, None], self.held, noisy[:, :3])
        self.hidden = np.where(occluded, self.hidden - 1, frames)
        return assemble(noisy, occluded, self.world.max_force)

    def trajectory(self, states):
        """Observations (T, N, 9) of stored trajectories (T, N, 7), each from its episode's start."""
        return np.stack([self.reset(np.arange(self.num), states[0]), *(self.step(s) for s in states[1:])])

    def _draw(self, rng, count):
        """Noise (count, 5), and how many frames to hide after a visible one: round(15 d) with probability p, else 0."""
        noise = rng.standard_normal((count, 5), np.float32) * self.deviation
        start, seconds = rng.random(count), rng.normal(*self.world.occlusion, count)
        seconds = seconds if self.occlusion is None else self.occlusion
        return noise, np.where(start < self.world.occlusion_start, np.maximum(np.round(task.RATE * seconds), 0), 0)

    def _add(self, state, error):
        noisy = state.astype(np.float32)
        if self.world.gain != 1:
            noisy[:, 5:] *= self.world.gain
        noisy[:, [0, 1, 2, 5, 6]] += error
        return noisy


def assemble(noisy, occluded, max_force=World.max_force):
    """Observations o (N, 9) of noisy states (N, 7) and occlusion flags (N,): scaled (8), and xi."""
    return np.concatenate([task.scale(noisy, max_force), occluded[:, None].astype(np.float32)], 1)


class Observed(EpisodeWrapper):
    """A PushVectorEnv seen by an ObservationModel: o (N, 9). Infos: `o` of this step; where an episode ended, of its end."""

    def __init__(self, env, occlusion=None, world=World()):
        super().__init__(env)
        self.model = ObservationModel(env.num_envs, occlusion=occlusion, world=world)
        declare_observations(self, 9)

    def seed(self, seed):
        self.model.seed(seed)

    def begin(self, worlds, obs, infos):
        o = self.model.reset(worlds, infos["state"][worlds])
        infos.setdefault("o", o)
        return o

    def observe(self, obs, infos):
        infos["o"] = self.model.step(state_of(infos))
        return infos["o"]
