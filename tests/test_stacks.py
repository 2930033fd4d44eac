import importlib

import numpy as np
import pytest
import torch

from common import episodes, networks, ppo, stacks, task

SIZES = (16, 16, 16)


@pytest.mark.parametrize("method, size", [("end_to_end", 9), ("est", 8), ("est_uncertainty", 12)])
def test_the_true_state_comes_in_the_frame_of_its_episode(method, size):
    num, rng = 24, np.random.default_rng(0)
    env = stacks.make(stacks.METHODS[method], num, networks.Estimator((16, 16, 16)), occlusion=0.0, privileged=True)
    obs, infos = env.reset(seed=0)
    assert obs.shape == env.observation_space.shape == (num, size + 8)
    drift, ends = rng.choice([-3, 3], (num, 2)), 0

    def check(obs, state):
        """What is seen is the truth but for its noise: in another frame some of it would be on the other side."""
        o, s = obs[:, :8], obs[:, size:]
        np.testing.assert_allclose(np.abs(s), np.abs(task.scale(state)))
        np.testing.assert_allclose(o[:, 4:6], s[:, 4:6], atol=1e-6)
        if method == "end_to_end":
            assert (np.abs(o - s)[:, :2] * task.HALF < 0.02).all() and np.abs(o - s)[:, 2:4].max() < 0.4

    check(obs, infos["state"])
    for _ in range(220):
        obs, _, _, _, infos = env.step(np.clip(5 + drift + rng.integers(-2, 3, (num, 2)), 0, 10))
        check(obs, infos["state"])
        if "final_obs" in infos:
            check(infos["final_obs"], infos["final_state"])
            ends += infos["_final_obs"].sum()
    assert ends > num


def test_the_policy_plays_and_learns_without_the_true_state(float32):
    env = stacks.make(stacks.METHODS["end_to_end"], 5, privileged=True)
    pi, critic = networks.policy(9, SIZES), networks.value(17, SIZES)
    carry = env.reset(seed=1)[0], pi.initial(5), critic.initial(5)
    batch, _ = ppo.rollout(env, pi, critic, carry, 8)
    assert not batch["done"].any()
    logp = networks.log_softmax(pi(batch["obs"][..., :9])[0])
    torch.testing.assert_close(batch["logp"], logp)
    seq = ppo.sequences(batch, 0.99, 0.95)
    _, (_, _, kl, clipped) = ppo.policy_loss(pi, seq, torch.arange(5), ppo.Hyperparameters(clip=1e-5))
    assert kl.abs() < 1e-6 and clipped == 0


def test_a_net_in_a_stack_of_another_width_is_refused():
    env = stacks.make(stacks.METHODS["end_to_end"], 3)
    for inputs in (8, 12):
        with pytest.raises(RuntimeError, match="shapes"):
            episodes.play(env, networks.policy(inputs, SIZES), 0)


def test_the_value_net_begins_as_pi_privs_on_the_true_state(float32):
    start_from = importlib.import_module("04_train_policy").start_from
    seen, state = torch.rand(3, 4, 9), torch.rand(3, 4, 8)
    value, critic = networks.value(8, SIZES), networks.value(17, SIZES)
    start_from(critic, value, 9)
    torch.testing.assert_close(critic(torch.cat([seen, state], -1))[0], value(state)[0])


@pytest.mark.parametrize("entry", [("s_hat", None, "rl"), ("o", "ours", "rl"), ("s", None, "rl"), ("s_hat, sigma", "ours", "pi_priv"),
                                   ("o", None, "pi_priv"), ("s_hat", "ours", "cloning"), ("s_hat", "typo", "rl")])
def test_an_entry_without_a_stack_is_refused_at_once(entry):
    with pytest.raises(ValueError, match="no stack of these wrappers"):
        stacks.Method("mine", *entry)
