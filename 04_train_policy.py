"""Stage 04: the control policies under occlusion, each another stack over the same env (sec. 3.3, sec. 5.2).

    python 04_train_policy.py [smoke|quick|laptop|paper] [--method est_uncertainty|est|est_mse|end_to_end|behavior_cloning]
        [--seed k] [--weights DIR] [--field value ...]

Reads pi_priv (01), the teacher sets (02) and the estimators (03): those in the folder --weights, and the others of the same
preset. Writes runs/<preset>/04_train_policy/<method>/seed<k>/: policy.safetensors, metrics.csv, training.png, and
success_rate.png of all methods and seeds or bc_loss.png. Without --method all of the paper's are trained in turn.
"""
from dataclasses import dataclass, fields, replace
from typing import Literal

import torch

from common import command, networks, plots, ppo, ranks, runs, speed, stacks, supervised, symmetry, training, trajectories
from common import weights
from common.files import UserError

TRAINED = {name: method for name, method in stacks.METHODS.items() if method.training != "pi_priv"}


@dataclass
class Reinforced(ppo.Hyperparameters):
    """What the RL methods read."""

    passes: int = 50  # M, stochastic passes of the estimator in the loop (sec. 4)
    warm_start: bool = False  # the RL methods, end_to_end included, start from pi_priv's weights, new inputs at zero
    privileged_critic: bool = False  # RL: the value net reads the true state too (Pinto et al. 2018)


@dataclass
class Cloned:
    """What behaviour cloning reads, beside sizes and grad_norm."""

    bc_sequences: int = 100  # behaviour cloning: trajectories per mini-batch (tab. estimator_hyperparameters)
    bc_epochs: int = 110  # behaviour cloning: passes over the teacher set (tab. estimator_hyperparameters)
    bc_lr: float = 1e-3  # behaviour cloning: Adam's learning rate (tab. estimator_hyperparameters)
    bc_lr_end: float | None = None  # behaviour cloning: learning rate at the end of a cosine; none: it stays, as the paper's
    bc_validation: int = 150_000  # behaviour cloning: most trajectories of a validation (appendix B.3)


@dataclass
class Config(Cloned, Reinforced, command.Reader):
    method: Literal[(*TRAINED, "all")] = "all"  # which policy to train
    sizes: tuple[int, int, int] | None = (128, 256, 128)  # linear, LSTM and linear layer (appendix B.1); none: pi_priv's


_QUICK = dict(num_envs=1024, rollout_steps=32, minibatch=4096, epochs=3, entropy_coef=0.0005, kl_target=0.006,
              kl_target_end=0.002, lr=3e-4, lr_min=2e-5, lr_max=2e-3, sizes=None, warm_start=True, privileged_critic=True,
              bc_lr=2e-3, bc_lr_end=5e-5)
PRESETS = {
    "smoke": dict(num_envs=32, rollout_steps=16, updates=4, minibatch=256, epochs=2, sizes=None, eval_every=4,
                  eval_episodes=16, resume_every=2, warm_start=True, privileged_critic=True, passes=2, bc_sequences=16,
                  bc_epochs=2, bc_validation=12),
    "quick": _QUICK | dict(updates=80, passes=5, bc_sequences=25, bc_epochs=2, bc_validation=500),
    "laptop": _QUICK | dict(updates=500, passes=10, bc_sequences=32, bc_epochs=6, bc_validation=1000),
    "paper": {},
}


def with_sizes(cfg):
    """The config, where it leaves the sizes to pi_priv with those. Raises UserError: it starts from a pi_priv of others."""
    starts = cfg.warm_start and TRAINED[cfg.method].training == "rl"
    if cfg.sizes and not starts:
        return cfg
    sizes = weights.load(networks.Recurrent, runs.find(cfg, "01_train_privileged", "policy.safetensors")).sizes
    if cfg.sizes not in (None, sizes):
        raise UserError(f"--sizes {cfg.sizes}: pi_priv has {sizes}; use those, or --no-warm-start")
    return replace(cfg, sizes=sizes)


def settings_of(cfg):
    """Names of the settings that a method reads."""
    if TRAINED[cfg.method].training == "cloning":
        return {"method", "sizes", "grad_norm", *(field.name for field in fields(Cloned))}
    reads = {"method", *(field.name for field in fields(Reinforced))}
    return reads if TRAINED[cfg.method].estimator else reads - {"passes"}


def inputs_of(cfg):
    """Paths of what a method reads.

    Raises UserError: something is missing, or does not fit, or there are too many processes.
    """
    def nets(*names):
        return {name: runs.find(cfg, "01_train_privileged", f"{name}.safetensors") for name in names}

    if TRAINED[cfg.method].training == "cloning":
        (data, train), (_, validation) = (trajectories.load_set(cfg, f"teacher_{name}") for name in ("train", "validation"))
        supervised.check(data, cfg.bc_sequences)
        return nets("policy") | train | validation
    training.shares(cfg)
    paths = nets("policy", "value") if cfg.warm_start else {}
    if kind := TRAINED[cfg.method].estimator:
        found = stacks.find_estimator(cfg, kind)
        stacks.load_estimator(kind, found)  # what does not fit is told before a run is begun
        paths |= {f"estimator{i or ''}": path for i, path in enumerate(found)}
    return paths or nets("policy")  # what reads no net has pi_priv's world all the same


def start_from(net, trained, first=0):
    """Copies pi_priv's (or its value net's) weights into a net with its inputs from `first` on; others get zero weights."""
    trained_weights = trained.state_dict()
    wide = torch.zeros_like(net.encoder.weight)
    wide[:, first:first + trained.inputs] = trained_weights["encoder.weight"]
    net.load_state_dict(trained_weights | {"encoder.weight": wide})


def train_rl(run, cfg, paths, device):
    """Recurrent PPO on the method's stack (sec. 3.3). False when the time limit stopped it."""
    method, estimator = TRAINED[cfg.method], None
    if kind := method.estimator:
        estimator = stacks.load_estimator(kind, stacks.find_estimator(cfg, kind), device)
    worlds, measured = training.shares(cfg)
    env = stacks.make(method, worlds, estimator, cfg.passes, privileged=cfg.privileged_critic, world=run.world)
    held_out = stacks.make(method, measured, estimator, cfg.passes, world=run.world)
    torch.manual_seed(cfg.seed)
    seen, known = (stack.single_observation_space.shape[0] for stack in (held_out, env))
    pi, critic = networks.policy(seen, cfg.sizes).to(device), networks.value(known, cfg.sizes).to(device)
    if cfg.warm_start:
        start_from(pi, weights.load(networks.Recurrent, paths["policy"], device))
        start_from(critic, weights.load(networks.Recurrent, paths["value"], device), seen if cfg.privileged_critic else 0)
    done = training.train(run, cfg, env, held_out, pi, critic)
    if done and not ranks.RANK:
        weights.save(run.dir / "policy.safetensors", pi)
    return done


def train_bc(run, cfg, paths, device):
    """Behaviour cloning of pi_priv on its own trajectories (appendix B.3). False when the time limit stopped it."""
    teacher = weights.load(networks.Recurrent, paths["policy"], device)
    torch.manual_seed(cfg.seed)
    student = networks.policy(9, cfg.sizes).to(device)

    def loss(o, s, mask, generator):
        """Sum over both velocities of the cross-entropy with the teacher's distribution."""
        off = symmetry.signs(s[0].cpu().numpy())  # the teacher acted in the frame of the true start
        s_teacher = torch.as_tensor(symmetry.mirror(s.cpu().numpy(), off), device=device)
        flipped = torch.as_tensor(off < 0, device=device)[None, :, :, None]
        with speed.autocast(device):
            with torch.no_grad():
                target = networks.log_softmax(teacher(s_teacher)[0]).exp()
            target = torch.where(flipped, target.flip(-1), target)
            logp = networks.log_softmax(student(o)[0])
        return (-(target * logp).sum((-1, -2)) * mask).sum() / mask.sum()

    return supervised.fit(
        run, student, loss, lambda: weights.save(run.dir / "policy.safetensors", student),
        trajectories.load_set(cfg, "teacher_train")[0], trajectories.load_set(cfg, "teacher_validation")[0],
        seed=cfg.seed, sequences=cfg.bc_sequences, epochs=cfg.bc_epochs, lr=cfg.bc_lr, lr_end=cfg.bc_lr_end,
        grad_norm=cfg.grad_norm, validation=cfg.bc_validation, optimizer="adam", fresh=True)


def main(cfg):
    device = command.device_of(cfg)
    for method in [name for name, m in TRAINED.items() if m.published] if cfg.method == "all" else [cfg.method]:
        cfg, cloning = with_sizes(replace(cfg, method=method)), TRAINED[method].training == "cloning"
        paths = inputs_of(cfg)
        run = runs.Run(cfg, "04_train_policy", paths, method, settings_of(cfg))
        if run.skip():
            continue
        if not (train_bc if cloning else train_rl)(run, cfg, paths, device):
            return
        if ranks.RANK:
            continue
        if cloning:
            plots.validation_loss(cfg.roots, "bc_loss", run.dir / "bc_loss.png")
            run.finish(["policy.safetensors"], **supervised.outcome(run))
            print(f"{run.dir}: validation loss {run.record['validation_loss']:.4f}")
        else:
            plots.training(run.rows(), run.dir / "training.png")
            plots.success_rate(cfg.roots, run.dir / "success_rate.png")
            run.finish(["policy.safetensors"], **training.outcome(run))
            print(f"{run.dir}: succeeds in {run.record['success']:.1%} of held-out episodes")


if __name__ == "__main__":
    command.main(Config, PRESETS, main, __doc__)
