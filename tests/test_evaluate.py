import csv
import importlib
import json
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

from common import calibration, film, measurements, networks, plots, stacks, statistics, tables, task, trajectories, weights
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


@pytest.mark.parametrize("successes, n, low, high", [(81, 263, 0.2553, 0.3662), (0, 20, 0.0, 0.1611), (20, 20, 0.8389, 1.0),
                                                     (1880, 2000, 0.9287, 0.9496)])
def test_wilson_interval_against_published_values(successes, n, low, high):
    rate = statistics.wilson([1] * successes + [0] * (n - successes))
    assert rate["mean"] == successes / n and rate["episodes"] == n
    assert rate["low"] == pytest.approx(low, abs=2e-4) and rate["high"] == pytest.approx(high, abs=2e-4)


@pytest.mark.parametrize("n", [200, 300, 500, 2000])
def test_wilson_interval_holds_the_rate(n):
    for successes in 0, 1, n - 1, n:
        rate = statistics.wilson([1] * successes + [0] * (n - successes))
        assert 0 <= rate["low"] <= rate["mean"] <= rate["high"] <= 1


def test_paired_difference_is_narrower_than_the_independent_one():
    a = np.random.default_rng(0).random(1000) < 0.8
    b = a.copy()
    b[:50] = False
    d = statistics.paired(b, a)
    assert d["mean"] == pytest.approx(b.mean() - a.mean()) and d["low"] < d["mean"] < d["high"] < 0
    assert d["high"] - d["low"] < 0.03  # independent samples: 0.07
    assert statistics.paired(a, a) == {"mean": 0, "low": 0, "high": 0}


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


def made_up(seeds=1, methods=stacks.METHODS):
    """Values of every measurement, as 05 stores them."""
    rng = np.random.default_rng(0)
    row = {"trans_mean_l2_mm": 4.0, "trans_rmse_mm": 3.5, "rot_mean_abs_deg": 2.0, "rot_rmse_deg": 3.0}
    steps = World().horizon
    hidden = np.arange(steps)[:, None] > 20 + np.zeros(9)
    tallies = calibration.tally(*rng.uniform(0.1, 0.9, (3, steps, 9, 4)), hidden, np.ones((steps, 9)))
    sure = calibration.summary(tallies)
    done = {f"estimator_ablation/{kind}": {k: v * (10 if kind == "vision" else 1) for k, v in row.items()} |
            {"half_95": row, "seen": row, "occluded": row, "calibration": sure, "scaled": sure}
            for kind in ("vision", *reversed(stacks.TRAINED))}
    cfg = evaluate.Config(episodes=40, sweep_episodes=20, switch_episodes=10)
    for name, m in evaluate.measurements(cfg, {(method, k): None for method in methods for k in range(seeds)}, World()).items():
        done[name] = rng.integers(0, 2, m.episodes).tolist()
        if m.errors:
            length, won = rng.integers(10, steps, m.episodes), rng.random(m.episodes) < 0.5
            courses = calibration.course(np.ones((steps, m.episodes, 4)), length, won, steps)
            errors = {part: [9, *rng.uniform(0, 1, 4)] for part in ("all", "seen", "occluded")}
            done[name] = [errors | {"calibration": tallies[i % 9].tolist(), "course": courses[i].tolist()}
                          for i in range(m.episodes)]
    return done | {f"filter/{row}/{kind}": done["estimator_ablation/ours"] for row in ("test", "c=0.078")
                   for kind in ("ours", "filter")}


def test_results_have_the_published_layout():
    results = json.loads(json.dumps(statistics.summarise(made_up())))
    assert set(results["estimator_ablation"]) == {"vision", "mse", "likelihood", "ours"}
    assert results["estimator_ablation"]["ours"]["trans_mean_l2_mm_of_vision"] == pytest.approx(0.1)
    assert set(results["success_rate"]) == set(stacks.METHODS)
    assert set(results["occlusion_duration"]) == set(stacks.METHODS) - {"priv_on_state"}
    for points in results["occlusion_duration"].values():
        assert list(points) == ["0", "2.5", "5", "10", "full"]
        assert all(set(p) == {"mean", "low", "high", "episodes"} and p["episodes"] == 20 for p in points.values())
    done = made_up()
    lost = np.mean(done["occlusion_duration/est/0"]) - np.mean(done["occlusion_duration/est/full"])
    assert results["occlusion_loss"]["est"]["mean"] == pytest.approx(lost)
    assert set(results["contact_switches"]["priv_on_state"]) == {"mean", "std", "episodes"}
    assert set(results["starts"]) == {"centre", "inner"}
    assert all(set(row) == {"priv_on_state", "est_uncertainty"} for row in results["starts"].values())


def test_errors_in_the_loop_are_those_of_the_beliefs_before_the_actions():
    success, length, env = players().chunk(evaluate.Measurement("est_uncertainty", 6), 0)
    told = trajectories.in_the_loop(env.rows, length, success, 30, [2.0] * 4)
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


def test_a_table_of_errors_in_the_loop():
    rng = np.random.default_rng(0)
    steps = rng.integers(50, 300, 500)
    sums = steps[:, None] * [1, 0.004, 0.004**2, 0.02, 0.02**2]
    row = statistics.in_the_loop([dict.fromkeys(("all", "seen", "occluded"), each.tolist()) for each in sums])
    assert row["trans_mean_l2_mm"] == pytest.approx(4.0) and row["rot_mean_abs_deg"] == pytest.approx(np.rad2deg(0.02))
    text = tables.in_the_loop({"in_the_loop": {"est": row}})
    assert "| est    | 4.00 [4.00, 4.00] |" in text and not tables.in_the_loop({})


def test_other_worlds_differ_in_one_thing():
    world = task.World(mass=(2.0, 2.5))
    base = task.Other(**asdict(world))
    for row, other in measurements.other_worlds(world).items():
        changed = [name for name in asdict(other) if getattr(other, name) != getattr(base, name)]
        assert len(changed) == 1, row
        assert row.startswith(measurements.SENSED) == (changed[0] in ("noise", "bias", "gain", "late"))
    rows = measurements.other_worlds(world)
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


def test_several_seeds_give_mean_and_std_beside_the_first_seeds_interval():
    done = made_up(seeds=3)
    row = statistics.summarise(done)["success_rate"]["est"]
    rates = [np.mean(done[f"success_rate/est/{k}"]) for k in range(3)]
    assert row["mean"] == rates[0]
    assert row["seeds"] == {"mean": pytest.approx(np.mean(rates)), "std": pytest.approx(np.std(rates)), "count": 3}
    assert "seeds" not in statistics.summarise(made_up())["success_rate"]["est"]


def test_tables_line_up_and_hold_every_method():
    published = [name for name, method in stacks.METHODS.items() if method.published]
    results = statistics.summarise(made_up(2, published))
    for section in tables.SECTIONS[:-1]:
        text = section(results)
        lines = [line for line in text.splitlines() if line.startswith("|")]
        assert len({len(line) for line in lines}) == 1 and len(lines[0]) <= 130
        assert len({line.count("|") for line in lines}) == 1
    assert all(f"| {m} " in tables.success_rate(results) for m in published)
    assert "10.0%, 10.0%" in tables.estimator_ablation(results) and "(2)" in tables.success_rate(results)
    beside = [[cell.strip() for cell in line.split("|")[1:-1]] for line in tables.beside_paper(results).splitlines()[4:]]
    assert len(beside) == 16 + 6 + 4 + 2 and ["error of ours: mean L2, mm", "4.00 [0.00, 8.00]", "4.42"] in beside
    rates = {"full occlusion": {m: sweep["full"] for m, sweep in results["occlusion_duration"].items()}}
    for name, row in (rates | results["other_worlds"]).items():
        lead = row["est"]["mean"] - row["est_uncertainty"]["mean"]
        assert results["minus_est_uncertainty"][name]["est"]["mean"] == pytest.approx(lead)
    paper = {name: number for name, _, number in beside}
    assert paper["success of est_uncertainty"] == "94%" and paper["error of ours: mean abs., deg"] == "2.10"
    assert [number for name, number in paper.items() if "contact switches" in name] == ["2.68 +- 1.53", "4.22 +- 2.67"]


@pytest.mark.parametrize("others", [[], ["est", "end_to_end"], ["behavior_cloning"]])
def test_tables_leave_out_what_was_not_measured(others):
    methods = [*others, "priv_on_state"]  # which 05 demands
    results = json.loads(json.dumps(statistics.summarise(made_up(methods=methods))))
    assert list(results["success_rate"]) == methods and "minus_est_uncertainty" not in results["success_rate"][methods[0]]
    assert list(results["occlusion_duration"]) == list(results["occlusion_loss"]) == others
    text = tables.every(results)
    told = {m for m in stacks.METHODS if f"| {m} " in text or f"- {m}," in text or f" of {m} " in text}
    assert told == set(methods)


def write_metrics(folder, rows):
    folder.mkdir(parents=True)
    with open(folder / "metrics.csv", "w") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader(), writer.writerows(rows)


def test_curves_take_the_seeds_that_came_as_far_as_the_furthest(tmp_path):
    folders = [tmp_path / f"seed{seed}" for seed in range(4)]
    for seed, last in enumerate((4, 4, 2)):
        write_metrics(folders[seed], [dict(steps=i / 2, success="" if i % 2 else i / 20 + seed) for i in range(2 * last + 1)])
    x, y = plots.curves(folders, "steps", "success")  # rows without a value are left out
    assert x.tolist() == [0, 1, 2, 3, 4] and y.shape == (2, 5)
    assert y[1] == pytest.approx([1.0, 1.1, 1.2, 1.3, 1.4])
    assert plots.curves(folders[3:], "steps", "success") == (None, None)


def test_every_method_has_a_style_of_its_own():
    for registry in stacks.METHODS, stacks.ESTIMATORS:
        labels, colours, markers = zip(*map(plots.style, registry))
        assert list(labels) == [entry.label for entry in registry.values()]
        assert len(set(labels)) == len(set(colours)) == len(set(markers)) == len(registry)


def shape(path):
    return cv2.imread(str(path)).shape


def test_every_figure_is_drawn_with_whatever_runs_there_are(tmp_path):
    study, play = tmp_path / "study", players()
    for run in ("03_train_estimator/ours", "03_train_estimator/mse", "04_train_policy/behavior_cloning"):
        write_metrics(study / run / "seed0", [dict(epoch=i, train_loss=1, validation_loss=2 / i) for i in (1, 2, 3)])
    for run in ("01_train_privileged/seed0", *(f"04_train_policy/{m}" for m in ("est/seed0", "est/seed1", "end_to_end/seed0"))):
        write_metrics(study / run, [dict(steps=i, success=i / 10) for i in range(3)])
    for folder in study, tmp_path / "empty":
        for name in plots.LOSSES:
            plots.validation_loss([folder], name, tmp_path / f"{folder.name}_{name}.png")
        plots.success_rate([folder], tmp_path / f"{folder.name}_success_rate.png", {"priv_on_estimate": 0.8})
        plots.success_rate_priv([folder], tmp_path / f"{folder.name}_success_rate_priv.png")
    assert all((cv2.imread(str(path)) != cv2.imread(str(path).replace("study_", "empty_"))).any()
               for path in tmp_path.glob("study_*.png"))
    rows = [dict.fromkeys(("train_success", "train_return", "kl", "lr"), math.nan if i == 0 else i) | dict(steps=i)
            for i in range(3)]
    plots.training([row | dict(success=0.5 if i == 0 else math.nan) for i, row in enumerate(rows)], tmp_path / "training.png")
    plots.checkpoints([dict(checkpoint=i, episodes=2, success=0.5) for i in range(3)], tmp_path / "checkpoints.png")
    errors = {"trans_mean_l2_mm": 4.0, "rot_mean_abs_deg": 2.0}
    plots.passes({m: errors | {"seen": errors, "occluded": errors} for m in (1, 10)}, tmp_path / "passes.png")
    results = statistics.summarise(made_up())
    plots.occlusion_duration(results["occlusion_duration"], tmp_path / "occlusion_duration.png")
    plots.sim(tmp_path / "sim.png")
    plots.other_worlds(results, tmp_path / "other_worlds.png")
    centres = np.random.default_rng(0).uniform(-1, 1, (2000, 2)) * task.HALF
    plots.starts(centres, np.abs(centres[:, 1]) < 0.1, tmp_path / "starts.png")
    pair = {m: play.episode(evaluate.Measurement(m, 6, occlusion=math.inf), 1)
            for m in ("est_uncertainty", "priv_on_estimate")}
    plots.trajectory_with_uncertainty(pair, tmp_path / "trajectory.png", 3, 6, 1)
    images = sorted(tmp_path.glob("*.png"))
    assert len(images) == 18 and all(min(shape(path)[:2]) >= 350 for path in images)
    assert not list(tmp_path.rglob(".*"))  # nothing half-written


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
