import errno
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from common import command, progress
from common.files import UserError
from common.runs import Run

ROOT = Path(__file__).parent.parent


@dataclass
class Config(command.Stage):
    rate: float = 1e-3
    widths: tuple[int, ...] = (8, 8)


SCRIPT = '''"""Trains nothing."""
from dataclasses import dataclass
from common import command, runs

@dataclass
class Config(command.Stage):
    rate: float = 1e-3
    """step size"""

def run(cfg):
    command.device_of(cfg)
    run = runs.Run(cfg, "07_x")
    print(cfg.preset, cfg.rate)

if __name__ == "__main__":
    command.main(Config, {"smoke": {"rate": 3.0}, "quick": {"rate": 2.0}, "paper": {}}, run, __doc__)
'''


@pytest.fixture
def script(tmp_path):
    (tmp_path / "07_x.py").write_text(SCRIPT)
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    return lambda *args: subprocess.run(
        [sys.executable, "07_x.py", *args], cwd=tmp_path, capture_output=True, text=True, env=env
    )


def test_a_wrong_command_line_is_one_line_and_exit_code_2(script):
    for args, words in [
        (["quik"], "unknown preset 'quik': say one of smoke|quick|paper"),
        (["--rat", "3"], "--rat"),
        (["paper", "--rate", "fast"], "--rate: could not convert string to float: 'fast'; see python 07_x.py paper --help"),
    ]:
        end = script(*args)
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
            command.main(Config, {"quick": {}}, run, "doc")
        line = capsys.readouterr().err
        assert end.value.code == code and line.count("\n") == 1 and line.startswith("error: ") and words in line
    with pytest.raises(FileNotFoundError):
        command.main(Config, {"quick": {}}, fails(FileNotFoundError(errno.ENOENT, "a bug")), "doc")


def test_help_shows_the_fields_and_the_preset_s_values(script):
    end = script("smoke", "--help")
    assert end.returncode == 0 and not end.stderr
    usage = "python 07_x.py [smoke|quick|paper]"
    for words in usage, "Trains nothing.", "--rate", "step size (default: 3.0)", "--max-minutes":
        assert words in end.stdout
    assert "--preset" not in end.stdout


def test_presets():
    parse = lambda *args: command.parse(Config, {"quick": {"rate": 2.0}, "paper": {}}, "doc", list(args))
    assert (parse().preset, parse().rate) == ("quick", 2.0)
    assert (parse("paper").preset, parse("paper").rate) == ("paper", 0.001)
    assert parse("paper", "--rate", "5", "--widths", "1", "2", "--max-minutes", "2").widths == (1, 2)
    for wrong in [["--seed", "-1"], ["--device", "tpu"], ["--rate"], ["--preset", "paper"], ["--seed", "1.5"],
                  ["--force", "yes"], ["--rate", "-0.1"], ["--rate", "nan"], ["--widths", "1", "0"]]:
        with pytest.raises(UserError, match=wrong[-1] if len(wrong) > 1 else "--rate"):
            parse(*wrong)


def test_device(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert command.device_of(Config()).type == "cpu"
    with pytest.raises(UserError, match="--device cuda"):
        command.device_of(Config(device="cuda"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert command.device_of(Config()) == torch.device("cuda", 0)  # with its number, which set_device needs
    assert command.device_of(Config(device="cpu")).type == "cpu"


def test_a_bar_writes_no_control_characters_to_a_log(monkeypatch, capsys):
    monkeypatch.setattr(progress.Lines, "last", -math.inf)
    assert list(progress.bar([1, 2, 3], "work")) == [1, 2, 3]
    with progress.bar(np.int64(5), "more", unit="step") as bar:
        for _ in range(5):
            bar.set_postfix(loss=1.0)
            bar.update()
    out = capsys.readouterr().err
    assert "\r" not in out and len(out.splitlines()) == 2 and "work" in out and "0/5" in out
