"""Rates of the study's parts on this machine, in under five minutes; asserts nothing.

    python tests/benchmark.py
"""
import importlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent.parent))
from common import networks, particles, ppo, ranks, speed, stacks, task, training, trajectories  # noqa: E402
from common.env import PushEnv, PushVectorEnv  # noqa: E402
from common.observation import ObservationModel, Observed  # noqa: E402

WORLDS, MANY = 1024, 4096
HOW = f"{ranks.COUNT} processes" if ranks.COUNT > 1 else "1 process, 2 threads"
rng = np.random.default_rng(0)


def rate(work, steps, seconds=2.0):
    """Steps per second of work(), which does `steps` of them, in all processes."""
    work()
    begin, count = time.perf_counter(), 0
    while ranks.lead(lambda: time.perf_counter() - begin)() < seconds:
        work()
        count += steps
    return count / (time.perf_counter() - begin)


def line(what, value, unit="steps/s", more=""):
    if ranks.RANK == 0:
        print(f"{what:<84} {value:>10,.0f} {unit}{more}", flush=True)


def play(env, steps=10):
    """So many steps of random actions in every world, and their number."""
    env.reset(seed=0)
    actions = rng.integers(0, 11, (100, env.num_envs, 2))
    return lambda: [env.step(actions[rng.integers(100)]) for _ in range(steps)], steps * env.num_envs


def push(env, steps=30):
    """The same, every box pushed."""
    pusher, velocity = [-0.1 - task.BOX[0] / 2 - task.RADIUS - 1e-3, 0.0], np.tile([task.MAX_SPEED, 0.01], (env.num_envs, 1))

    def work():
        env.reset(seed=0, options={"box": [-0.1, 0.0, 0.0], "pusher": pusher})
        for _ in range(steps):
            env.worlds.step(velocity)
    return work, steps * env.num_envs


def peak(size=2048):
    """Operations per second of matrix products, in two threads and in the precision of the nets."""
    a = torch.randn(size, size, dtype=torch.bfloat16 if torch.cpu._is_avx512_bf16_supported() else torch.float32)
    return rate(lambda: speed.side_by_side(lambda _: a @ a, range(2)), 4 * size**3)


def share(steps_per_s, most, *nets):
    """What a training reaches of it, with 2 operations a weight and step forward and 4 backward."""
    weights = sum(p.numel() for net in nets for p in net.parameters() if p.ndim > 1)
    return f", {6 * weights * steps_per_s / most:.0%} of the matrix peak" if most else ""


def learn(what, preset, most, **changes):
    """Rollout and update of pi_priv's nets."""
    stage = importlib.import_module("01_train_privileged")
    hp = stage.Config(**stage.PRESETS[preset] | changes)
    env = stacks.make(stacks.METHODS["priv_on_state"], training.shares(hp)[0])
    actor, critic = networks.policy(8, hp.sizes), networks.value(8, hp.sizes)
    optimizers = [ppo.optimizer(net, 1e-4) for net in (actor, critic)]
    carry = training.begin(env, actor, critic, 0, 0)
    steps = hp.num_envs * hp.rollout_steps
    line(f"rollout, {what}, {HOW}", rate(lambda: ppo.rollout(env, actor, critic, carry, hp.rollout_steps), steps, 3))
    batch, _ = ppo.rollout(env, actor, critic, carry, hp.rollout_steps)

    def update():
        ppo.update(actor, critic, optimizers, ppo.sequences(batch, hp.gamma, hp.lam), hp)

    def both():
        ppo.rollout(env, actor, critic, carry, hp.rollout_steps)
        update()

    updates = rate(update, steps, 3)
    line(f"update, {what}, {hp.epochs} epochs, {hp.minibatch:,} a mini-batch, {HOW}", updates,
         more=share(updates * hp.epochs, most, actor, critic))
    line(f"rollout and update, {what}, {HOW}", rate(both, steps, 3))


def estimate(preset, most, batches=30):
    """Mini-batches of 03, one epoch of them, the validation left out."""
    stage = importlib.import_module("03_train_estimator")
    cfg = stage.Config(**stage.PRESETS[preset] | dict(method="ours", epochs=1, validation=1))
    offsets = np.arange(batches * cfg.sequences + 1) * task.World().horizon
    data = rng.uniform(-0.1, 0.1, (offsets[-1], 7)).astype(np.float32), offsets
    with tempfile.TemporaryDirectory() as folder:
        run = SimpleNamespace(dir=Path(folder) / "seed0", log=lambda **row: None, save_resume=lambda state: None,
                              load_resume=lambda: None, out_of_time=lambda: False, world=task.World())
        begin = time.perf_counter()
        stage.train(run, cfg, data, data, torch.device("cpu"))
        per_s = batches / (time.perf_counter() - begin)
    steps = per_s * cfg.sequences * task.World().horizon
    line(f"03, {preset}, steps of trajectories, {HOW}", steps, more=f": {per_s:.1f} mini-batches/s" + share(
        steps, most, networks.Estimator(cfg.sizes)))


def train(most=None):
    """The trainings, which torchrun shares out."""
    learn("quick's pi_priv", "quick", most)
    learn("paper's nets, 1024 worlds x 32 steps", "paper", most, num_envs=WORLDS, rollout_steps=32)
    estimate("laptop", most)


def main():
    print(f"torch {torch.__version__}, {torch.backends.cpu.get_cpu_capability()}, "
          f"bfloat16 {'yes' if torch.cpu._is_avx512_bf16_supported() else 'no'}\n")
    env = PushEnv()
    env.reset(seed=0)
    line("PushEnv, random actions", rate(lambda: [env.step(rng.integers(0, 11, 2)) for _ in range(100)], 100))
    for num in (1, 64, 512, WORLDS):
        line(f"PushVectorEnv, random actions, {num} worlds", rate(*play(PushVectorEnv(num))))
    for threads in (1, 2):
        line(f"PushVectorEnv, random actions, {MANY} worlds, threads = {threads}", rate(*play(PushVectorEnv(MANY, threads=threads))))
        line(f"Worlds, every box pushed, {MANY} worlds, threads = {threads}", rate(*push(PushVectorEnv(MANY, threads=threads))))
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
    folder = Path(__file__).parent.parent / "pretrained/02_collect/seed0"
    test = trajectories.load(*(folder / name for name in trajectories.files("test")))
    o, _, _ = trajectories.observe(test, np.array([len(test[1]) - 2]), 0, "cpu")  # the last, whose player pushes
    for num in (250, 500, 1000, 2000, 4000):
        filters = particles.Filters(num)
        line(f"particle filter of one trajectory, {num} particles", rate(lambda: filters.predict(o), len(o)))
    train(peak())
    subprocess.run([sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", __file__], check=True)


if __name__ == "__main__":
    speed.set_up(2, ranks.LOCAL_COUNT)
    ranks.begin(torch.device("cpu"))
    train() if ranks.COUNT > 1 else main()
    ranks.end()
