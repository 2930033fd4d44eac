"""The numbered scripts, in the smoke preset: what goes wrong, told in one line."""
import importlib
import json
import os
import sys

import pytest
import torch
from conftest import SCRIPTS, is_mistake
from test_stages import OUTPUTS

from common import command, files, ranks


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


@pytest.mark.parametrize("script, args", [
    ("01_train_privileged", ()), ("03_train_estimator", ("--method", "mse")), ("04_train_policy", ("--method", "est")),
    ("04_train_policy", ("--method", "behavior_cloning"))])
def test_too_many_processes_cost_no_run(study, call, script, args, monkeypatch):
    monkeypatch.setattr(ranks, "COUNT", 17)
    monkeypatch.setattr(ranks, "begin", lambda device: None)
    monkeypatch.setattr(ranks, "let_the_cause_speak", lambda failure: None)
    monkeypatch.setattr(os, "_exit", sys.exit)
    assert is_mistake(*call(study, script, "--force", *args), "17 processes share", "16", "at most")
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


@pytest.mark.parametrize("name", ["--filter-trajectories", "--switch-episodes"])
def test_one_episode_tells_no_interval(study, call, name):
    assert is_mistake(*call(study, "05_evaluate", name, "1"), f"{name} 1", "say 2 or more")


def test_an_ensemble_without_one_of_its_nets_says_which_to_train(study, call):
    ended = call(study, "04_train_policy", "--method", "est_ensemble")
    assert is_mistake(*ended, "03_train_estimator.py", "likelihood", "--seed 1")
    assert not (study / "smoke/04_train_policy/est_ensemble").exists()


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_preset_is_a_config(script):
    module = importlib.import_module(script)
    for preset in module.PRESETS:
        assert command.parse(module.Config, module.PRESETS, module.__doc__, [preset]).preset == preset


def test_mistakes_on_the_command_line_are_one_line(tmp_path, call):
    for field, value, words in (("--lerning-rate", "1", "--help"), ("--updates", "many", "--updates"),
                                ("--checkpoints", "1", "say 2 to 7"), ("--mass", "2 1", "the least first"),
                                ("--box", "0.3 0.2 0.07", "no room to start"), ("--starts", "here", "--starts")):
        assert is_mistake(*call(tmp_path / "runs", "01_train_privileged", field, *value.split()), field, words)
    assert not (tmp_path / "runs").exists()
