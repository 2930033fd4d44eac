import json
import math
import os
import sys
from dataclasses import dataclass

import pytest
import torch

from common import command, files, runs, weights
from common.files import UserError
from common.runs import Run, find


@dataclass
class Config(command.Stage):
    rate: float = 1e-3
    widths: tuple[int, ...] = (8, 8)


@pytest.fixture
def config(tmp_path):
    return lambda **kw: Config(preset="quick", out=tmp_path / "runs", **kw)


def make(cfg, stage, name, value, inputs={}, method=None):
    """A finished stage with one artifact."""
    run = Run(cfg, stage, inputs, method)
    weights.save_tensors(run.dir / name, {"w": torch.full((3,), float(value))}, value=value)
    run.finish([name])
    return run


def test_config_json_tells_what_was_done(config, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/home/me/01_a.py", "quick", "--out", "/home/me/runs", "--x=/home/me/y"])
    cfg = config()
    source = make(cfg, "01_a", "p.safetensors", 1)
    run = Run(cfg, "02_b", {"p": find(cfg, "01_a", "p.safetensors")}, method="ours")
    assert run.dir == tmp_path / "runs/quick/02_b/ours/seed0"
    assert not json.loads((run.dir / "config.json").read_text())["finished"]
    files.save_json(run.dir / "r.json", [])
    run.finish(["r.json"], success=0.5)
    text = (run.dir / "config.json").read_text()
    record = json.loads(text)
    assert record["finished"] and record["success"] == 0.5 and record["outputs"]["r.json"]["bytes"] == 3
    assert record["inputs"] == {"01_a/seed0/p.safetensors": source.record["outputs"]["p.safetensors"]["sha256"]}
    assert record["settings"] == {"seed": 0, "rate": 0.001, "widths": [8, 8]}
    assert record["command"] == "python 01_a.py quick --out runs --x=y"
    assert record["versions"]["torch"] and "/home" not in text and str(tmp_path) not in text


def test_a_finished_run_is_skipped_and_force_wipes_it(config, capsys):
    run = make(config(), "01_a", "p.safetensors", 1)
    again = Run(config(), "01_a")
    assert run.finished and again.finished and again.skip()
    assert capsys.readouterr().out.strip().endswith("01_a/seed0: finished already (--force redoes it)")
    forced = Run(config(force=True), "01_a")
    assert not forced.skip() and os.listdir(forced.dir) == ["config.json"]


def test_other_settings_are_an_error_that_names_them(config):
    make(config(), "01_a", "p.safetensors", 1)
    with pytest.raises(UserError, match=r"rate 0.001 -> 0.01.*--force, or another --out") as error:
        Run(config(rate=0.01), "01_a")
    assert "widths" not in str(error.value)
    Run(config(device="cpu", max_minutes=3), "01_a")
    assert not Run(config(rate=0.01, force=True), "01_a").finished


def test_settings_that_a_run_does_not_read_are_no_matter(config):
    assert Run(config(), "01_a", reads={"widths"}).record["settings"] == {"seed": 0, "widths": [8, 8]}
    Run(config(rate=0.01), "01_a", reads={"widths"})
    with pytest.raises(UserError, match=r"settings changed since it was begun \(widths \[8, 8\] -> \[9\]\): use --force"):
        Run(config(widths=(9,)), "01_a", reads={"widths"})


def test_resuming_drops_the_rows_after_the_resume_point(config):
    run = Run(config(), "01_a")
    assert run.load_resume() is None
    for step in range(3):
        run.log(step=step, loss=torch.tensor(1 / 3), note="x")
        if step == 1:
            run.save_resume({"step": step, "w": torch.ones(2), "rng": torch.get_rng_state()})
    again = Run(config(), "01_a")
    state = again.load_resume()
    assert state["step"] == 1 and torch.equal(state["w"], torch.ones(2))
    assert [row["step"] for row in again.rows()] == [0, 1]
    again.log(step=2, note="y", new=1)
    assert list(again.rows()[2]) == ["step", "loss", "note"]  # the first row's
    assert again.rows()[1] == {"step": 1, "loss": 0.333333, "note": "x"}
    assert math.isnan(again.rows()[2]["loss"]) and again.rows()[2]["note"] == "y"
    again.finish([])
    assert sorted(os.listdir(again.dir)) == ["config.json", "metrics.csv"]


def test_minutes_add_up_over_resumes(monkeypatch, config):
    run = Run(config(), "01_a")
    monkeypatch.setattr(runs, "_STARTED", run.began)
    run.began -= 120
    run.save_resume({})
    again = Run(config(max_minutes=1), "01_a")
    again.load_resume()
    assert not again.out_of_time()
    again.began -= 60
    monkeypatch.setattr(runs, "_STARTED", runs._STARTED - 60)
    assert again.out_of_time() and again.minutes() == pytest.approx(3, abs=0.1)


def test_without_a_resume_point_the_log_begins_anew(config):
    run = Run(config(), "01_a")
    run.log(a=1)
    Run(config(), "01_a").load_resume()
    assert run.rows() == []
    run.log(a=1)
    again = Run(config(), "01_a")
    again.log(a=2)
    assert again.rows() == [{"a": 2}]


@pytest.mark.parametrize("damage", [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: b"junk" * 9])
def test_a_damaged_resume_point_says_what_to_do(config, damage):
    run = Run(config(), "01_a")
    run.save_resume({"w": torch.ones(9)})
    path = run.dir / "resume.pt"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(UserError, match="resume.pt is damaged: delete it, or use --force"):
        run.load_resume()


# What earlier stages made


def test_seeds_come_in_order_and_from_the_first_root_that_has_them(tmp_path):
    for place in "a/01_x/m/seed10", "a/01_x/m/seed2", "b/01_x/m/seed2", "b/01_x/m/seed0", "b/01_x/m/seeds", "b/01_x/seed5":
        (tmp_path / place).mkdir(parents=True)
    a, b = tmp_path / "a", tmp_path / "b"
    assert list(runs.seeds([a, b], "01_x", "m").items()) == [
        (0, b / "01_x/m/seed0"), (2, a / "01_x/m/seed2"), (10, a / "01_x/m/seed10")]
    assert runs.seeds([a, b], "01_x") == {5: b / "01_x/seed5"} and runs.seeds([a], "02_y") == {}


def test_a_missing_or_unfinished_stage_is_named(config):
    with pytest.raises(UserError, match=r"03_c/ours/seed1/f.st is missing: run python 03_c.py quick --method ours --seed 1"):
        find(config(), "03_c", "f.st", method="ours", seed=1)
    Run(config(), "01_a")
    with pytest.raises(UserError, match=r"01_a/seed0/p.safetensors is unfinished: run python 01_a.py quick .*first"):
        find(config(), "01_a", "p.safetensors")


def test_a_damaged_artifact_names_its_stage(config):
    run = make(config(), "01_a", "p.safetensors", 1)
    path = find(config(), "01_a", "p.safetensors")
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    for damaged in data, data[:-1]:
        path.write_bytes(damaged)
        with pytest.raises(UserError, match="p.safetensors is missing or damaged: run python 01_a.py quick .*--force"):
            find(config(), "01_a", "p.safetensors")
    (run.dir / "config.json").write_text("{")
    with pytest.raises(UserError, match="config.json is damaged: run python 01_a.py quick"):
        find(config(), "01_a", "p.safetensors")


def test_a_changed_input_makes_every_later_stage_stale(config):
    cfg, redo = config(), config(force=True)
    a = {"p": make(cfg, "01_a", "p.safetensors", 1).dir / "p.safetensors"}
    b = {"q": make(cfg, "02_b", "q.safetensors", 1, a).dir / "q.safetensors"}
    make(cfg, "03_c", "r.safetensors", 1, b, method="ours")
    make(redo, "01_a", "p.safetensors", 1)
    assert find(cfg, "03_c", "r.safetensors", method="ours")
    make(redo, "01_a", "p.safetensors", 2)
    with pytest.raises(UserError, match="02_b/seed0: inputs changed .*01_a/seed0/p.safetensors.*--force"):
        Run(cfg, "02_b", a)
    for stage, name, method in ("02_b", "q.safetensors", None), ("03_c", "r.safetensors", "ours"):
        with pytest.raises(UserError, match="02_b/seed0 is stale, its input 01_a/seed0/p.* python 02_b.py quick .*--force"):
            find(cfg, stage, name, method)
    make(redo, "02_b", "q.safetensors", 2, a)
    words = "03_c/ours/seed0 is stale, its input 02_b/seed0/q.* python 03_c.py quick --method ours"
    with pytest.raises(UserError, match=words):
        find(cfg, "03_c", "r.safetensors", method="ours")
