"""The observation model O of sec. 3.2: o = scale(clip(hold(s + bias + noise))) and the occlusion flag xi."""
import numpy as np

from common import task
from common.task import World
from common.wrappers import EpisodeWrapper, declare_observations, state_of


class ObservationModel:
    """What camera and force sensor report of `num` true states, step by step.

    Correlated noise (the bias) is drawn per episode, uncorrelated noise per step, and occlusions, all as in `world`. An
    occlusion holds the last noisy box pose, bit for bit, with xi at 1, for a normally distributed time as `world` says, or for
    `occlusion` s: 0 for none, math.inf for "until the end". The pusher is exact. In a task.Other the camera may be late and the
    force have a gain. Each `step` takes the same number of draws from its own stream, whatever the states are: with the same
    seed noise and occlusions of the same step are the same, up to the first `reset`.
    """

    def __init__(self, num, seed=0, occlusion=None, world=World()):
        self.num, self.occlusion, self.world = num, occlusion, world
        self.deviation = np.array(world.noise, np.float32)
        self.bias, self.held = np.zeros((num, 5), np.float32), np.zeros((num, 3), np.float32)  # SI units
        self.frames = np.zeros((world.late, num, 3), np.float32)  # the boxes that the camera has not shown yet
        self.hidden = np.zeros(num)  # frames for which the running occlusion still hides the box
        self.seed(seed)

    def seed(self, seed):
        self._rng_reset, self._rng_step = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))

    def reset(self, worlds, state):
        """First observations (k, 9) of new episodes in `worlds` (k,) from states (k, 7): never occluded."""
        self.frames[:, worlds] = state[:, :3]  # the box was at rest before
        noise, (self.hidden[worlds],) = self._draw(self._rng_reset, 1, len(worlds))
        self.bias[worlds] = self._rng_reset.standard_normal((len(worlds), 5), np.float32) * self.world.bias
        noisy = self._add(state, self.bias[worlds] + noise[0])
        self.held[worlds] = noisy[:, :3]
        return assemble(noisy, np.zeros(len(worlds), bool), self.world.max_force)

    def step(self, state):
        """Observations (N, 9) of states (N, 7), float32: the scaled state (8) with the box held in an occlusion, and xi."""
        return self.steps(state[None])[0]

    def steps(self, states):
        """`step` for states (T, N, 7), one behind the other: observations (T, N, 9)."""
        noise, frames = self._draw(self._rng_step, len(states), self.num)
        occluded = np.empty(frames.shape, bool)
        for t, more in enumerate(frames):
            occluded[t] = self.hidden > 0
            self.hidden = np.where(occluded[t], self.hidden - 1, more)
        if self.world.late:
            boxes = np.concatenate([self.frames, states[..., :3]])
            states, self.frames = np.concatenate([boxes[:len(states)], states[..., 3:]], -1), boxes[len(states):]
        noisy = self._add(states, self.bias + noise)
        last = np.zeros((len(states) + 1, self.num), int)  # the row of the last sight, as `held` is row 0
        np.maximum.accumulate(np.where(occluded, 0, np.arange(1, len(last))[:, None]), out=last[1:])
        shown = np.concatenate([self.held[None], noisy[..., :3]])[last, np.arange(self.num)]
        noisy[..., :3], self.held = shown[1:], shown[-1]
        return assemble(noisy, occluded, self.world.max_force)

    def trajectory(self, states):
        """Observations (T, N, 9) of stored trajectories (T, N, 7), each from its episode's start."""
        return np.concatenate([self.reset(np.arange(self.num), states[0])[None], self.steps(states[1:])])

    def _draw(self, rng, steps, count):
        """Noise (steps, count, 5), and how many frames to hide after a visible one: round(15 d) with probability p, else 0.

        Step by step, so that the draws of one are the same however many are drawn at once.
        """
        noise, (start, seconds) = np.empty((steps, count, 5), np.float32), np.empty((2, steps, count))
        for t in range(steps):
            rng.standard_normal(out=noise[t], dtype=np.float32)
            rng.random(out=start[t])
            seconds[t] = rng.normal(*self.world.occlusion, count)
        seconds = seconds if self.occlusion is None else self.occlusion
        hides = np.where(start < self.world.occlusion_start, np.maximum(np.round(task.RATE * seconds), 0), 0)
        return noise * self.deviation, hides

    def _add(self, states, error):
        noisy = states.astype(np.float32)
        if self.world.gain != 1:
            noisy[..., 5:] *= self.world.gain
        noisy[..., [0, 1, 2, 5, 6]] += error
        return noisy


def assemble(noisy, occluded, max_force=World.max_force):
    """Observations o (..., 9) of noisy states (..., 7) and occlusion flags (...): scaled (8), and xi."""
    return np.concatenate([task.scale(noisy, max_force), occluded[..., None].astype(np.float32)], -1)


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
