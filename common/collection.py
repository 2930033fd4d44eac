"""Whole episodes as stored trajectories, the player's eye on the box or off it (sec. 3.2, "Data Collection")."""
import numpy as np
import torch

from common import episodes, symmetry, task
from common.env import PushVectorEnv
from common.wrappers import EpisodeWrapper, state_of

# A drifting pose errs about as an estimate does that has not been corrected for a while; chosen so, not tuned
DRIFT = np.array([0.03, 0.03, 0.4])  # m, m, rad: the largest standard deviations
DRIFT_TIME = 4.0  # s, in which it forgets its error


class Drifting(EpisodeWrapper):
    """A PushVectorEnv whose last `count` worlds show the box off its pose, in their first episode, which is the one collected.

    The error is an Ornstein-Uhlenbeck process that begins small, of another size in each world. A player that believes it
    moves as one that acts on an estimate: its motion does not betray the true pose.
    """

    def __init__(self, env, count):
        super().__init__(env)
        self.count = count

    def seed(self, seed):
        self.rng = np.random.default_rng([seed, 2])
        self.size = self.rng.random((self.num_envs, 1)) * DRIFT
        self.size[:self.num_envs - self.count] = 0
        self.error = 0.3 * self.draw()

    def draw(self):
        return self.size * self.rng.standard_normal(self.size.shape)

    def begin(self, worlds, obs, infos):
        return self.off_its_pose(infos["state"][worlds], self.error[worlds])

    def observe(self, obs, infos):
        keep = np.exp(-1 / (task.RATE * DRIFT_TIME))
        self.error = keep * self.error + np.sqrt(1 - keep**2) * self.draw()
        return self.off_its_pose(state_of(infos), self.error)

    def off_its_pose(self, state, error):
        return self.unwrapped.scaled(np.concatenate([state[:, :3] + error, state[:, 3:]], 1))


def collect(policy, world, num_envs, seed, drifting=0):
    """States (steps, 7), lengths and success of one sampled episode a world; the last `drifting` ones see the box drift."""
    states = np.empty((world.horizon, num_envs, 7), np.float32)

    def record(t, env):
        states[t] = env.unwrapped.state

    torch.manual_seed(seed)
    env = symmetry.Mirrored(Drifting(PushVectorEnv(num_envs, world=world), drifting))
    success, length = episodes.play(env, policy, seed, greedy=False, record=record)
    return states.swapaxes(0, 1)[np.arange(world.horizon) < length[:, None]], length, success
