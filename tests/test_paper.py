"""The paper's nets, with few worlds and trajectories: an update of every kind."""
import importlib

import numpy as np
import pytest
import torch

from common import networks, ppo, runs, stacks, trajectories, weights


def paper(script, **kw):
    """A script as a module, and its paper's config with less to do."""
    module = importlib.import_module(script)
    return module, module.Config(device="cpu", epochs=1, **kw)


@pytest.fixture
def few(monkeypatch):
    """Five trajectories instead of any set."""
    states = np.random.default_rng(0).uniform(-0.1, 0.1, (100, 7)).astype(np.float32)
    data = states, np.array([0, 30, 40, 50, 90, 100])
    monkeypatch.setattr(trajectories, "load_set", lambda cfg, name: (data, {}))
    return data


def test_ppo_updates_the_papers_nets_with_the_papers_estimator():
    module, cfg = paper("04_train_policy", num_envs=8)
    env = stacks.make(stacks.METHODS["est_uncertainty"], cfg.num_envs, networks.Estimator().requires_grad_(False), cfg.passes)
    actor, critic = networks.policy(12, cfg.sizes), networks.value(12, cfg.sizes)
    optimizers = [ppo.optimizer(net, cfg.lr) for net in (actor, critic)]
    carry, before = (env.reset(seed=0)[0], actor.initial(8), critic.initial(8)), actor.encoder.weight.clone()
    batch, _ = ppo.rollout(env, actor, critic, carry, 10)
    stats = ppo.update(actor, critic, optimizers, ppo.sequences(batch, cfg.gamma, cfg.lam), cfg)
    assert batch["obs"].shape == (10, 8, 12) and np.isfinite(list(stats.values())).all()
    assert not actor.encoder.weight.equal(before)


def test_the_papers_estimator_takes_an_update(tmp_path, few):
    module, cfg = paper("03_train_estimator", method="ours", out=tmp_path)
    run = runs.Run(cfg, "03_train_estimator", {}, "ours")
    assert module.train(run, cfg, few, few, torch.device("cpu"))
    f = weights.load(networks.Estimator, run.dir / "estimator.safetensors")
    torch.manual_seed(0)
    assert f.sizes == (1024, 512, 256) and not f.lstm.weight_hh_l0.equal(networks.Estimator().lstm.weight_hh_l0)


def test_the_papers_student_takes_an_update_toward_its_teacher(tmp_path, few):
    module, cfg = paper("04_train_policy", method="behavior_cloning", bc_epochs=8, out=tmp_path)
    weights.save(path := tmp_path / "teacher.safetensors", teacher := networks.policy(8))
    with torch.no_grad():
        teacher.head[-1].bias[3] = teacher.head[-1].bias[11 + 7] = 3.0
    weights.save(path, teacher)
    run = runs.Run(cfg, "04_train_policy", {}, "behavior_cloning")
    assert module.train_bc(run, cfg, {"policy": path}, torch.device("cpu"))
    student = weights.load(networks.Recurrent, run.dir / "policy.safetensors")
    losses = [row["validation_loss"] for row in run.rows()]
    assert tuple(student.sizes) == (128, 256, 128) and losses[-1] < losses[0] - 0.5
    assert (networks.mode(student(torch.zeros(1, 1, 9))[0]) == torch.tensor([3, 7])).all()
