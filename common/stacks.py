"""Every policy of the study as one stack of wrappers over PushVectorEnv (sec. 5.2)."""
import gymnasium as gym
import numpy as np

from common import task
from common.belief import Believed
from common.env import PushVectorEnv
from common.observation import Observed, show
from common.symmetry import Mirrored, mirror

# method -> the estimator in its loop
ESTIMATOR = {"est_uncertainty": "ours", "est": "ours", "est_mse": "mse", "priv_on_estimate": "ours", "end_to_end": None,
             "behavior_cloning": None, "priv_on_state": None}


def make(method, num_envs, estimator=None, passes=1, occlusion=None, whole_workspace=False, privileged=False):
    """The vector env that a method's policy acts in.

    Args:
        method: a key of ESTIMATOR.
        estimator, passes: the estimator that ESTIMATOR names, and its M.
        occlusion: as in observation.ObservationModel; none for priv_on_state.
        whole_workspace: starts over the whole workspace.
        privileged: append the true state, see Privileged.
    """
    env = PushVectorEnv(num_envs, whole_workspace=whole_workspace)
    env = frame = Mirrored(env if method == "priv_on_state" else Observed(env, occlusion))
    if ESTIMATOR[method]:
        env = Believed(env, estimator, passes, sigma=method == "est_uncertainty")
    return Privileged(env, frame) if privileged else env


class Privileged(gym.vector.VectorWrapper):
    """A stack whose observations (N, D) are followed by the true state (N, 8), final_obs included.

    For training: the value net reads all of it (an asymmetric critic: Pinto et al. 2018), the policy the first D entries.

    Args:
        env: the stack.
        frame: the Mirrored in it, in whose frame the true state is.
    """

    def __init__(self, env, frame):
        super().__init__(env)
        self.frame = frame
        show(self, env.single_observation_space.shape[0] + 8)

    def reset(self, *, seed=None, options=None):
        obs, infos = self.env.reset(seed=seed, options=options)
        return self._with(obs, infos["state"], self.frame.sign), infos

    def step(self, action):
        sign = self.frame.sign
        obs, *rest, infos = self.env.step(action)
        if "final_obs" in infos:
            infos["final_obs"] = self._with(infos["final_obs"], infos["final_state"], sign)
        return self._with(obs, infos["state"], self.frame.sign), *rest, infos

    def _with(self, obs, state, sign):
        return np.concatenate([obs, mirror(task.scale(state), sign)], 1)
