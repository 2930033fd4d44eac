import importlib
import math

import numpy as np
import pytest
import torch

from common import training
from common.env import PushVectorEnv


@pytest.mark.parametrize("tolerance, ended, successes, wanted", [
    (4.0, 511, 511, (4.0, 511, 511)),  # too few to tell: they go on being counted
    (4.0, 512, 512, (3.8, 0, 0)),
    (4.0, 1000, 601, (3.8, 0, 0)),
    (4.0, 1000, 600, (4.0, 0, 0)),  # not more than 60 %
    (2.0, 513, 0, (2.0, 0, 0)),
    (1.01, 512, 512, (1.0, 0, 0)),  # never below the task's own
    (1.0, 512, 512, (1.0, 0, 0)),
])
def test_the_tolerance_is_lowered_as_episodes_succeed(tolerance, ended, successes, wanted):
    assert training.lowered(tolerance, ended, successes) == pytest.approx(wanted)


def test_the_tolerance_is_down_in_time_where_too_few_ever_succeed():
    assert [training.limit(4.0, done) for done in (0, 0.5, 0.625, 0.75, 1)] == pytest.approx([4, 4, 2, 1, 1])
    assert training.limit(1.0, 0) == 1
    assert training.lowered(3.5, 10, 0, 2.0) == (2.0, 10, 0) and training.lowered(3.5, 512, 0, 2.0) == (2.0, 0, 0)


def batch(reward, done, success, aided=(False, False)):
    """What training.ended_episodes reads of a rollout: (T, N) each."""
    done, success = torch.tensor(done).bool(), torch.tensor(success).bool()
    return {"reward": torch.tensor(reward), "done": done, "success": success, "aided": torch.tensor(aided).expand(done.shape)}


def test_episodes_are_counted_across_rollouts():
    running = np.zeros((2, 2))
    *counts, first = training.ended_episodes(batch([[1.0, 10.0], [2.0, 20.0]], [[0, 0], [1, 0]], [[0, 0], [1, 0]]), running)
    assert counts == [1, 1]  # episodes, successes
    assert first == {"train_success": 1, "train_return": 1 + 2, "train_length": 2}
    assert running.tolist() == [[0, 10 + 20], [0, 2]]
    *_, second = training.ended_episodes(
        batch([[4.0, 40.0], [5.0, 50.0], [6.0, 60.0]], [[1, 1], [0, 0], [0, 1]], [[0, 1], [0, 0], [0, 0]]), running)
    assert second == {"train_success": pytest.approx(1 / 3), "train_return": (4 + (10 + 20 + 40) + (50 + 60)) / 3,
                      "train_length": (1 + 3 + 2) / 3}
    assert running.tolist() == [[5 + 6, 0], [2, 0]]
    *_, third = training.ended_episodes(batch([[7.0, 70.0]], [[0, 0]], [[0, 0]]), running)
    assert all(map(math.isnan, third.values())) and third.keys() == first.keys()
    assert running.tolist() == [[5 + 6 + 7, 70], [3, 1]]
    *_, fourth = training.ended_episodes(batch([[8.0, 80.0]], [[1, 0]], [[0, 0]]), running)
    assert fourth == {"train_success": 0, "train_return": 5 + 6 + 7 + 8, "train_length": 4}


def test_the_curriculum_counts_no_aided_episode():
    running = np.zeros((2, 2))
    *counts, stats = training.ended_episodes(batch([[1.0, 3.0]], [[1, 1]], [[1, 0]], aided=(True, False)), running)
    assert counts == [1, 0] and stats == {"train_success": 0.5, "train_return": 2.0, "train_length": 1}  # of both


def test_near_starts_fade_and_held_out_episodes_have_none(monkeypatch, tmp_path):
    stage, shares, reset = importlib.import_module("01_train_privileged"), [], PushVectorEnv.reset

    def record(env, **kw):
        shares.append((env.num_envs, env.near_share))
        return reset(env, **kw)

    monkeypatch.setattr(PushVectorEnv, "reset", record)
    changes = dict(near_share=0.6, updates=3, resume_every=1)
    stage.main(stage.Config(preset="smoke", out=tmp_path, device="cpu", **stage.PRESETS["smoke"] | changes))
    assert [share for worlds, share in shares if worlds == 32] == pytest.approx([0.6, 0.4, 0.2])
    assert {share for worlds, share in shares if worlds == 16} == {0}
