"""The players of the fixed list: the same episodes for all, again and again, and their film."""
import importlib
import math
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from common import calibration, film, measurements, networks, stacks, task, trajectories, weights
from common.task import World

evaluate = importlib.import_module("05_evaluate")


def players(num_envs=6, seed=0, world=World(time_limit=2.0)):
    """Players with small untrained nets instead of a run's."""
    play = evaluate.Players(SimpleNamespace(num_envs=num_envs, seed=seed, passes=2, particles=20), {}, torch.device("cpu"), world)
    torch.manual_seed(0)
    nets = {size: networks.policy(size, (8, 8, 8)) for size in (8, 9, 12)}
    estimator = networks.Estimator((8, 8, 8))
    inputs = {"s": 8, "o": 9, "s_hat": 8, "s_hat, sigma": 12}
    play.policy = lambda method, seed: nets[inputs[stacks.METHODS[method].reads]]
    play.estimator = lambda kind: estimator if kind else None
    return play


def first_rows(play, method, chunk=0, **kw):
    """First recorded states, observations and dynamics of a chunk."""
    env = play.chunk(evaluate.Measurement(method, 6, **kw), chunk)[2]
    return env.rows, env.unwrapped.dynamics


def test_every_method_meets_the_same_episodes():
    """Starts, dynamics, bias, noise and xi of the list are the same, whatever the policy does."""
    play = players()
    rows, dynamics = first_rows(play, "est_uncertainty")
    first = rows[0]
    noise = first["o"][:, [0, 1, 4, 5]] - task.scale(first["state"])[:, [0, 1, 4, 5]]
    for method in stacks.METHODS:
        other, _ = first_rows(play, method)
        np.testing.assert_array_equal(other[0]["state"], first["state"])
        if "o" in other[0]:
            np.testing.assert_array_equal(other[0]["o"], first["o"])
            assert [r["o"][:, 8].tolist() for r in other[:5]] == [r["o"][:, 8].tolist() for r in rows[:5]]
    assert np.abs(noise[:, :2]).max() > 0 and not noise[:, 2:].any()
    assert not np.array_equal(first_rows(play, "est", chunk=1)[0][0]["state"], first["state"])
    assert not np.array_equal(first_rows(players(seed=1), "est")[0][0]["state"], first["state"])


def test_the_occlusion_changes_nothing_but_what_is_hidden():
    play = players()
    none, full = (first_rows(play, "end_to_end", occlusion=seconds)[0] for seconds in (0.0, math.inf))
    none, full = (np.stack([row["o"] for row in rows]) for rows in (none, full))
    assert not none[..., 8].any()
    hidden = full[..., 8]
    for world, t in enumerate(hidden.argmax(0)):
        np.testing.assert_array_equal(none[:t, world], full[:t, world])
        np.testing.assert_array_equal(none[t, world, 4:8], full[t, world, 4:8])  # pusher and force
    assert hidden.any() and not (np.diff(hidden[:, hidden.any(0)], axis=0)[:8] < 0).any()


def test_an_episode_can_be_played_again():
    play = players()
    m = evaluate.Measurement("est_uncertainty", 10)
    values = play.measure(m, 0) + play.measure(m, 1)
    assert len(values) == 10 and set(values) <= {0, 1}
    again = play.episode(m, 7)
    assert again["success"] == values[7]
    assert again["state"].shape[1:] == (7,) and again["o"].shape[1:] == (9,) and again["belief"].shape[1:] == (12,)
    assert len(again["state"]) == len(again["o"]) == len(again["belief"])
    np.testing.assert_array_equal(again["state"], play.episode(m, 7)["state"])


def test_a_measurement_is_the_same_whatever_was_measured_before_it(tmp_path):
    """Reading a net draws nothing: a rerun that measures one thing alone gives what the whole run gave."""
    paths = {("est_uncertainty", 0): tmp_path / "policy.safetensors", "ours": [tmp_path / "estimator.safetensors"]}
    weights.save(paths["est_uncertainty", 0], networks.policy(12, (8, 8, 8)))
    weights.save(*paths["ours"], networks.Estimator((8, 8, 8)))
    play = evaluate.Players(SimpleNamespace(num_envs=6, seed=0, passes=2, particles=20), paths, torch.device("cpu"))
    beliefs = [[row["belief"] for row in play.chunk(evaluate.Measurement("est_uncertainty", 6), 0)[2].rows] for _ in range(2)]
    np.testing.assert_array_equal(*beliefs)


def test_recorded_keeps_the_end_of_an_episode():
    success, length, env = players().chunk(evaluate.Measurement("est", 6, occlusion=0.0), 0)
    for world, n in enumerate(length):
        episode = env.episode(world, n)
        assert len(episode["state"]) == n + 1
        moved = np.abs(np.diff(episode["state"][:, 3:5], axis=0)).max()
        assert moved <= task.MAX_SPEED / task.RATE + 1e-6, "the next episode's start got into this one"
        error = task.unscale_pose(episode["o"][-1, :4])[:2] - episode["state"][-1, :2]
        assert np.abs(error).max() < 8 * World.noise[0]


def test_errors_in_the_loop_are_those_of_the_beliefs_before_the_actions():
    success, length, env = players().chunk(evaluate.Measurement("est_uncertainty", 6), 0)
    told = trajectories.in_the_loop(env, length, success, [2.0] * 4)
    for world, n in enumerate(length):
        episode = env.episode(world, n)
        state, belief = episode["state"][:n], episode["belief"][:n]
        q_hat = task.unscale_pose(belief[:, :4])
        l2, angle = np.linalg.norm(q_hat[:, :2] - state[:, :2], axis=1), np.abs(task.wrap(q_hat[:, 2] - state[:, 2]))
        expected = [n, l2.sum(), (l2**2).sum(), angle.sum(), (angle**2).sum()]
        assert told[world]["all"] == pytest.approx(expected, rel=1e-4, abs=1e-5)
        sums, scaled = (calibration.parts([told[world][name]]) for name in calibration.TALLIES)
        off = np.abs((q_hat - state[:, :3])[:, :2])
        within = [(off <= k * belief[:, 8:10] * task.HALF).sum(0).tolist() for k in (1, 2)]
        assert [sums["within"][0, i:i + 2].tolist() for i in (6, 15)] == within
        assert scaled["ratios"] == pytest.approx(sums["ratios"] / 4)
        assert told[world]["course"][0] == n and told[world]["course"][1] == (0 if success[world] else pytest.approx(
            np.nan if n == 30 else 1, nan_ok=True))


def test_other_worlds_differ_in_one_thing():
    world = task.World(mass=(2.0, 2.5))
    base = task.Other(**asdict(world))
    rows = measurements.other_worlds(world)
    assert rows["paper"].mass == task.World.mass and "time=30s" in rows
    assert not {"paper", "time=30s"} & {*measurements.other_worlds(task.World(time_limit=30.0))}
    for row, other in rows.items():
        changed = [name for name in asdict(other) if getattr(other, name) != getattr(base, name)]
        assert len(changed) == 1, row
        assert row.startswith(measurements.SENSED) == (changed[0] in ("noise", "bias", "gain", "late"))
    assert rows["c=0.042"].dynamics["limit_surface_c"] == pytest.approx((0.0422, 0.0422), abs=1e-4)
    assert rows["c=0.060"].dynamics["limit_surface_c"] == (0.060, 0.060) and rows["mu=0.3-0.6"].mu_dynamic == (0.3, 0.6)
    assert rows["box=-2cm"].box == pytest.approx((0.10, 0.10, 0.07)) and rows["noise=2x"].noise[3] == 1.4
    assert "box=+2cm_wide" not in measurements.other_worlds(task.World(box=(0.2, 0.21, 0.07)))  # no room


def test_another_world_is_played():
    play = players()
    rows = measurements.other_worlds(play.world)
    base = first_rows(play, "est")[1]
    for row in ("mass=1-1.5", "c=0.078", "surface=4", "support_offset=8mm"):
        env = play.chunk(measurements.Measurement("est", 6, world=rows[row]), 0)[2].unwrapped
        assert env.world == rows[row]
        same = [name for name in base if np.array_equal(env.dynamics[name], base[name])]
        assert len(base) - len(same) == {"surface=4": 0, "support_offset=8mm": 2}.get(row, 1)


def test_the_film_shows_every_step(tmp_path):
    _, length, env = players().chunk(evaluate.Measurement("est_uncertainty", 6, occlusion=1.0), 0)
    episode = env.episode(length.argmax(), length.max())
    film.write(episode, tmp_path / "film.mp4", tmp_path / "film.gif")
    video = cv2.VideoCapture(str(tmp_path / "film.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(episode["state"]) + task.RATE
    assert video.get(cv2.CAP_PROP_FPS) == task.RATE
    with Image.open(tmp_path / "film.gif") as gif:
        assert gif.size == (480, 300) and gif.n_frames > length.max() // 4


def test_the_film_marks_an_occlusion():
    state = np.array([0.1, 0.05, 0.3, -0.1, 0.0, 1.0, 0.0])
    o = np.append(task.scale(state), 0.0)
    belief = np.append(task.scale(state), [0.02] * 4)
    seen = film.frame(state, o, belief, 0)
    hidden = film.frame(state, np.append(o[:8], 1.0), belief, 0)
    assert tuple(hidden[0, 0]) == film.HELD and tuple(seen[0, 0]) != film.HELD


def test_without_mujoco_the_second_simulator_says_what_to_install():
    script = Path(__file__).parent / "second_simulator.py"
    code = f"import runpy, sys; sys.modules['mujoco'] = None; runpy.run_path({str(script)!r}, run_name='__main__')"
    end = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert end.returncode and end.stderr == "error: no MuJoCo here: pip install mujoco\n"


def test_other_players_episodes_are_judged_by_the_published_nets():
    script = Path(__file__).parent / "who_pushes.py"
    end = subprocess.run([sys.executable, script, "pretrained", "--episodes", "4", "--passes", "2"], capture_output=True, text=True)
    lines = [line for line in end.stdout.splitlines() if line.startswith("| ")]
    assert end.returncode == 0 and len(lines) == 10 and len({len(line) for line in lines}) == 1
    assert [line.count("+-") for line in lines[1:]] == [4, 4, 4, 4, 4, 2, 4, 4, 2]
