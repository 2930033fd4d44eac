"""The numbered scripts, in the smoke preset: stopped, killed and resumed."""
import signal
import time

import pytest
from conftest import SCRIPTS, metrics, run, saved, start


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
