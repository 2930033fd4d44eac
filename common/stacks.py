"""The methods of the study (sec. 5.2): what each policy reads, and its stack of wrappers over PushVectorEnv.

A method whose stack is made of the wrappers at hand is one entry of METHODS: training, evaluation, tables and figures follow.
"""
from dataclasses import dataclass
from typing import Literal

import numpy as np

from common import networks, runs, speed, weights
from common.belief import Believed
from common.env import PushVectorEnv
from common.files import UserError
from common.observation import Observed
from common.symmetry import Mirrored, mirror
from common.task import World
from common.wrappers import EpisodeWrapper, declare_observations, state_of


PAY = 2000  # worlds from which a further thread of the simulator pays beside the nets: 12 to 18 % of a rollout at 4096


@dataclass(frozen=True)
class EstimatorKind:
    """A state estimator of stage 03 (tab. estimator_ablation)."""

    label: str
    likelihood: bool = True  # trained with eq. 1, else with the mean squared error
    dropout: bool = True  # MC dropout in training and use
    nets: tuple[tuple[str, int], ...] = ()  # (kind, seed) of what it is an ensemble of; none: it is trained itself
    scaled: bool = False  # by their scales


@dataclass(frozen=True)
class Method:
    """A policy of the study."""

    label: str  # in the figures
    reads: Literal["s", "o", "s_hat", "s_hat, sigma"]  # true state, observation with xi, estimate, and with its uncertainty
    estimator: str | None  # key of ESTIMATORS: the one in its loop
    training: Literal["pi_priv", "rl", "cloning"]  # pi_priv: the policy of 01, untouched; the others are trained by 04
    published: bool = True  # by the paper; the others are trained when they are named

    def __post_init__(self):
        known, needed = self.estimator in (None, *ESTIMATORS), self.reads not in ("s", "o")
        if not known or needed != (self.estimator is not None) or self.reads not in {
                "pi_priv": ("s", "s_hat"), "cloning": ("o",), "rl": ("o", "s_hat", "s_hat, sigma")}[self.training]:
            raise ValueError(f"{self}: no stack of these wrappers")


ESTIMATORS = {
    "ours": EstimatorKind("ours (likelihood + MC dropout)", likelihood=True, dropout=True),
    "likelihood": EstimatorKind("likelihood loss", likelihood=True, dropout=False),
    "mse": EstimatorKind("MSE loss", likelihood=False, dropout=False),
    "ensemble": EstimatorKind("three of likelihood loss", nets=tuple(("likelihood", k) for k in range(3))),
    "ours_scaled": EstimatorKind("ours, scaled", nets=(("ours", 0),), scaled=True),
}
METHODS = {
    "est_uncertainty": Method(r"$\pi_{est}(\hat{s}, \hat{\Sigma})$", "s_hat, sigma", "ours", "rl"),
    "est": Method(r"$\pi_{est}(\hat{s})$", "s_hat", "ours", "rl"),
    "est_mse": Method(r"$\pi_{est}(\hat{s})$, MSE estimator", "s_hat", "mse", "rl"),
    "priv_on_estimate": Method(r"$\pi_{priv}(\hat{s})$", "s_hat", "ours", "pi_priv"),
    "end_to_end": Method("end-to-end RL", "o", None, "rl"),
    "behavior_cloning": Method("behavior cloning", "o", None, "cloning"),
    "priv_on_state": Method(r"$\pi_{priv}(s)$", "s", None, "pi_priv"),
    "est_likelihood": Method(r"$\pi_{est}$, likelihood", "s_hat, sigma", "likelihood", "rl", published=False),
    "est_ensemble": Method(r"$\pi_{est}$, ensemble", "s_hat, sigma", "ensemble", "rl", published=False),
    "est_ensemble_mean": Method(r"$\pi_{est}(\hat{s})$, ensemble", "s_hat", "ensemble", "rl", published=False),
    "est_scaled": Method(r"$\pi_{est}$, scaled sigma", "s_hat, sigma", "ours_scaled", "rl", published=False),
}
TRAINED = {name: kind for name, kind in ESTIMATORS.items() if not kind.nets}  # by 03


def find_estimator(cfg, kind):
    """Paths of the nets of a kind of estimator. Raises runs.Missing, and runs.Mixed: seeds of two studies are no ensemble."""
    paths = [runs.find(cfg, "03_train_estimator", "estimator.safetensors", name, seed)
             for name, seed in ESTIMATORS[kind].nets or [(kind, 0)]]
    if len(paths) > 1:
        runs.check_lineage(cfg, paths[0].parent, runs.hashes_of(cfg, paths))
    return paths


def load_estimator(kind, paths, device="cpu"):
    """A kind of estimator from the paths of its nets. Raises UserError: a scale is asked for that is not known."""
    nets = [weights.load(networks.Estimator, path, device) for path in paths]
    if ESTIMATORS[kind].scaled and None in [net.scale for net in nets]:
        raise UserError(f"{paths[0]} has no scale of its sigma: train it anew with 03_train_estimator.py, or take newer weights")
    return networks.Ensemble(nets, ESTIMATORS[kind].scaled) if ESTIMATORS[kind].nets else nets[0]


def make(method, num_envs, estimator=None, passes=1, occlusion=None, privileged=False, world=World()):
    """The vector env that a method's policy acts in.

    Args: estimator, passes: the one that the method names, and its M; occlusion: as in ObservationModel, none where the true
    state is read; privileged: append the true state, see Privileged; world: as in PushVectorEnv.
    """
    env = PushVectorEnv(num_envs, world=world, threads=max(1, min(speed.workers, num_envs // PAY)))
    env = frame = Mirrored(env if method.reads == "s" else Observed(env, occlusion, world))
    if method.estimator:
        env = Believed(env, estimator, passes, sigma=method.reads == "s_hat, sigma")
    return Privileged(env, frame) if privileged else env


class Privileged(EpisodeWrapper):
    """A stack whose observations (N, D) are followed by the true state (N, 8), in the frame of `frame`, its Mirrored.

    For training: the value net reads all of it (an asymmetric critic: Pinto et al. 2018), the policy the first D entries.
    """

    def __init__(self, env, frame):
        super().__init__(env)
        self.frame = frame
        declare_observations(self, env.single_observation_space.shape[0] + 8)

    def begin(self, worlds, obs, infos):
        return np.concatenate([obs, mirror(self.unwrapped.scaled(infos["state"][worlds]), self.frame.sign[worlds])], 1)

    def observe(self, obs, infos):
        return np.concatenate([obs, mirror(self.unwrapped.scaled(state_of(infos)), infos["sign"])], 1)
