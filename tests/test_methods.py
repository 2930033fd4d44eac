"""One registry: a method is one entry; 05 measures what is trained, and nothing twice."""
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from common import runs, stacks

ROOT = Path(__file__).parent.parent
ENTRY = """if True:
    import runpy, sys
    from common import stacks
    stacks.METHODS["mine"] = stacks.Method("my own", "s_hat, sigma", "likelihood", "rl")
    sys.argv[:] = sys.argv[1:]
    runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.fixture
def extended(tmp_path):
    """Runs a script of a house with one more method; returns what it printed."""
    def of(script, *args):
        command = [sys.executable, "-c", ENTRY, str(ROOT / f"{script}.py"), "smoke", "--out", "runs", "--device", "cpu", *args]
        end = subprocess.run(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
        assert end.returncode == 0, end.stderr
        return end.stdout
    return of


def test_a_method_is_one_entry_and_05_measures_only_what_is_new(study, extended, tmp_path):
    own, results = tmp_path / "runs/smoke", tmp_path / "runs/smoke/05_evaluate/seed0/results.json"
    for stage in ("01_train_privileged", "02_collect", "03_train_estimator", "05_evaluate"):
        shutil.copytree(study / "smoke" / stage, own / stage)
    for method in ("est_uncertainty", "end_to_end"):
        shutil.copytree(study / "smoke/04_train_policy" / method, own / "04_train_policy" / method)
    kept = results.parent / "measurements"
    file, = (kept / "success_rate/end_to_end/0").iterdir()
    file.write_text(json.dumps([1] * 16))  # a number that no measurement would give
    for file in kept.rglob("est/**/*.json"):
        file.unlink()

    assert "mine" in extended("04_train_policy", "--method", "mine")
    assert json.loads((own / "04_train_policy/mine/seed0/config.json").read_text())["inputs"].keys() >= {
        "03_train_estimator/likelihood/seed0/estimator.safetensors"}
    stdout = extended("05_evaluate")
    assert "left out, as not trained to the end, or without their nets: est; est_mse; behavior_cloning\n" in stdout
    table = json.loads(results.read_text())
    assert table["success_rate"].keys() == {"est_uncertainty", "end_to_end", "mine", "priv_on_estimate", "priv_on_state"}
    assert table["occlusion_duration"].keys() == table["success_rate"].keys() - {"priv_on_state"}
    assert table["success_rate"]["end_to_end"]["mean"] == 1, "measured again"
    assert "| mine " in (results.parent / "tables.md").read_text() and "success of mine" not in stdout
    assert "finished already" in extended("05_evaluate")

    shutil.copytree(own / "04_train_policy/mine/seed0", own / "04_train_policy/mine/seed7")
    shutil.copytree(study / "smoke/04_train_policy/est", own / "04_train_policy/est")
    shutil.copytree(own / "03_train_estimator/ours/seed0", own / "03_train_estimator/ours/seed4")
    before = {*kept.rglob("*.json")}
    assert "or without their nets: est_mse; behavior_cloning\n" in extended("05_evaluate")
    new = {path.parent.relative_to(kept).as_posix() for path in {*kept.rglob("*.json")} - before}
    assert new == {"estimator_seeds/ours/4", "success_rate/mine/7", "success_rate/est/0", "in_the_loop/est", *(
        f"occlusion_duration/est/{seconds}" for seconds in ("0", "2.5", "5", "10", "full"))}
    told = json.loads(results.read_text())
    assert told["success_rate"]["mine"]["seeds"]["count"] == told["estimator_ablation"]["ours"]["seeds"]["count"] == 2


def test_05_measures_pi_priv_alone_where_nothing_else_is_trained(study, extended, tmp_path):
    for stage in ("01_train_privileged", "02_collect"):
        shutil.copytree(study / "smoke" / stage, tmp_path / "runs/smoke" / stage)
    shutil.copytree(study / "smoke/03_train_estimator/ours/seed0", tmp_path / "runs/smoke/03_train_estimator/ours/seed4")
    stdout = extended("05_evaluate")
    assert "; estimator ours; estimator ours, seed 4; est_uncertainty; est" in stdout
    assert "their nets: estimator mse; estimator likelihood; estimator ours;" in stdout
    assert json.loads((tmp_path / "runs/smoke/05_evaluate/seed0/results.json").read_text())["success_rate"].keys() == {
        "priv_on_state"}


def test_a_further_seed_on_the_published_nets_stands_beside_them(study, extended, tmp_path):
    published = tmp_path / "published"
    shutil.copytree(study / "smoke", published, ignore=shutil.ignore_patterns(
        "05_*", "06_*", "train_*", "validation_*", "*mse", "likelihood", "est_uncertainty", "end_to_end", "behavior_cloning"))
    stdout = extended("04_train_policy", "--method", "est", "--seed", "3", "--weights", "published")
    assert "from published: 01_train_privileged/seed0, 03_train_estimator/ours/seed0\n" in stdout
    assert [path.name for path in (tmp_path / "runs/smoke").iterdir()] == ["04_train_policy"]
    stdout = extended("05_evaluate", "--weights", "published")
    assert "from runs/smoke: 04_train_policy/est/seed3\n" in stdout and "est/seed0" in stdout
    results = json.loads((tmp_path / "runs/smoke/05_evaluate/seed0/results.json").read_text())
    assert results["success_rate"]["est"]["seeds"]["count"] == 2


def test_an_ensemble_of_two_studies_is_left_out(study, call, monkeypatch):
    found = stacks.find_estimator

    def find(cfg, kind):
        if kind == "ensemble":
            raise runs.Mixed("seeds of two studies")
        return found(cfg, kind)

    monkeypatch.setattr(stacks, "find_estimator", find)
    stdout, _, code = call(study, "05_evaluate")
    assert code == 0 and "estimator ensemble (of other nets than these)\n" in stdout and "finished already" in stdout
