"""The robot's guard under random faults (robot_fuzz.py), and that its oracle sees what the guard lets through."""
import numpy as np
import pytest
import robot_fuzz
from six_joints import SIX

from common.robot import safety
from common.robot.iiwa import IIWA


@pytest.fixture(autouse=True)
def quiet():
    with np.errstate(all="ignore"):  # forces of 1e300 N
        yield


@pytest.mark.parametrize("model, ticks", [(IIWA, 8_000), (SIX, 2_000)], ids=["iiwa", "six joints"])
def test_no_fault_moves_the_arm_unsafely(model, ticks):
    result = robot_fuzz.fuzz(ticks, model=model)
    assert not result.unsafe and not result.escaped
    assert result.faulty > ticks / 20 and len(result.reasons) > 15


@pytest.mark.parametrize("gone", ["read_joints", "read_wrench", "grab", "command", "lock"])
def test_without_a_part_of_the_guard_the_oracle_finds_unsafe_commands(monkeypatch, gone):
    if gone == "lock":
        monkeypatch.setattr(safety.Guarded, "check", lambda guard: None)
    else:
        method = getattr(safety.Guarded, gone)

        def blind(guard, *args):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(guard, "require", lambda good, reason: None, raising=False)
                return method(guard, *args)

        monkeypatch.setattr(safety.Guarded, gone, blind)
    assert robot_fuzz.fuzz(1_000, seed=1).unsafe
