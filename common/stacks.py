"""Every policy of the study as one stack of wrappers over PushVectorEnv (sec. 5.2)."""
from common.belief import Believed
from common.env import PushVectorEnv
from common.observation import Observed
from common.symmetry import Mirrored

# method -> the estimator in its loop
ESTIMATOR = {"est_uncertainty": "ours", "est": "ours", "est_mse": "mse", "priv_on_estimate": "ours", "end_to_end": None,
             "behavior_cloning": None, "priv_on_state": None}


def make(method, num_envs, estimator=None, passes=1, occlusion=None, whole_workspace=False):
    """The vector env that a method's policy acts in.

    Args:
        method: a key of ESTIMATOR.
        estimator, passes: the estimator that ESTIMATOR names, and its M.
        occlusion: as in observation.ObservationModel; none for priv_on_state.
        whole_workspace: starts over the whole workspace.
    """
    env = PushVectorEnv(num_envs, whole_workspace=whole_workspace)
    env = Mirrored(env if method == "priv_on_state" else Observed(env, occlusion))
    if ESTIMATOR[method]:
        env = Believed(env, estimator, passes, sigma=method == "est_uncertainty")
    return env
