"""What 05 makes of its measurements: intervals, results.json, tables and figures."""
import csv
import json
import math

import cv2
import numpy as np
import pytest
from test_evaluate import evaluate, players

from common import calibration, plots, stacks, statistics, tables, task
from common.task import World


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


def test_paired_sums_over_steps_weigh_the_steps_alike():
    rng = np.random.default_rng(0)
    steps, held = rng.integers(50, 300, (300, 100)), 0
    for lengths in steps:
        off = rng.normal(0.5, 2, 100) * lengths  # a trajectory errs alike at each of its steps
        d = statistics.paired(7 + off, 7, lengths)
        assert d["mean"] == pytest.approx(off.sum() / lengths.sum())
        held += d["low"] <= 0.5 <= d["high"]
    assert held / 300 == pytest.approx(0.95, abs=0.04)


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
    sums = rng.uniform(0.9, 1.1, (5, 9)) * [[200], [0.8], [0.004], [4], [0.1]]
    sums = dict.fromkeys(("all", "seen", "occluded"), sums.tolist()) | {"calibration": tallies.T.tolist()}
    worse = sums | {"all": (np.array(sums["all"]) * [[1], [1.25], [1.6], [1.25], [1.6]]).tolist()}
    return done | {f"filter/{row}/{kind}": of for row in ("test", "c=0.078")
                   for kind, of in (("ensemble", worse), ("filter", sums))}


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
    d, rows = results["filter"]["test"]["filter"]["minus_ensemble_mm"], results["filter"]["test"]
    assert d["mean"] == pytest.approx(rows["filter"]["trans_mean_l2_mm"] - rows["ensemble"]["trans_mean_l2_mm"])
    assert d["low"] < d["mean"] < d["high"] < 0
    assert all(set(row) == {"priv_on_state", "est_uncertainty"} for row in results["starts"].values())


def test_a_table_of_errors_in_the_loop():
    rng = np.random.default_rng(0)
    steps = rng.integers(50, 300, 500)
    sums = steps[:, None] * [1, 0.004, 0.004**2, 0.02, 0.02**2]
    row = statistics.in_the_loop([dict.fromkeys(("all", "seen", "occluded"), each.tolist()) for each in sums])
    assert row["trans_mean_l2_mm"] == pytest.approx(4.0) and row["rot_mean_abs_deg"] == pytest.approx(np.rad2deg(0.02))
    text = tables.in_the_loop({"in_the_loop": {"est": row}})
    assert "| est    | 4.00 [4.00, 4.00] |" in text and not tables.in_the_loop({})


def test_several_seeds_give_mean_and_std_beside_the_first_seeds_interval():
    done = made_up(seeds=3)
    row = statistics.summarise(done)["success_rate"]["est"]
    rates = [np.mean(done[f"success_rate/est/{k}"]) for k in range(3)]
    assert row["mean"] == rates[0]
    assert row["seeds"] == {"mean": pytest.approx(np.mean(rates)), "std": pytest.approx(np.std(rates, ddof=1)), "count": 3}
    done["estimator_seeds/ours/1"] = done["estimator_ablation/ours"] | {"trans_mean_l2_mm": 5.0, "rot_mean_abs_deg": 2.2}
    row = (results := statistics.summarise(done))["estimator_ablation"]["ours"]
    assert row["trans_mean_l2_mm"] == 4.0 and row["seeds"]["trans_mean_l2_mm"] == {"mean": 4.5, "std": pytest.approx(0.5**0.5)}
    assert "4.50 +- 0.71, 2.10 +- 0.14 (2) |" in tables.estimator_ablation(results) and "estimator_seeds" not in results
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
    alone = {"filter": {"test": {"filter": results["filter"]["test"]["filter"]}}}
    assert "minus" in tables.filtered(results) and "minus" not in tables.filtered(alone)
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
