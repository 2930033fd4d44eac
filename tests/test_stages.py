"""The numbered scripts, in the smoke preset: once in order, stopped and resumed, and with what goes wrong."""
import csv
import importlib
import json
import math
import shutil
import signal
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import SCRIPTS, run, start

from common import collection, command, files, measurements, networks, ppo, runs, stacks, statistics, task, trajectories, weights
from common.env import PushVectorEnv
from common.task import World

ROOT = Path(__file__).parent.parent
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
    "05_evaluate/seed0": ["results.json", "measurements.json", "tables.md", "success_rate.png", "occlusion_duration.png",
                          "sim.png", "trajectory_with_uncertainty.png", "film.mp4", "film.gif", "success_rate_priv.png",
                          "likelihood_loss.png", "mse_loss.png", "bc_loss.png", "calibration.png"],
    "06_robot/seed0": ["summary.json", "robot.png", "natural_000.npz", "hand_5s_000.npz", "hand_full_000.npz"],
} | {f"04_train_policy/{m}/seed0": ["policy.safetensors", "training.png", "success_rate.png"]
     for m in sorted(POLICIES - {"behavior_cloning"})}


@pytest.fixture
def copy(study, tmp_path):
    """Copies the study's stages before the n-th."""
    def of(stages):
        for script in SCRIPTS[:stages]:
            shutil.copytree(study / "smoke" / script, tmp_path / "runs" / "smoke" / script)
        return tmp_path / "runs"
    return of


@pytest.fixture
def call(monkeypatch, capsys):
    """Runs a script in this process, which spares the imports; returns stdout, stderr and the exit code."""
    def of(out, script, *args):
        monkeypatch.setattr(sys, "argv", [str(ROOT / f"{script}.py"), "smoke", "--out", str(out), "--device", "cpu", *args])
        module, code = importlib.import_module(script), 0
        try:
            command.main(module.Config, module.PRESETS, module.main, module.__doc__)
        except SystemExit as end:
            code = end.code
        return *capsys.readouterr(), code
    return of


def is_mistake(stdout, stderr, code, *words):
    """One line on stderr that says `words`, and exit code 2."""
    lines = [line for line in stderr.splitlines() if line.strip()]
    return code == 2 and len(lines) == 1 and lines[0].startswith("error: ") and all(word in lines[0] for word in words)


def saved(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.safetensors"))}


def metrics(folder):
    """metrics.csv without the speed."""
    with open(folder / "metrics.csv") as file:
        return [{key: x for key, x in row.items() if key != "steps_per_s"} for row in csv.DictReader(file)]


# Once in order


@pytest.mark.parametrize("folder", OUTPUTS)
def test_every_output_is_there(study, folder):
    folder, names = study / "smoke" / folder, OUTPUTS[folder]
    assert {path.name for path in folder.iterdir()} == {*names, "config.json", "metrics.csv"} - (
        {"metrics.csv"} if folder.parent.name in ("05_evaluate", "06_robot") else set())
    assert json.loads((folder / "config.json").read_text())["finished"]
    assert all(cv2.imread(str(path)).std() > 1 for path in folder.glob("*.png"))


def test_nothing_else_was_written(study):
    folders = {path.parent.relative_to(study / "smoke").as_posix() for path in study.rglob("*") if path.is_file()}
    assert folders == set(OUTPUTS) and [path.name for path in study.parent.iterdir()] == ["runs"]


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
    for name, low, high in (("train_success", 0, 1), ("train_length", 1, task.HORIZON), ("clip_fraction", 0, 1), ("kl", 0, 1),
                            ("entropy", 0, 2 * np.log(11) + 1e-4), ("explained", -99, 1), ("lr", 1e-5, 0.1), ("tolerance", 1, 4)):
        assert np.nanmin(values[name]) >= low and np.nanmax(values[name]) <= high, name
    assert (values["steps_per_s"] > 0).all() and (values["value_loss"] > 0).all()


@pytest.mark.parametrize("name", SETS)
def test_trajectories_are_whole_episodes_of_the_study(study, name):
    folder = study / "smoke" / "02_collect" / "seed0"
    states, offsets = trajectories.load(*(folder / file for file in trajectories.files(name)))
    lengths, first, last = np.diff(offsets), states[offsets[:-1]], states[offsets[1:] - 1]
    assert len(lengths) == SETS[name] and lengths.min() >= 1 and lengths.max() <= task.HORIZON
    assert states.dtype == np.float32 and np.isfinite(states).all()
    assert (np.abs(first[:, :2]) <= World().centre_range(first[:, 2]) + 1e-6).all() and not first[:, 5:].any()
    assert not task.outside(states[:, :3], states[:, 3:5]).any() and not task.reached(states[:, :3]).any()
    within = np.diff(np.repeat(np.arange(len(lengths)), lengths)) == 0
    assert (np.abs(np.diff(states[:, 3:5], axis=0))[within] <= task.MAX_SPEED / task.RATE + 1e-6).all()
    ended = lengths < task.HORIZON  # one step from the edge, or from the target
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
    for _ in range(task.HORIZON - 1):  # no world ends before
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
    for rates in results["filter_loop"].values():
        assert rates.keys() == {"ours", "filter"} and {rate["episodes"] for rate in rates.values()} == {2}
    assert results["contact_switches"].keys() == {"priv_on_state", "est_uncertainty"}
    for row in results["contact_switches"].values():
        assert row["mean"] >= 0 and row["std"] >= 0 and row["episodes"] == 16


def test_other_worlds_are_played_by_every_policy_that_estimates(copy, call, monkeypatch):
    out = copy(4)
    monkeypatch.setattr(task, "HORIZON", 20)  # for time
    assert call(out, "05_evaluate", "--other-episodes", "2")[2] == 0
    results = json.loads((out / "smoke/05_evaluate/seed0/results.json").read_text())
    estimating = {"est_uncertainty", "est", "est_mse", "priv_on_estimate"}
    assert results["other_worlds"].keys() == {
        "c=0.042", "c=0.060", "c=0.078", "support_offset=8mm", "mass=1-1.5", "mass=5-6", "mu=0.05-0.1", "mu=0.3-0.6", "box=-2cm",
        "box=+2cm", "box=+2cm_wide", "noise=2x", "bias=2x", "force=0.7x", "force=1.3x", "late=1", "late=2", "surface=1.5",
        "surface=4"}
    for row, rates in results["other_worlds"].items():
        sensing = row.partition("=")[0] in ("noise", "bias", "force", "late")
        assert rates.keys() == (estimating if sensing else estimating | {"priv_on_state"})
        assert all(rate.keys() == {"mean", "low", "high", "episodes"} and rate["episodes"] == 2 for rate in rates.values())
    assert (out / "smoke/05_evaluate/seed0/other_worlds.png").exists()


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
    told, = (line for line in stdout.splitlines() if line.startswith("left out, as not trained to the end: "))
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


# Stopped and resumed


@pytest.mark.parametrize("script, method, stops", [
    ("01_train_privileged", "", 2), ("03_train_estimator", "ours", 1), ("04_train_policy", "est", 1),
    ("04_train_policy", "behavior_cloning", 1)])
def test_a_stopped_run_ends_bit_for_bit_as_an_uninterrupted_one(study, copy, script, method, stops):
    out, which = copy(SCRIPTS.index(script)), ["--method", method] if method else []
    for _ in range(stops):
        assert "stopped after" in run(out, script, *which, "--max-minutes", "0")
    assert "stopped after" not in run(out, script, *which, "--max-minutes", "0")
    here, there = (root / "smoke" / script / method / "seed0" for root in (out, study))
    assert saved(here) == saved(there)
    assert metrics(here) == metrics(there)


def test_a_stopped_collection_goes_on_where_it_was(study, copy, call):
    out, states = copy(1), "smoke/02_collect/seed0/train_states.npy"
    for _ in range(20):
        stdout, _, code = call(out, "02_collect", "--max-minutes", "0")
        assert code == 0
        if "stopped after" not in stdout:
            break
    assert (out / states).read_bytes() == (study / states).read_bytes()


def test_a_killed_run_ends_bit_for_bit_as_an_uninterrupted_one(study, tmp_path):
    script = "01_train_privileged"
    here, there = (root / "smoke" / script / "seed0" for root in (tmp_path / "runs", study))
    process = start(tmp_path / "runs", script)
    while not (here / "resume.pt").exists() and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL and not (here / "policy.safetensors").exists()
    run(tmp_path / "runs", script)
    assert saved(here) == saved(there) and metrics(here) == metrics(there)


# What goes wrong


@pytest.mark.parametrize("script, needed", [("02_collect", "01_train_privileged"), ("03_train_estimator", "02_collect"),
                                            ("04_train_policy", "01_train_privileged"), ("05_evaluate", "01_train_privileged"),
                                            ("06_robot", "03_train_estimator")])
def test_a_missing_stage_is_named(tmp_path, call, script, needed):
    assert is_mistake(*call(tmp_path / "runs", script), f"run python {needed}.py smoke", "first")


def test_the_test_set_is_demanded(copy, call):
    assert is_mistake(*call(copy(1), "05_evaluate"), "test_states.npy is missing", "run python 02_collect.py smoke", "first")


def test_a_missing_estimator_is_named(copy, call):
    out = copy(2)
    result = call(out, "04_train_policy", "--method", "est_mse")
    assert is_mistake(*result, "run python 03_train_estimator.py smoke --method mse", "first")


@pytest.mark.parametrize("damage", ["deleted", "cut", "changed"])
@pytest.mark.parametrize("script, file, needed", [
    ("02_collect", "01_train_privileged/seed0/checkpoint_001.safetensors", "python 01_train_privileged.py smoke"),
    ("03_train_estimator", "02_collect/seed0/train_states.npy", "python 02_collect.py smoke"),
    ("04_train_policy", "03_train_estimator/ours/seed0/estimator.safetensors",
     "python 03_train_estimator.py smoke --method ours"),
    ("05_evaluate", "04_train_policy/est/seed0/policy.safetensors", "python 04_train_policy.py smoke --method est")])
def test_a_damaged_input_names_its_stage(copy, call, script, file, needed, damage):
    out = copy(SCRIPTS.index(script))
    path = out / "smoke" / file
    whole = path.read_bytes()
    match damage:
        case "deleted":
            path.unlink()
        case "cut":
            path.write_bytes(whole[:-100])
        case "changed":
            path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert is_mistake(*call(out, script), "missing or damaged", f"run {needed}", "--force")


@pytest.mark.parametrize("script, method, args, words", [
    ("01_train_privileged", "", ("--lr", "1e30", "--lr-max", "1e30"), "diverged in update"),
    ("03_train_estimator", "mse", ("--lr", "1e30", "--lr-end", "1e30"), "diverged in epoch")])
def test_a_training_that_diverged_does_not_finish(copy, call, script, method, args, words):
    out = copy(SCRIPTS.index(script))
    stdout, stderr, code = call(out, script, "--seed", "1", *(("--method", method) if method else ()), *args)
    assert code == 2 and words in stderr and "Traceback" not in stderr
    assert not json.loads((out / "smoke" / script / method / "seed1" / "config.json").read_text())["finished"]


@pytest.mark.parametrize("script, args, words", [
    ("01_train_privileged", ("--device", "cuda"), "no GPU"), ("02_collect", ("--device", "cuda"), "no GPU"),
    ("02_collect", ("--seed", "1"), "seed 0's trajectories"),
    ("03_train_estimator", ("--dropout", "1"), "below 1"), ("04_train_policy", ("--sizes", "8", "8", "8"), "--no-warm-start")])
def test_a_mistake_costs_no_run(study, call, script, args, words, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert is_mistake(*call(study, script, "--force", *args), words)
    assert all((study / "smoke" / folder / name).exists() for folder, names in OUTPUTS.items() for name in names)


def test_a_stale_input_names_the_stage_to_redo(copy, call):
    out = copy(3)
    assert call(out, "01_train_privileged", "--force", "--lr", "2e-3")[2] == 0
    assert is_mistake(*call(out, "02_collect"), "inputs changed", "checkpoint_002.safetensors", "--force")
    assert is_mistake(*call(out, "03_train_estimator"), "stale", "run python 02_collect.py smoke", "--force")
    assert is_mistake(*call(out, "04_train_policy"), "stale", "--force")


def test_what_reads_no_net_is_trained_in_the_world_of_01_all_the_same(copy, call):
    out = copy(0)
    assert call(out, "01_train_privileged", "--starts", "centre", "--mass", "1", "2")[2] == 0
    assert call(out, "04_train_policy", "--method", "end_to_end", "--no-warm-start")[2] == 0
    world = json.loads((out / "smoke/04_train_policy/end_to_end/seed0/config.json").read_text())["world"]
    assert (world["starts"], world["mass"], world["box"]) == ("centre", [1.0, 2.0], [0.12, 0.10, 0.07])


def test_a_box_that_the_robot_is_not_made_for_is_one_line(copy, call):
    out = copy(4)
    for path in (out / "smoke").glob("0[34]*/**/config.json"):
        record = json.loads(path.read_text())
        record["world"]["box"] = [0.14, 0.10, 0.07]
        files.save_json(path, record)
    assert is_mistake(*call(out, "06_robot"), "--box (0.14, 0.1, 0.07)", "made for (0.12, 0.1, 0.07) only")
    assert not (out / "smoke" / "06_robot").exists()


def test_too_few_particles_are_one_line(study, call):
    assert is_mistake(*call(study, "05_evaluate", "--particles", "9"), "--particles 9", "say 10 or more")


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_preset_is_a_config(script):
    module = importlib.import_module(script)
    for preset in module.PRESETS:
        assert command.parse(module.Config, module.PRESETS, module.__doc__, [preset]).preset == preset


def test_mistakes_on_the_command_line_are_one_line(tmp_path):
    for field, value, words in (("--lerning-rate", "1", "--help"), ("--updates", "many", "--updates"),
                                ("--checkpoints", "1", "say 2 to 7"), ("--mass", "2 1", "the least first"),
                                ("--box", "0.3 0.2 0.07", "no room to start"), ("--starts", "here", "--starts")):
        process = start(tmp_path / "runs", "01_train_privileged", field, *value.split())
        assert is_mistake(*process.communicate(), process.returncode, field, words)
    assert not (tmp_path / "runs").exists()


# The paper's nets


def paper(script, **kw):
    """A script as a module, and its paper's config with less to do."""
    module = importlib.import_module(script)
    return module, module.Config(device="cpu", epochs=1, **kw)


@pytest.fixture
def few(monkeypatch):
    """Five trajectories instead of any set."""
    states = np.random.default_rng(0).uniform(-0.1, 0.1, (100, 7)).astype(np.float32)
    data = states, np.array([0, 30, 40, 50, 90, 100])
    monkeypatch.setattr(trajectories, "load_set", lambda cfg, name: (data, {}))
    return data


def test_ppo_updates_the_papers_nets_with_the_papers_estimator():
    module, cfg = paper("04_train_policy", num_envs=8)
    env = stacks.make(stacks.METHODS["est_uncertainty"], cfg.num_envs, networks.Estimator().requires_grad_(False), cfg.passes)
    actor, critic = networks.policy(12, cfg.sizes), networks.value(12, cfg.sizes)
    optimizers = [torch.optim.Adam(net.parameters(), lr=cfg.lr) for net in (actor, critic)]
    carry, before = (env.reset(seed=0)[0], actor.initial(8), critic.initial(8)), actor.encoder.weight.clone()
    batch, _ = ppo.rollout(env, actor, critic, carry, 10)
    stats = ppo.update(actor, critic, optimizers, ppo.sequences(batch, critic, cfg.gamma, cfg.lam), cfg)
    assert batch["obs"].shape == (10, 8, 12) and np.isfinite(list(stats.values())).all()
    assert not actor.encoder.weight.equal(before)


def test_the_papers_estimator_takes_an_update(tmp_path, few):
    module, cfg = paper("03_train_estimator", method="ours", out=tmp_path)
    run = runs.Run(cfg, "03_train_estimator", {}, "ours")
    assert module.train(run, cfg, few, few, torch.device("cpu"))
    f = weights.load(networks.Estimator, run.dir / "estimator.safetensors")
    torch.manual_seed(0)
    assert f.sizes == (1024, 512, 256) and not f.lstm.weight_hh_l0.equal(networks.Estimator().lstm.weight_hh_l0)


def test_the_papers_student_takes_an_update_toward_its_teacher(tmp_path, few):
    module, cfg = paper("04_train_policy", method="behavior_cloning", bc_epochs=8, out=tmp_path)
    weights.save(path := tmp_path / "teacher.safetensors", teacher := networks.policy(8))
    with torch.no_grad():
        teacher.head[-1].bias[3] = teacher.head[-1].bias[11 + 7] = 3.0
    weights.save(path, teacher)
    run = runs.Run(cfg, "04_train_policy", {}, "behavior_cloning")
    student = module.train_bc(run, cfg, {"policy": path}, torch.device("cpu"))
    losses = [row["validation_loss"] for row in run.rows()]
    assert tuple(student.sizes) == (128, 256, 128) and losses[-1] < losses[0] - 0.5
    assert (networks.mode(student(torch.zeros(1, 1, 9))[0]) == torch.tensor([3, 7])).all()
