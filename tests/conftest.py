import csv
import fcntl
import importlib
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from tyro.conf import OmitArgPrefixes

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
from six_joints import SIX  # noqa: E402

from common import command, networks, runs, speed, weights  # noqa: E402
from common.robot import controller  # noqa: E402
from common.robot.iiwa import IIWA  # noqa: E402
from common.task import World  # noqa: E402

speed.set_up()
SHORT = World(time_limit=11.0)  # of the robot's runs: a hand that covers the tags for 5 s has left before
SCRIPTS = ["01_train_privileged", "02_collect", "03_train_estimator", "04_train_policy", "05_evaluate", "06_robot"]


def pytest_collection_modifyitems(items):
    """The files that take longest come first, so that no worker waits for the other at the end; the first makes the study."""
    slow = ["test_methods.py", "test_ranks.py", "test_stages.py", "test_robot_runs.py"]
    items.sort(key=lambda item: slow.index(item.path.name) if item.path.name in slow else len(slow))


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


@pytest.fixture(params=[IIWA, SIX], ids=["iiwa", "six joints"])
def model(request):
    return request.param


@dataclass
class Worldly(command.Stage):
    world: OmitArgPrefixes[World] = World()


@pytest.fixture(scope="module")
def nets(tmp_path_factory):
    """A root with an untrained estimator and policy, as stages 03 and 04 leave them."""
    torch.manual_seed(2)  # some untrained nets drive the box to where its film cannot be tracked anew
    out = tmp_path_factory.mktemp("robot") / "runs"
    cfg = Worldly(preset="smoke", out=out, world=SHORT)
    for stage, method, name, net in (
            ("03_train_estimator", "ours", "estimator.safetensors", networks.Estimator((16, 16, 16))),
            ("04_train_policy", "est_uncertainty", "policy.safetensors", networks.policy(12, (16, 16, 16)))):
        run = runs.Run(cfg, stage, {}, method)
        weights.save(run.dir / name, net)
        run.finish([name])
    return out


@pytest.fixture
def robot(nets, call):
    """Runs 06 in this process; returns stdout, stderr, the exit code and the run's folder."""
    def of(*args, seed=None):
        done = nets / "smoke" / "06_robot"
        seed = str(1000 + len([*done.glob("*")]) if seed is None else seed)  # unused, whatever ran before
        return *call(nets, "06_robot", "--seed", seed, *args), done / f"seed{seed}"
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


@pytest.fixture
def nobody(monkeypatch):
    """At the terminal: who places the box has done so."""
    monkeypatch.setattr("builtins.input", lambda words: None)


@pytest.fixture
def patient(monkeypatch):
    """On a busy machine a target may be late."""
    monkeypatch.setattr(controller, "SILENCE", 1.0)
