"""The numbered scripts, in the smoke preset: once in order."""
import csv
import importlib
import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import SCRIPTS, is_mistake, metrics

from common import collection, measurements, networks, statistics, task, trajectories, weights
from common.env import PushVectorEnv
from common.task import World

ROOT = Path(__file__).parent.parent
SMOKE = importlib.import_module(SCRIPTS[0]).PRESETS["smoke"]["world"]
SETS = {"train": 48, "validation": 12, "test": 12, "teacher_train": 48, "teacher_validation": 12}
ESTIMATORS = {"ours", "likelihood", "mse"}
POLICIES = {"est_uncertainty", "est", "est_mse", "end_to_end", "behavior_cloning"}
OUTPUTS = {
    "01_train_privileged/seed0": ["policy.safetensors", "value.safetensors", "checkpoint_000.safetensors",
                                  "checkpoint_001.safetensors", "checkpoint_002.safetensors", "training.png",
                                  "success_rate_priv.png", "starts.png"],
    "02_collect/seed0": [file for name in SETS for file in trajectories.files(name)] + ["success.png"],
    "03_train_estimator/ours/seed0": ["estimator.safetensors", "likelihood_loss.png", "passes.json", "passes.png"],
    "03_train_estimator/likelihood/seed0": ["estimator.safetensors", "likelihood_loss.png", "passes.json"],
    "03_train_estimator/mse/seed0": ["estimator.safetensors", "mse_loss.png", "passes.json"],
    "04_train_policy/behavior_cloning/seed0": ["policy.safetensors", "bc_loss.png"],
    "05_evaluate/seed0": ["results.json", "measurements", "tables.md", "success_rate.png", "occlusion_duration.png",
                          "sim.png", "trajectory_with_uncertainty.png", "film.mp4", "film.gif", "success_rate_priv.png",
                          "likelihood_loss.png", "mse_loss.png", "bc_loss.png", "calibration.png"],
    "06_robot/seed0": ["summary.json", "robot.png", "natural_000.npz", "hand_5s_000.npz", "hand_full_000.npz"],
} | {f"04_train_policy/{m}/seed0": ["policy.safetensors", "training.png", "success_rate.png"]
     for m in sorted(POLICIES - {"behavior_cloning"})}


@pytest.mark.parametrize("folder", OUTPUTS)
def test_every_output_is_there(study, folder):
    folder, names = study / "smoke" / folder, OUTPUTS[folder]
    assert {path.name for path in folder.iterdir()} == {*names, "config.json", "metrics.csv"} - (
        {"metrics.csv"} if folder.parent.name in ("05_evaluate", "06_robot") else set())
    assert json.loads((folder / "config.json").read_text())["finished"]
    assert all(cv2.imread(str(path)).std() > 1 for path in folder.glob("*.png"))


def test_nothing_else_was_written(study):
    folders = {path.parent.relative_to(study / "smoke").as_posix() for path in study.rglob("*") if path.is_file()}
    assert {folder for folder in folders if not folder.startswith("05_evaluate/seed0/measurements/")} == set(OUTPUTS)
    assert [path.name for path in study.parent.iterdir()] == ["runs"]


def test_checkpoints_go_from_the_untrained_to_the_last_policy(study):
    folder = study / "smoke" / "01_train_privileged" / "seed0"
    torch.manual_seed(0)
    untrained = {name: x.half() for name, x in networks.policy(8, (16, 16, 16)).state_dict().items()}
    first, middle, last = (weights.load_tensors(path)[0] for path in sorted(folder.glob("checkpoint_*")))
    policy = weights.load_tensors(folder / "policy.safetensors")[0]
    assert all(first[name].equal(untrained[name]) and last[name].equal(policy[name]) for name in policy)
    assert not any(middle[name].equal(x[name]) for x in (first, last) for name in policy)


def test_success_is_logged_on_schedule(study):
    rows = metrics(study / "smoke" / "01_train_privileged" / "seed0")
    assert [(int(row["update"]), int(row["steps"])) for row in rows] == [(k, 512 * k) for k in range(7)]
    assert [int(row["update"]) for row in rows if row["success"]] == [0, 3, 6]
    assert all(0 <= float(row["success"]) <= 1 for row in rows[::3])


@pytest.mark.parametrize("folder, updates", [("01_train_privileged", 6), ("04_train_policy/est", 4)])
def test_every_update_is_logged(study, folder, updates):
    with open(study / "smoke" / folder / "seed0" / "metrics.csv") as file:
        first, *rows = csv.DictReader(file)
    episodes = ["train_success", "train_return", "train_length"]
    columns = ["policy_loss", "clip_fraction", "kl", "entropy", "value_loss", "explained", "lr", "steps_per_s"]
    assert list(first) == ["update", "steps", "success", "tolerance", *episodes, *columns]
    assert all(first[name] == "nan" for name in (*episodes, *columns))
    assert [int(row["update"]) for row in rows] == [*range(1, updates + 1)]
    values = {name: np.array([float(row[name]) for row in rows]) for name in first if name != "success"}
    assert all(np.isfinite(values[name]).all() for name in ("tolerance", *columns))
    assert np.isfinite(values["train_return"]).any()  # nan where no episode ended
    for name, low, high in (("train_success", 0, 1), ("train_length", 1, SMOKE.horizon), ("clip_fraction", 0, 1), ("kl", 0, 1),
                            ("entropy", 0, 2 * np.log(11) + 1e-4), ("explained", -99, 1), ("lr", 1e-5, 0.1), ("tolerance", 1, 4)):
        assert np.nanmin(values[name]) >= low and np.nanmax(values[name]) <= high, name
    assert (values["steps_per_s"] > 0).all() and (values["value_loss"] > 0).all()


@pytest.mark.parametrize("name", SETS)
def test_trajectories_are_whole_episodes_of_the_study(study, name):
    folder = study / "smoke" / "02_collect" / "seed0"
    states, offsets = trajectories.load(*(folder / file for file in trajectories.files(name)))
    lengths, first, last = np.diff(offsets), states[offsets[:-1]], states[offsets[1:] - 1]
    assert len(lengths) == SETS[name] and lengths.min() >= 1 and lengths.max() <= SMOKE.horizon
    assert states.dtype == np.float32 and np.isfinite(states).all()
    assert (np.abs(first[:, :2]) <= World().centre_range(first[:, 2]) + 1e-6).all() and not first[:, 5:].any()
    assert not task.outside(states[:, :3], states[:, 3:5]).any() and not task.reached(states[:, :3]).any()
    within = np.diff(np.repeat(np.arange(len(lengths)), lengths)) == 0
    assert (np.abs(np.diff(states[:, 3:5], axis=0))[within] <= task.MAX_SPEED / task.RATE + 1e-6).all()
    ended = lengths < SMOKE.horizon  # one step from the edge, or from the target
    edge = np.minimum(task.HALF - np.abs(last[:, :2]), task.HALF - np.abs(last[:, 3:5])).min(1)
    assert ((edge < 0.006) | (np.linalg.norm(last[:, :2], axis=1) < 0.016))[ended].all()


def test_every_checkpoint_plays_as_many_episodes(study):
    rows = metrics(study / "smoke" / "02_collect" / "seed0")
    teacher = SETS["teacher_train"] + SETS["teacher_validation"]
    drifting = (SETS["train"] + SETS["validation"]) // 2 // 3
    assert [int(row["episodes"]) for row in rows] == [24 - drifting, 24 - drifting, 24 - drifting + teacher]


def test_a_drifting_player_sees_the_box_off_its_pose_in_the_last_worlds():
    env = collection.Drifting(PushVectorEnv(600), 400)
    errors, obs = [], env.reset(seed=3)[0]
    for _ in range(World().horizon - 1):  # no world ends before
        errors.append(task.unscale_pose(obs[:, :4]) - env.unwrapped.box)
        assert (obs[:, 4:] == task.scale(env.unwrapped.state)[:, 4:]).all()
        obs = env.step(np.full((600, 2), 5))[0]
    errors = np.array(errors)
    errors[..., 2] = task.wrap(errors[..., 2])
    assert np.abs(errors[:, :200]).max() < 1e-5
    assert errors[60:, 200:].std((0, 1)) == pytest.approx(collection.DRIFT / 3**0.5, rel=0.1)  # sizes are uniform
    later = int(collection.DRIFT_TIME * task.RATE)
    kept = (errors[60:-later] * errors[60 + later:])[:, 200:].mean((0, 1)) / errors[60:, 200:].var((0, 1))
    assert kept == pytest.approx(np.full(3, np.exp(-1)), abs=0.1)
    again = collection.Drifting(PushVectorEnv(600), 400)
    assert (again.reset(seed=3)[0] == env.reset(seed=3)[0]).all()


def test_inputs_are_recorded(study):
    inputs = json.loads((study / "smoke/04_train_policy/est_mse/seed0/config.json").read_text())["inputs"]
    assert "03_train_estimator/mse/seed0/estimator.safetensors" in inputs
    assert "01_train_privileged/seed0/policy.safetensors" in inputs


@pytest.mark.parametrize("method, grid", [("ours", ["1", "2", "5", "10", "20", "50"]), ("likelihood", ["1"]), ("mse", ["1"])])
def test_errors_against_passes(study, method, grid):
    errors = json.loads((study / f"smoke/03_train_estimator/{method}/seed0/passes.json").read_text())
    assert list(errors) == grid
    assert all(row["trans_mean_l2_mm"] > 0 and row["seen"]["rot_rmse_deg"] > 0 for row in errors.values())


def test_results_have_every_number(study):
    results = json.loads((study / "smoke/05_evaluate/seed0/results.json").read_text())
    methods = POLICIES | {"priv_on_estimate", "priv_on_state"}
    numbers = {"trans_mean_l2_mm", "trans_rmse_mm", "rot_mean_abs_deg", "rot_rmse_deg"}
    assert results["estimator_ablation"].keys() == ESTIMATORS | {"vision"}
    for row in results["estimator_ablation"].values():
        assert numbers <= row.keys() and numbers <= row["seen"].keys() and numbers <= row["occluded"].keys()
    assert results["success_rate"].keys() == methods
    assert results["occlusion_duration"].keys() == methods - {"priv_on_state"}
    assert all(list(row) == ["0", "2.5", "5", "10", "full"] for row in results["occlusion_duration"].values())
    assert results["starts"].keys() == {"centre", "inner"}
    rates = [*results["success_rate"].values(), *(rate for row in results["starts"].values() for rate in row.values())]
    for rate in rates + [rate for row in results["occlusion_duration"].values() for rate in row.values()]:
        assert 0 <= rate["low"] <= rate["mean"] <= rate["high"] <= 1 and rate["high"] > rate["low"]
    assert {rate["episodes"] for rate in rates} == {16}
    assert results["in_the_loop"].keys() == {"est_uncertainty", "est", "est_mse", "priv_on_estimate"}
    for name in ("ours", "likelihood"):
        told = results["estimator_ablation"][name]
        assert {"calibration", "scaled"} <= told.keys() and told["calibration"]["crps"] != told["scaled"]["crps"]
    assert "calibration" not in results["estimator_ablation"]["mse"] and "calibration" in results["in_the_loop"]["est"]
    assert results["filter"].keys() == {"test", "drifting", *measurements.FILTERED}
    for row in results["filter"].values():
        assert row.keys() == ESTIMATORS | {"vision", "filter"} and all(each["trans_mean_l2_mm"] > 0 for each in row.values())
    assert results["filter_loop"].keys() == {"ours", "filter"}
    for name, rates in results["filter_loop"].items():
        assert all(("minus_ours" in rate) == (name == "filter") for rate in rates.values())
        assert rates.keys() == {"est_uncertainty", "priv_on_estimate"} and {rate["episodes"] for rate in rates.values()} == {4}
    assert results["contact_switches"].keys() == {"priv_on_state", "est_uncertainty"}
    for row in results["contact_switches"].values():
        assert row["mean"] >= 0 and row["std"] >= 0 and row["episodes"] == 16


def test_other_worlds_are_played_by_every_policy_that_estimates(copy, call, monkeypatch):
    out = copy(4)
    monkeypatch.setattr(World, "horizon", 15)  # for time
    assert call(out, "05_evaluate", "--other-episodes", "2")[2] == 0
    results = json.loads((out / "smoke/05_evaluate/seed0/results.json").read_text())
    estimating = {"est_uncertainty", "est", "est_mse", "priv_on_estimate"}
    assert results["other_worlds"].keys() == {
        "as trained", "c=0.042", "c=0.060", "c=0.078", "support_offset=8mm", "mass=1-1.5", "mass=5-6", "mu=0.05-0.1",
        "mu=0.3-0.6", "mu_pusher=0.6-0.9", "box=-2cm", "box=+2cm", "box=+2cm_wide", "noise=2x", "bias=2x", "force=0.7x",
        "force=1.3x", "late=1", "late=2", "surface=1.5", "surface=4", "time=30s"}
    for row, rates in results["other_worlds"].items():
        sensing = row.partition("=")[0] in ("noise", "bias", "force", "late")
        assert rates.keys() == (estimating if sensing else estimating | {"priv_on_state"})
        assert all(rate.keys() == {"mean", "low", "high", "episodes"} and rate["episodes"] == 2 for rate in rates.values())
    assert (out / "smoke/05_evaluate/seed0/other_worlds.png").exists()


def test_the_filter_has_no_row_of_the_nets_own_world(tmp_path, call):
    for script, *settings in ((SCRIPTS[0], "--support", "1", "1"), (SCRIPTS[1],), (SCRIPTS[4],)):
        assert call(tmp_path, script, *settings)[2] == 0
    results = json.loads((tmp_path / "smoke/05_evaluate/seed0/results.json").read_text())
    assert results["filter"].keys() == {"test", "drifting", *measurements.FILTERED} - {"c=0.078"}


def test_the_ablation_is_measured_on_the_test_set(study):
    folder, draws = study / "smoke" / "02_collect" / "seed0", importlib.import_module("05_evaluate").LIST
    test = trajectories.load(*(folder / file for file in trajectories.files("test")))
    f = {m: weights.load(networks.Estimator, study / f"smoke/03_train_estimator/{m}/seed0/estimator.safetensors")
         for m in ESTIMATORS}
    results = json.loads((study / "smoke/05_evaluate/seed0/results.json").read_text())["estimator_ablation"]
    predictions = {"vision": lambda o: (o[..., :4], None), "ours": lambda o: f["ours"].predict(o, passes=200)[:2]}
    for name, predict in (predictions | {m: lambda o, m=m: (f[m](o)[0], None) for m in ("mse", "likelihood")}).items():
        table = statistics.error_table(trajectories.measure(test, 12, 100, draws, "cpu", predict))
        for got, want in [(results[name], table), *((results[name][part], table[part]) for part in ("seen", "occluded"))]:
            for row, reference in ((got, want), (got["half_95"], want["half_95"])):
                wanted = [reference[key] for key in statistics.ERRORS]
                assert [row[key] for key in statistics.ERRORS] == pytest.approx(wanted, rel=0.02)


def test_the_film_plays(study):
    film = cv2.VideoCapture(str(study / "smoke/05_evaluate/seed0/film.mp4"))
    ok, frame = film.read()
    assert ok and frame.std() > 1


def test_a_second_run_does_nothing(study, call):
    def written():
        return {path: path.stat().st_mtime_ns for path in study.rglob("*") if path.is_file() and path.name != "config.json"}

    before = written()
    for script in SCRIPTS:
        stdout, stderr, code = call(study, script)
        assert code == 0 and not stderr
        assert stdout.count("finished already (--force redoes it)") == sum(script in folder for folder in OUTPUTS)
    assert written() == before


def test_published_nets_are_evaluated_as_in_their_study(study, call, tmp_path, monkeypatch):
    monkeypatch.setattr(measurements, "DURATIONS", {"0": 0.0, "full": math.inf})  # for time
    monkeypatch.setattr(measurements, "other_worlds", lambda world: {})
    published = tmp_path / "published"
    for pattern in ("01_*/seed0/policy.safetensors", "02_*/seed0/test_*.npy", "03_*/*/seed0/estimator.safetensors",
                    "04_*/*/seed0/policy.safetensors", "0[134]*/**/metrics.csv"):
        for path in (study / "smoke").glob(pattern):
            folder = published / path.parent.relative_to(study / "smoke")
            folder.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, folder), shutil.copy(path.parent / "config.json", folder)
    out, name = tmp_path / "runs", "smoke/05_evaluate/seed0/results.json"
    assert call(out, "05_evaluate", "--weights", str(published), "--filter-trajectories", "None")[2] == 0
    assert json.loads((out / name).read_text())["success_rate"] == json.loads((study / name).read_text())["success_rate"]
    for figure in "success_rate", "success_rate_priv", "likelihood_loss", "mse_loss", "bc_loss":
        images = [cv2.imread(str(root / f"smoke/05_evaluate/seed0/{figure}.png")) for root in (out, study)]
        assert (images[0] == images[1]).all()
    assert call(out, "06_robot", "--scenario", "natural", "--weights", str(published))[2] == 0
    assert {path.name for path in (out / "smoke").iterdir()} == {"05_evaluate", "06_robot"}
    assert not any(str(tmp_path) in path.read_text() for path in out.rglob("config.json"))

    shutil.rmtree(published / "03_train_estimator")
    assert is_mistake(*call(out, "06_robot", "--weights", str(published)), "missing", f"(and not in --weights {published})",
                      "run python 03_train_estimator.py smoke --method ours", "first")
    stdout, _, code = call(out, "05_evaluate", "--weights", str(published), "--filter-trajectories", "None")
    told, = (line for line in stdout.splitlines() if line.startswith("left out"))
    estimated = ["est_uncertainty", "est", "est_mse", "priv_on_estimate"]
    names = [f"estimator {kind}" for kind in ("mse", "likelihood", "ours")] + estimated
    assert code == 0 and told.partition(": ")[2].split("; ") == names
    results, whole = (json.loads((root / name).read_text()) for root in (out, study))
    assert results["success_rate"].keys() == whole["success_rate"].keys() - set(estimated)
    assert list(results["estimator_ablation"]) == ["vision"]
    for needed in "02_collect", "01_train_privileged":
        shutil.rmtree(published / needed)
        words = "missing", f"(and not in --weights {published})", f"run python {needed}.py smoke", "first"
        assert is_mistake(*call(out, "05_evaluate", "--weights", str(published)), *words)
