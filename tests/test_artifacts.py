import errno
import json
import math
import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from common import artifacts
from common.artifacts import Run, UserError, find

ROOT = Path(__file__).parent.parent


@dataclass
class Config(artifacts.Stage):
    rate: float = 1e-3
    widths: tuple[int, ...] = (8, 8)


@pytest.fixture
def config(tmp_path):
    return lambda **kw: Config(preset="quick", out=tmp_path / "runs", **kw)


def make(cfg, stage, name, value, inputs={}, method=None):
    """A finished stage with one artifact."""
    run = Run(cfg, stage, inputs, method)
    artifacts.save_tensors(run.dir / name, {"w": torch.full((3,), float(value))}, value=value)
    run.finish([name])
    return run


# Files


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.json"
    artifacts.save_json(path, {"a": torch.tensor([1.0]), "b": Path("x")})

    def breaks(temporary):
        assert temporary.parent == tmp_path and temporary.suffix == ".json"
        temporary.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        artifacts.write_atomic(path, breaks)
    assert json.loads(path.read_text()) == {"a": [1.0], "b": "x"}
    assert os.listdir(tmp_path) == ["a.json"]


def test_tensors_and_their_meta_come_back(tmp_path):
    net, path = torch.nn.Linear(2, 3), tmp_path / "net.safetensors"
    artifacts.save_tensors(path, net.state_dict(), method="ours", widths=[1, 2])
    tensors, meta = artifacts.load_tensors(path)
    assert meta == {"method": "ours", "widths": [1, 2]}
    assert torch.equal(tensors["weight"], net.weight)
    artifacts.save_tensors(path, {"turned": torch.arange(6).view(2, 3).T})
    assert artifacts.load_tensors(path)[0]["turned"].tolist() == [[0, 3], [1, 4], [2, 5]]


@pytest.mark.parametrize("cut", [0, 5, 100])
def test_damaged_tensors_name_the_file(tmp_path, cut):
    path = tmp_path / "03_train_estimator" / "net.safetensors"
    artifacts.save_tensors(path, {"w": torch.zeros(100)})
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(UserError, match="03_train_estimator/net.safetensors is missing or damaged"):
        artifacts.load_tensors(path)


# Run folders


def test_config_json_tells_what_was_done(config, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/home/me/01_a.py", "quick", "--out", "/home/me/runs", "--x=/home/me/y"])
    cfg = config()
    source = make(cfg, "01_a", "p.safetensors", 1)
    run = Run(cfg, "02_b", {"p": find(cfg, "01_a", "p.safetensors")}, method="ours")
    assert run.dir == tmp_path / "runs/quick/02_b/ours/seed0"
    assert not json.loads((run.dir / "config.json").read_text())["finished"]
    artifacts.save_json(run.dir / "r.json", [])
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
    again.log(step=2, note="y")
    assert again.rows()[1] == {"step": 1, "loss": 0.333333, "note": "x"}
    assert math.isnan(again.rows()[2]["loss"]) and again.rows()[2]["note"] == "y"
    again.finish([])
    assert sorted(os.listdir(again.dir)) == ["config.json", "metrics.csv"]


def test_minutes_add_up_over_resumes(monkeypatch, config):
    run = Run(config(), "01_a")
    monkeypatch.setattr(artifacts, "_STARTED", run.began)
    run.began -= 120
    run.save_resume({})
    again = Run(config(max_minutes=1), "01_a")
    again.load_resume()
    assert not again.out_of_time()
    again.began -= 60
    monkeypatch.setattr(artifacts, "_STARTED", artifacts._STARTED - 60)
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


# Command line

SCRIPT = '''"""Trains nothing."""
from dataclasses import dataclass
from common import artifacts

@dataclass
class Config(artifacts.Stage):
    rate: float = 1e-3
    """step size"""

def run(cfg):
    artifacts.device_of(cfg)
    run = artifacts.Run(cfg, "07_x")
    print(cfg.preset, cfg.rate)

if __name__ == "__main__":
    artifacts.main(Config, {"smoke": {"rate": 3.0}, "quick": {"rate": 2.0}, "paper": {}}, run, __doc__)
'''


@pytest.fixture
def command(tmp_path):
    (tmp_path / "07_x.py").write_text(SCRIPT)
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    return lambda *args: subprocess.run(
        [sys.executable, "07_x.py", *args], cwd=tmp_path, capture_output=True, text=True, env=env
    )


def test_a_wrong_command_line_is_one_line_and_exit_code_2(command):
    for args, words in [
        (["quik"], "unknown preset 'quik': say one of smoke|quick|paper"),
        (["--rat", "3"], "--rat"),
        (["paper", "--rate", "fast"], "--rate: could not convert string to float: 'fast'; see python 07_x.py paper --help"),
    ]:
        end = command(*args)
        assert end.returncode == 2, end.stderr
        assert end.stderr.count("\n") == 1 and end.stderr.startswith("error: ") and words in end.stderr, end.stderr


def test_what_stops_a_stage_is_one_line(monkeypatch, capsys, tmp_path):
    (tmp_path / "file").touch()

    def begin(cfg):
        Run(cfg, "07_x")

    def fails(error):
        def run(cfg):
            raise error

        return run

    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(sys, "argv", ["07_x.py", "--out", str(tmp_path / "file")])
    for run, code, words in [
        (begin, 2, "Not a directory"),
        (fails(full), 2, "No space"),
        (fails(KeyboardInterrupt), 130, "goes on"),
    ]:
        with pytest.raises(SystemExit) as end:
            artifacts.main(Config, {"quick": {}}, run, "doc")
        line = capsys.readouterr().err
        assert end.value.code == code and line.count("\n") == 1 and line.startswith("error: ") and words in line
    with pytest.raises(FileNotFoundError):
        artifacts.main(Config, {"quick": {}}, fails(FileNotFoundError(errno.ENOENT, "a bug")), "doc")


def test_help_shows_the_fields_and_the_preset_s_values(command):
    end = command("smoke", "--help")
    assert end.returncode == 0 and not end.stderr
    usage = "python 07_x.py [smoke|quick|paper]"
    for words in usage, "Trains nothing.", "--rate", "step size (default: 3.0)", "--max-minutes":
        assert words in end.stdout
    assert "--preset" not in end.stdout


def test_presets():
    parse = lambda *args: artifacts.parse(Config, {"quick": {"rate": 2.0}, "paper": {}}, "doc", list(args))
    assert (parse().preset, parse().rate) == ("quick", 2.0)
    assert (parse("paper").preset, parse("paper").rate) == ("paper", 0.001)
    assert parse("paper", "--rate", "5", "--widths", "1", "2", "--max-minutes", "2").widths == (1, 2)
    for wrong in [["--seed", "-1"], ["--device", "tpu"], ["--rate"], ["--preset", "paper"], ["--seed", "1.5"],
                  ["--force", "yes"], ["--rate", "-0.1"], ["--rate", "nan"], ["--widths", "1", "0"]]:
        with pytest.raises(UserError, match=wrong[-1] if len(wrong) > 1 else "--rate"):
            parse(*wrong)


def test_device(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert artifacts.device_of(Config()).type == "cpu"
    with pytest.raises(UserError, match="--device cuda"):
        artifacts.device_of(Config(device="cuda"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert artifacts.device_of(Config()).type == "cuda"
    assert artifacts.device_of(Config(device="cpu")).type == "cpu"


def test_a_bar_writes_no_control_characters_to_a_log(monkeypatch, capsys):
    monkeypatch.setattr(artifacts.Lines, "last", -math.inf)
    assert list(artifacts.bar([1, 2, 3], "work")) == [1, 2, 3]
    with artifacts.bar(np.int64(5), "more", unit="step") as bar:
        for _ in range(5):
            bar.set_postfix(loss=1.0)
            bar.update()
    out = capsys.readouterr().err
    assert "\r" not in out and len(out.splitlines()) == 2 and "work" in out and "0/5" in out


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library keeps memory in its own way")
def test_freed_memory_is_kept():
    code = """if True:
        import resource, torch
        from common import artifacts

        def faults():
            before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
            torch.ones(2**24)  # 64 MiB: 16,384 pages
            return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

        artifacts.keep_memory()
        print([faults() for _ in range(5)][-1])
    """
    told = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert not told.stderr and int(told.stdout) < 100, told.stdout + told.stderr
