import math

import numpy as np
import pytest
import torch

from common import statistics, task, trajectories
from common.files import UserError

LENGTHS = [3, 1, 40, 7]


@pytest.fixture
def data():
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (sum(LENGTHS), 7)).astype(np.float32) * np.float32([0.3, 0.15, np.pi, 0.3, 0.15, 5, 5])
    return states, np.cumsum([0, *LENGTHS])


@pytest.fixture
def paths(data, tmp_path):
    paths = [tmp_path / name for name in trajectories.files("test")]
    for path, array in zip(paths, data):
        np.save(path, array)
    return paths


def test_stored_trajectories_come_back(data, paths):
    states, offsets = trajectories.load(*paths)
    assert isinstance(states, np.memmap) and (states == data[0]).all() and (offsets == data[1]).all()


@pytest.mark.parametrize("damage", ["gone", "empty", "cut", "other", "offsets gone", "offsets empty", "offsets cut"])
def test_damaged_files_name_the_stage(paths, damage):
    path = paths[damage.startswith("offsets")]
    match damage.split()[-1]:
        case "gone":
            path.unlink()
        case "empty":
            path.write_bytes(b"")
        case "cut":
            path.write_bytes(path.read_bytes()[:-30])
        case "other":
            np.save(path, np.zeros((9, 7), np.float32))
    with pytest.raises(UserError, match="test_states.npy is damaged: rerun 02_collect.py"):
        trajectories.load(*paths)


def test_padding_repeats_the_last_state(data):
    states, mask = trajectories.padded(data, np.array([2, 1, 0]))
    assert states.shape == (40, 3, 7) and mask.sum(0).tolist() == [40, 1, 3]
    assert (states[:, 0] == data[0][4:44]).all() and (states[:, 1] == data[0][3]).all()
    assert (states[:3, 2] == data[0][:3]).all() and (states[3:, 2] == data[0][2]).all()
    assert (np.diff(mask, axis=0) <= 0).all()


def test_batches_take_every_trajectory_once():
    order = np.random.default_rng(0).permutation(10)
    taken = trajectories.batches(order, 4)
    assert [len(batch) for batch in taken] == [4, 4, 2] and np.concatenate(taken).tolist() == order.tolist()


def test_shuffled_batches_take_every_trajectory_once_and_pad_little():
    rng = np.random.default_rng(0)
    lengths = rng.integers(1, 300, 1000)
    data = np.zeros((lengths.sum(), 7), np.float32), np.concatenate([[0], lengths.cumsum()])
    one, other = trajectories.shuffled(data, 8, rng), trajectories.shuffled(data, 8, rng)
    assert sorted(np.concatenate(one)) == sorted(np.concatenate(other)) == list(range(1000)) and {len(b) for b in one} == {8}
    assert sum(len(b) * lengths[b].max() for b in one) < 1.1 * lengths.sum()
    first = [lengths[b].max() for b in one]
    assert abs(np.corrcoef(first[:-1], first[1:])[0, 1]) < 0.3 and {tuple(b) for b in one} != {tuple(b) for b in other}


@pytest.mark.parametrize("count, indices", [(1, [0]), (2, [0, 3]), (4, [0, 1, 2, 3]), (9, [0, 1, 2, 3])])
def test_a_subset_is_spread_over_the_checkpoints(data, count, indices):
    assert trajectories.subset(data, count).tolist() == indices


def test_observed_batches_are_the_seeds(data):
    index = np.array([0, 2])
    o, s, mask = trajectories.observe(data, index, (1, 2), "cpu")
    assert o.shape == (40, 2, 9) and s.shape == (40, 2, 8) and mask.shape == (40, 2)
    assert (o[0, :, :2] >= 0).all()  # the frame of the first observation
    true = task.scale(data[0][[0, 4]])
    assert s[0].abs().equal(torch.as_tensor(true).abs()) and s[0, 1].equal(torch.as_tensor(true[1]))
    assert (o[..., 4:6] == s[..., 4:6]).all()
    assert o.equal(trajectories.observe(data, index, (1, 2), "cpu")[0])
    assert not o.equal(trajectories.observe(data, index, (1, 3), "cpu")[0])


def plain_table(q_hat, q, chosen):
    """The numbers of tab. estimator_ablation, one step at a time."""
    shifts, turns = [], []
    for t, b in np.argwhere(chosen):
        shifts.append((q_hat[t, b, :2] - q[t, b, :2]) * task.HALF * 1e3)
        turn = math.atan2(*q_hat[t, b, 2:]) - math.atan2(*q[t, b, 2:])
        turns.append(math.degrees(math.atan2(math.sin(turn), math.cos(turn))))
    shifts, turns = np.array(shifts), np.array(turns)
    return {"trans_mean_l2_mm": np.hypot(*shifts.T).mean(), "trans_rmse_mm": np.sqrt((shifts**2).mean()),
            "rot_mean_abs_deg": np.abs(turns).mean(), "rot_rmse_deg": np.sqrt((turns**2).mean())}


def test_errors_are_those_of_a_plain_loop():
    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, (50, 6))
    near = angle + rng.normal(0, 0.5, angle.shape)  # some on the other side of +-pi
    q, q_hat = (np.concatenate([rng.uniform(-1, 1, (50, 6, 2)), scale * np.stack([np.sin(a), np.cos(a)], -1)], -1)
                for a, scale in ((angle, 1.0), (near, 0.7)))
    mask = np.arange(50)[:, None] < [50, 1, 20, 33, 5, 49]
    hidden = rng.random((50, 6)) < 0.4
    arrays = q_hat, q, hidden, mask
    halves = [trajectories.pose_errors(*(x[:, part] for x in arrays)) for part in (slice(0, 2), slice(2, 6))]
    table = statistics.error_table({name: np.concatenate([half[name] for half in halves], 1) for name in halves[0]})
    for row, chosen in ((table["seen"], mask & ~hidden), (table["occluded"], mask & hidden), (table, mask)):
        assert {key: row[key] for key in statistics.ERRORS} == pytest.approx(plain_table(q_hat, q, chosen))


def test_error_intervals_hold_the_truth_as_often_as_they_say():
    rng, held = np.random.default_rng(0), []
    truth = np.array([2e3, 1e3 * (4.5 / 2) ** 0.5, np.rad2deg(1), np.rad2deg(1.25**0.5)])
    for _ in range(400):  # trajectories with an error of their own: 200 independent ones, not thousands of steps
        steps = rng.integers(1, 100, 200)
        l2, angle = rng.choice([2 - 0.5**0.5, 2 + 0.5**0.5], 200), rng.choice([0.5, 1.5], 200)
        row = statistics.errors(np.stack([steps, steps * l2, steps * l2**2, steps * angle, steps * angle**2]))
        held.append(np.abs([row[key] for key in statistics.ERRORS] - truth) <= [row["half_95"][key] for key in statistics.ERRORS])
    assert np.mean(held, 0) == pytest.approx(np.full(4, 0.95), abs=0.035)


def test_angles_are_compared_around_the_circle():
    q, q_hat = (np.array([[[0.0, 0.0, math.sin(a), math.cos(a)]]]) for a in (math.radians(179), math.radians(-179)))
    table = statistics.error_table(trajectories.pose_errors(q_hat, q, np.zeros((1, 1)), np.ones((1, 1))))
    assert table["rot_mean_abs_deg"] == pytest.approx(2, abs=1e-3) and table["rot_rmse_deg"] == pytest.approx(2, abs=1e-3)


def test_vision_alone_has_the_errors_of_its_noise():
    states = np.zeros((3000 * 20, 7), np.float32)
    data, seen = (states, np.arange(0, 60_001, 20)), task.World(occlusion_start=0.0)
    table = statistics.error_table(trajectories.measure(data, 3000, 500, 0, "cpu", lambda o: (o[..., :4], None), seen))
    assert table["trans_rmse_mm"] == pytest.approx(2.5 * math.sqrt(2), rel=0.03)
    assert table["trans_mean_l2_mm"] == pytest.approx(2.5 * math.sqrt(2) * math.sqrt(math.pi / 2), rel=0.03)
    assert table["rot_rmse_deg"] == pytest.approx(math.degrees(0.05 * math.sqrt(2)), rel=0.03)
    assert table["seen"] == {key: table[key] for key in (*statistics.ERRORS, "half_95")} and "occluded" not in table


def test_every_estimator_is_measured_under_the_same_noise(data):
    seen = []
    for _ in range(2):
        trajectories.measure(data, 3, 2, 5, "cpu", lambda o: seen.append(o) or (o[..., :4], None))
    assert [o.shape[1] for o in seen] == [2, 1, 2, 1]  # three trajectories, two at a time
    assert seen[0].equal(seen[2]) and seen[1].equal(seen[3])
