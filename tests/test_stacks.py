import importlib

import numpy as np
import torch

from common import networks, stacks, task


def test_the_true_state_comes_in_the_frame_of_its_episode():
    num = 24
    env, rng = stacks.make("end_to_end", num, occlusion=0.0, privileged=True), np.random.default_rng(0)
    obs, infos = env.reset(seed=0)
    assert obs.shape == env.observation_space.shape == (num, 9 + 8)
    drift, ends = rng.choice([-3, 3], (num, 2)), 0

    def check(obs, state):
        """What is seen is the truth but for its noise: in another frame some of it would be on the other side."""
        o, s = obs[:, :8], obs[:, 9:]
        np.testing.assert_allclose(np.abs(s), np.abs(task.scale(state)))
        np.testing.assert_allclose(o[:, 4:6], s[:, 4:6], atol=1e-6)
        assert (np.abs(o - s)[:, :2] * task.HALF < 0.02).all() and np.abs(o - s)[:, 2:4].max() < 0.4

    check(obs, infos["state"])
    for _ in range(220):
        obs, _, _, _, infos = env.step(np.clip(5 + drift + rng.integers(-2, 3, (num, 2)), 0, 10))
        check(obs, infos["state"])
        if "final_obs" in infos:
            check(infos["final_obs"], infos["final_state"])
            ends += infos["_final_obs"].sum()
    assert ends > num


def test_the_value_net_begins_as_pi_privs_on_the_true_state_and_the_policy_does_not_read_it(float32):
    start_from = importlib.import_module("04_train_policy").start_from
    sizes, seen, state = (16, 16, 16), torch.rand(3, 4, 9), torch.rand(3, 4, 8)
    value, pi = networks.value(8, sizes), networks.policy(8, sizes)
    critic, actor = networks.value(17, sizes), networks.policy(9, sizes)
    start_from(critic, value, 9), start_from(actor, pi)
    obs = torch.cat([seen, state], -1)
    assert critic(obs)[0].allclose(value(state)[0], atol=1e-6) and actor(obs)[0].allclose(pi(seen)[0], atol=1e-6)
