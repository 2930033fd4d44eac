"""Calibration against what Gaussians of a known sigma give in closed form."""
import math

import numpy as np
import pytest

from common import calibration

T, B = 200, 400


def drawn(factor=1.0, seed=0):
    """Poses, variances and truths (T, B, 4) with Gaussian errors of x, y and theta, whose sigma is `factor` times what is told.

    Angles where the sine or the cosine tells nothing of theta to first order are left out.
    """
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.3, np.pi / 2 - 0.3, (T, B)) + np.pi / 2 * rng.integers(0, 4, (T, B))
    sigma = rng.uniform(0.01, 0.03, (T, B, 1))
    q_hat = np.concatenate([rng.uniform(-0.5, 0.5, (T, B, 2)), turned(angle)], -1)
    variance = sigma**2 * np.concatenate([np.ones((T, B, 2)), turned(angle)[..., ::-1]**2], -1)
    off = factor * sigma * rng.standard_normal((T, B, 3))
    return q_hat, variance, np.concatenate([q_hat[..., :2] + off[..., :2], turned(angle + off[..., 2])], -1)


def turned(angle):
    return np.stack([np.sin(angle), np.cos(angle)], -1)


def told(factor=1.0, occluded=None, mask=None, seed=0):
    zeros, ones = np.zeros((T, B)), np.ones((T, B))
    return calibration.tally(*drawn(factor, seed), zeros if occluded is None else occluded, ones if mask is None else mask)


def test_a_true_sigma_is_called_true():
    summary = calibration.summary(told())
    assert summary["within_1_sigma"]["mean"] == pytest.approx([0.683] * 3, abs=0.01)
    low, high = (np.array(summary["within_1_sigma"][name]) for name in ("low", "high"))
    half = 1.96 * math.sqrt(0.683 * 0.317 / (T * B))  # here, unlike in an estimator's errors, all steps are independent
    assert (high - low) / 2 == pytest.approx([half] * 3, rel=0.25)
    assert summary["within_2_sigma"]["mean"] == pytest.approx([0.954] * 3, abs=0.005)
    for level, shares in summary["curve"].items():
        assert shares == pytest.approx([float(level)] * 3, abs=0.01)
    q_hat, variance, q = drawn()
    sigma = calibration.deviations(q_hat, variance, q)[1]
    assert summary["crps"] == pytest.approx(sigma.mean((0, 1)) / math.sqrt(math.pi), rel=0.02)  # E[CRPS] = sigma / sqrt(pi)
    assert summary["nll"] == pytest.approx((np.log(2 * np.pi * sigma**2).mean((0, 1)) + 1) / 2, abs=0.02)
    low, mean, high = (summary["nees"][name][0] for name in ("low", "mean", "high"))
    assert low < mean < high < low + 0.05 and 0.97 < mean < 1.03 and summary["nees_count"] == [B]
    assert np.array(summary["rmse_mm"])[1:4] == pytest.approx(np.array(summary["sigma_mm"])[1:4], rel=0.05)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_scale_makes_a_wrong_sigma_true(factor):
    scale = calibration.scale(told(factor))
    assert scale == pytest.approx([factor] * 4, rel=0.02)
    wrong = calibration.summary(told(factor))["within_1_sigma"]["mean"]
    assert wrong == pytest.approx([math.erf(1 / factor / 2**0.5)] * 3, abs=0.02)
    q_hat, variance, q = drawn(factor)
    right = calibration.tally(q_hat, variance * np.square(scale), q, np.zeros((T, B)), np.ones((T, B)))
    assert calibration.summary(right)["within_1_sigma"]["mean"] == pytest.approx([0.683] * 3, abs=0.01)


@pytest.mark.parametrize("spread", [0.03, 0.3])
def test_the_angles_sigma_is_that_of_the_turns_that_its_sine_and_cosine_come_from(spread):
    rng = np.random.default_rng(0)
    for angle in (0.0, 0.3, np.pi / 4, 2.5, -1.2):
        q = np.concatenate([np.zeros((100_000, 2)), turned(angle + spread * rng.standard_normal(100_000))], 1)
        sigma = calibration.deviations(q.mean(0), q.var(0), q[0])[1][2]
        assert sigma == pytest.approx(np.rad2deg(spread), rel=0.03)


def test_only_valid_steps_count_and_nees_is_that_of_each_time_since_the_last_sight():
    occluded, mask = np.zeros((T, B)), np.ones((T, B))
    occluded[20:60] = occluded[100:140] = 1  # 40 frames: 2 whole seconds, twice
    mask[50:, 0] = 0
    tallies = told(occluded=occluded, mask=mask)
    sums = calibration.parts(tallies)
    assert sums["count"].sum(1).tolist() == [50] + [T] * (B - 1)
    assert sums["aged"][1].tolist() == [T - 80, 2, 2] + [0] * 8 and sums["aged"][0].tolist() == [20, 1, 1] + [0] * 8
    q_hat, variance, q = drawn()
    error, sigma = calibration.deviations(q_hat, variance, q)
    assert sums["nees"][5, 1] == pytest.approx(np.square(error / sigma)[[19 + 15, 99 + 15], 5].sum())
    assert [len(x) for x in calibration.summary(tallies)["nees"].values()] == [3, 3, 3]


def test_area_is_the_share_of_pairs_in_order():
    rng = np.random.default_rng(0)
    score, label, weight = rng.integers(0, 8, 60), rng.integers(0, 2, 60), rng.integers(0, 3, 60)
    won = pairs = 0
    for i in range(60):
        for j in range(60):
            if label[i] and not label[j]:
                pairs += weight[i] * weight[j]
                won += weight[i] * weight[j] * ((score[i] > score[j]) + (score[i] == score[j]) / 2)
    assert calibration.area(score, label, weight) == pytest.approx(won / pairs)
    assert math.isnan(calibration.area(score, np.zeros(60), weight))


def test_a_sigma_that_rises_before_the_end_foresees_it():
    rng = np.random.default_rng(0)
    length = rng.integers(60, 290, 300)
    success = rng.random(300) < 0.5
    variance = np.full((300, 300, 4), 1e-4) * rng.uniform(0.9, 1.1, (300, 300, 1))
    for i in np.flatnonzero(~success):
        variance[max(0, length[i] - 30):length[i], i] *= 9
    courses = calibration.course(variance, length, success, 300)
    seen = calibration.foreseen(courses)
    assert seen["episodes"] == 300 and seen["left"] == (~success).sum()
    assert seen["sigma"]["mean"] > 0.95 and seen["sigma"]["low"] <= seen["sigma"]["mean"] <= seen["sigma"]["high"]
    assert seen["rise"]["mean"] > 0.65 and seen["time"]["mean"] < 0.75
    gain = seen["sigma_minus_time"]
    assert gain["mean"] == pytest.approx(seen["sigma"]["mean"] - seen["time"]["mean"]) and gain["low"] > 0
    variance[0] = 1e4  # an estimator's first sigma, before it has seen anything move
    first = calibration.foreseen(calibration.course(variance, length, success, 300))
    assert first["rise"] == seen["rise"]
    timed_out = calibration.course(variance, np.full(300, 300), np.zeros(300, bool), 300)
    assert calibration.foreseen(timed_out) is None


def test_the_bootstraps_interval_holds_the_truth_as_often_as_it_says():
    rng, held = np.random.default_rng(0), 0
    for _ in range(200):
        x = rng.normal(3, 1, 80)
        interval = calibration.bootstrap(lambda w: w @ x / w.sum(), 80)
        held += interval["low"] <= 3 <= interval["high"]
    assert held / 200 == pytest.approx(0.95, abs=0.05)
