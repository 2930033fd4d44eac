import numpy as np
import pytest
import torch

from common import episodes, film, networks, stacks
from common.belief import Believed
from common.env import PushVectorEnv
from common.observation import Observed

WORLDS, STEPS = 12, 200


@pytest.fixture
def estimator():
    return networks.Estimator((16, 12, 10), dropout=0.0).requires_grad_(False)


def play(env, steps=STEPS):
    """First observations, then (observations, infos) of each step; every pusher soon leaves its workspace."""
    actions = np.random.default_rng(3).choice([0, 10], (env.num_envs, 2))
    out = [env.reset(seed=2)]
    for _ in range(steps):
        o, _, _, _, infos = env.step(actions)
        out.append((o, infos))
    return out


def split(played, world):
    """The observations of each episode of a world, from its first to its final_obs."""
    rows, whole = [played[0][0][world]], []
    for o, infos in played[1:]:
        if "_final_obs" in infos and infos["_final_obs"][world]:
            whole.append(np.stack([*rows, infos["final_obs"][world]]))
            rows = []
        rows.append(o[world])
    return [*whole, np.stack(rows)]


def test_each_episode_is_estimated_as_if_alone(estimator, float32):
    seen = play(Observed(PushVectorEnv(WORLDS)))
    believed = play(Believed(Observed(PushVectorEnv(WORLDS)), estimator, passes=3, sigma=True))
    ends = 0
    for world in range(WORLDS):
        pairs = list(zip(split(seen, world), split(believed, world), strict=True))
        ends += len(pairs) - 1
        for o, s_hat in pairs:
            q, log_var, _ = estimator(torch.as_tensor(o)[:, None])
            np.testing.assert_allclose(s_hat[:, :4], q[:, 0], atol=1e-5)
            np.testing.assert_allclose(s_hat[:, 8:], (log_var[:, 0] / 2).exp().clamp(0, 1), atol=1e-5)
            assert (s_hat[:, 4:8] == o[:, 4:8]).all()  # pusher and noisy force
    assert ends >= WORLDS


def test_without_sigma_there_are_eight_entries(estimator):
    env = Believed(Observed(PushVectorEnv(3)), estimator, 1, sigma=False)
    assert env.reset(seed=0)[0].shape == env.observation_space.shape == (3, 8)
    env = Believed(Observed(PushVectorEnv(3)), estimator, 1, sigma=True)
    assert env.reset(seed=0)[0].shape == env.observation_space.shape == (3, 12)


def test_sigma_is_a_standard_deviation_clipped_to_one(estimator):
    estimator.layers[-1].weight.zero_()
    estimator.layers[-1].bias[4:] = torch.tensor([3.0, 1e3, 2 * np.log(0.25), -1e3])
    sigma = Believed(Observed(PushVectorEnv(3)), estimator, 1, sigma=True).reset(seed=0)[0][:, 8:]
    np.testing.assert_allclose(sigma, np.tile([1, 1, 0.25, np.exp(-7)], (3, 1)), rtol=1e-2)


def test_sigma_holds_the_epistemic_part_of_mse_with_dropout():
    f = networks.Estimator((16, 12, 10), dropout=0.5, likelihood=False).requires_grad_(False)
    env = Believed(Observed(PushVectorEnv(3)), f, 50, sigma=True)
    assert (env.reset(seed=0)[0][:, 8:] > 0.01).all()


def test_a_reset_forgets(estimator):
    env = Believed(Observed(PushVectorEnv(4)), estimator, 1, sigma=True)
    first = env.reset(seed=5)[0]
    for _ in range(5):
        env.step(np.full((4, 2), 7))
    assert (env.reset(seed=5)[0] == first).all()


def test_leaving_out_the_worlds_that_nobody_reads_changes_no_episode(estimator, float32, monkeypatch):
    policy = networks.policy(12, (8, 8, 8))
    policy.head[-1].bias.data[10] = 9.0  # to the right, and out of the workspace where that is near
    widths, believe = [], estimator.predict
    monkeypatch.setattr(estimator, "predict", lambda o, *more: widths.append(o.shape[1]) or believe(o, *more))

    def played():
        env = film.Recorded(stacks.make(stacks.METHODS["est_uncertainty"], 100, estimator))
        return *episodes.play(env, policy, seed=4), env

    success, length, env = played()
    assert length.min() < 50 and length.max() > 150 and widths.count(100) < 110 and min(widths[-20:]) <= 48
    monkeypatch.setattr(episodes, "fewer", lambda wanted: np.arange(len(wanted)))
    alike, as_long, whole = played()
    assert (success == alike).all() and (length == as_long).all()
    for world, n in enumerate(length):
        one, other = (each.episode(world, n) for each in (env, whole))
        for name in one:
            np.testing.assert_allclose(one[name], other[name], atol=1e-5)
