"""Rates of the study's parts on this machine, in under three minutes; asserts nothing.

    python tests/benchmark.py
"""
import importlib
import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent.parent))
from common import networks, ppo, speed, stacks  # noqa: E402
from common.env import PushEnv, PushVectorEnv  # noqa: E402
from common.observation import ObservationModel, Observed  # noqa: E402

WORLDS = 1024
rng = np.random.default_rng(0)


def rate(work, steps, seconds=2.0):
    """Steps per second of work(), which does `steps` of them."""
    work()
    begin, count = time.perf_counter(), 0
    while (spent := time.perf_counter() - begin) < seconds:
        work()
        count += steps
    return count / spent


def line(what, value, unit="steps/s"):
    print(f"{what:<76} {value:>10,.0f} {unit}", flush=True)


def play(env, steps=10):
    """So many steps of random actions in every world, and their number."""
    env.reset(seed=0)
    actions = rng.integers(0, 11, (100, env.num_envs, 2))
    return lambda: [env.step(actions[rng.integers(100)]) for _ in range(steps)], steps * env.num_envs


def learn(what, preset, **changes):
    """Rollout and update of pi_priv's nets."""
    stage = importlib.import_module("01_train_privileged")
    hp = stage.Config(**stage.PRESETS[preset] | changes)
    env = stacks.make(stacks.METHODS["priv_on_state"], hp.num_envs)
    actor, critic = networks.policy(8, hp.sizes), networks.value(8, hp.sizes)
    optimizers = [torch.optim.Adam(net.parameters(), lr=1e-4, eps=1e-5) for net in (actor, critic)]
    obs, _ = env.reset(seed=0)
    carry = obs, actor.initial(hp.num_envs), critic.initial(hp.num_envs)
    steps = hp.num_envs * hp.rollout_steps
    line(f"rollout, {what}", rate(lambda: ppo.rollout(env, actor, critic, carry, hp.rollout_steps), steps, 3))
    batch, _ = ppo.rollout(env, actor, critic, carry, hp.rollout_steps)

    def update():
        ppo.update(actor, critic, optimizers, ppo.sequences(batch, critic, hp.gamma, hp.lam), hp)

    def both():
        ppo.rollout(env, actor, critic, carry, hp.rollout_steps)
        update()

    line(f"update, {what}, {hp.epochs} epochs, {hp.minibatch:,} a mini-batch", rate(update, steps, 3))
    line(f"rollout and update, {what}", rate(both, steps, 3))


def main():
    speed.set_up()
    where = torch.backends.cpu.get_cpu_capability()
    print(f"torch {torch.__version__}, {where}, "
          f"bfloat16 {'yes' if torch.cpu._is_avx512_bf16_supported() else 'no'}\n")
    env = PushEnv()
    env.reset(seed=0)
    line("PushEnv, random actions", rate(lambda: [env.step(rng.integers(0, 11, 2)) for _ in range(100)], 100))
    for num in (1, 64, 512, WORLDS):
        line(f"PushVectorEnv, random actions, {num} worlds", rate(*play(PushVectorEnv(num))))
    line(f"observation model in the loop, simulator included, {WORLDS} worlds", rate(*play(Observed(PushVectorEnv(WORLDS)))))
    states = rng.uniform(-0.1, 0.1, (300, 100, 7)).astype(np.float32)
    line("observation model over stored trajectories, 100 at a time",
         rate(lambda: ObservationModel(100, 0).trajectory(states), states[..., 0].size))
    for name, preset in (("paper's", "paper"), ("quick's", "quick")):
        stage = importlib.import_module("03_train_estimator")
        estimator = networks.Estimator(stage.Config(**stage.PRESETS[preset]).sizes).requires_grad_(False)
        for passes in (1, 4, 10, 50):
            stack = stacks.make(stacks.METHODS["est_uncertainty"], WORLDS, estimator, passes)
            line(f"{name} estimator in the loop, all included, M = {passes}, {WORLDS} worlds", rate(*play(stack, 2)))
    learn("quick's pi_priv", "quick")
    learn("paper's nets, 1024 worlds x 32 steps", "paper", num_envs=WORLDS, rollout_steps=32)


if __name__ == "__main__":
    main()
