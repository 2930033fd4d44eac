import fcntl
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
from common import speed  # noqa: E402

speed.set_up()
SCRIPTS = ["01_train_privileged", "02_collect", "03_train_estimator", "04_train_policy", "05_evaluate", "06_robot"]


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture
def float32(monkeypatch):
    """No bfloat16 autocast, where the machine has it."""
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)


def start(out, script, *args):
    command = [sys.executable, ROOT / f"{script}.py", "smoke", "--out", out, "--device", "cpu", *args]
    return subprocess.Popen(command, cwd=out.parent, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def run(out, script, *args):
    """Runs a script to its end; returns what it printed."""
    process = start(out, script, *args)
    stdout, stderr = process.communicate()
    assert process.returncode == 0, stderr
    return stdout


@pytest.fixture(scope="session")
def study(tmp_path_factory, worker_id):
    """The root of a whole smoke study, made once for all of pytest's workers. Not to be changed."""
    base = tmp_path_factory.getbasetemp()
    shared = base if worker_id == "master" else base.parent
    out = shared / "study" / "runs"
    out.parent.mkdir(exist_ok=True)
    with open(shared / "study.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (shared / "study.done").exists():
            for script in SCRIPTS:
                run(out, script)
            (shared / "study.done").touch()
    return out
