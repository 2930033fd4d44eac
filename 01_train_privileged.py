"""Stage 01: pi_priv, trained with recurrent PPO on the true state, without occlusion (sec. 4, "Privileged Policy").

    python 01_train_privileged.py [smoke|quick|laptop|paper] [--seed k] [--field value ...]

Writes runs/<preset>/01_train_privileged/seed<k>/: policy.safetensors, value.safetensors, checkpoint_*.safetensors
(uniformly spaced over training, the untrained net first), metrics.csv, training.png, success_rate_priv.png (all seeds that
are there), starts.png (success over where the box starts). Resumes where it stopped.
"""
from dataclasses import dataclass

import numpy as np
import torch
import tyro

from common import command, episodes, networks, plots, ppo, ranks, runs, stacks, training, weights
from common.files import UserError
from common.task import World


@dataclass
class Config(ppo.Hyperparameters, command.Stage):
    world: tyro.conf.OmitArgPrefixes[World] = World()  # settings that hold for all the stages after this one
    checkpoints: int = 300  # uniformly spaced checkpoints of pi_priv, the untrained and the last included (sec. 4)


_QUICK = dict(num_envs=1024, rollout_steps=32, minibatch=4096, epochs=3, entropy_coef=0.002, kl_target=0.015, lr_min=1e-4,
              lr_max=2e-3, sizes=(64, 128, 64), tolerance=4.0, near_share=0.8)
PRESETS = {
    "smoke": dict(num_envs=32, rollout_steps=16, updates=6, minibatch=256, epochs=2, sizes=(16, 16, 16), checkpoints=3,
                  eval_every=3, eval_episodes=16, resume_every=2, tolerance=4.0, near_share=0.5,
                  world=World(time_limit=4.0)),
    "quick": _QUICK | dict(updates=500, checkpoints=26),
    "laptop": _QUICK | dict(world=World(mass=(1.0, 5.0)), updates=3000, kl_target_end=0.005, lr_min=2e-5, checkpoints=100),
    "paper": dict(tolerance=4.0, near_share=0.8),  # without: nothing learned in 10 million steps (results/README.md)
}


def by_start(env, actor, seed):
    """Centres (N, 2) in m at which the boxes of eight times --eval-episodes start, and success (N,) from there."""
    centres, won = [], []

    def keep(t, env):
        if t == 0:
            centres.append(env.unwrapped.box[:, :2])

    for k in range(8 * ranks.COUNT):
        won.append(episodes.play(env, actor, 10**7 + 1000 * seed + k, record=keep)[0])
    return np.concatenate(centres), np.concatenate(won)


def main(cfg):
    limit = min(1000, cfg.updates + 1)
    if not 2 <= cfg.checkpoints <= limit:
        raise UserError(f"--checkpoints {cfg.checkpoints}: say 2 to {limit}; at most --updates and one more, or 1000")
    device, worlds = command.device_of(cfg), training.shares(cfg)
    run = runs.Run(cfg, "01_train_privileged")
    if run.skip():
        return
    torch.manual_seed(cfg.seed)
    pi_priv = networks.policy(8, cfg.sizes).to(device)
    critic = networks.value(8, cfg.sizes).to(device)

    names = [f"checkpoint_{i:03d}.safetensors" for i in range(cfg.checkpoints)]
    spaced = {round(i * cfg.updates / (cfg.checkpoints - 1)): i for i in range(cfg.checkpoints)}

    def keep(update, actor):
        if update in spaced:
            weights.save(run.dir / names[spaced[update]], actor)

    env, held_out = (stacks.make(stacks.METHODS["priv_on_state"], n, world=cfg.world) for n in worlds)
    if not training.train(run, cfg, env, held_out, pi_priv, critic, keep) or ranks.RANK:
        return
    weights.save(run.dir / "policy.safetensors", pi_priv)
    weights.save(run.dir / "value.safetensors", critic)
    plots.training(run.rows(), run.dir / "training.png")
    plots.starts(*by_start(held_out, pi_priv, cfg.seed), run.dir / "starts.png")
    plots.success_rate_priv(cfg.roots, run.dir / "success_rate_priv.png")
    run.finish(["policy.safetensors", "value.safetensors", *names], **training.outcome(run))
    print(f"{run.dir}: pi_priv succeeds in {run.record['success']:.1%} of held-out episodes")


if __name__ == "__main__":
    command.main(Config, PRESETS, main, __doc__)
