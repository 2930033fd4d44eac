"""Two processes at one stage, started by torchrun as a user does: this file is also the script that they run."""
import os
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path
from shutil import copytree
from types import SimpleNamespace

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent.parent))
from common import command, muon, networks, ppo, ranks, speed, stacks, training  # noqa: E402
from conftest import ROOT, SCRIPTS, start  # noqa: E402

HP = import_module("01_train_privileged").Config(
    num_envs=12, rollout_steps=20, minibatch=10**6, epochs=1, sizes=(16, 16, 16), grad_norm=1e9, updates=10, eval_every=5,
    eval_episodes=4, tolerance=4.0, near_share=1.0, lr=1e-2)
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node"]


def torchrun(*words, count=2):
    return subprocess.Popen([*TORCHRUN, str(count), *map(str, words)], text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                            env=os.environ | {"OMP_NUM_THREADS": "1"})


def ends(process, code=0):
    """What a command printed, when it ends as told."""
    stdout, stderr = process.communicate(timeout=240)
    assert (process.returncode != 0) == (code != 0), stderr
    return stdout, stderr


# --- what the two processes run ------------------------------------------------------------------------------------------------

def rollout_of_both():
    """A rollout of HP.num_envs worlds, random but for its form, the same on every rank."""
    rng, shape = np.random.default_rng(0), (HP.rollout_steps, HP.num_envs)
    batch = {"obs": rng.normal(size=(*shape, 8)), "reward": rng.normal(size=shape)}
    batch |= {"logp": networks.log_softmax(torch.tensor(rng.normal(size=(*shape, 22))))}
    batch = {name: torch.as_tensor(x).float() for name, x in batch.items()}
    done = torch.tensor(rng.random(shape) < 0.1)
    return batch | {"done": done, "terminated": done, "actions": torch.tensor(rng.integers(0, 11, (*shape, 2)))} | {
        name: torch.tensor(rng.normal(size=shape)).float() for name in ("value", "next_value")}


def nets():
    torch.manual_seed(0)
    return networks.policy(8, HP.sizes), networks.value(8, HP.sizes)


def one_update(worlds):
    """What one mini-batch of plain descent, of these worlds of the rollout on this rank, makes of both nets."""
    batch = {name: x[:, worlds] for name, x in rollout_of_both().items()}
    pair = actor, critic = nets()
    batch |= {name: net.initial(len(worlds)) for name, net in zip(("hidden_pi", "hidden_v"), pair)}
    seq = ppo.sequences(batch, HP.gamma, HP.lam)
    stats = ppo.update(actor, critic, [torch.optim.SGD(net.parameters(), lr=1.0) for net in pair], seq, HP)
    return {"stats": stats, "nets": [net.state_dict() for net in pair]}


def regression(index):
    """The gradient of a mini-batch of trajectories of unlike length, these of them on this rank, and their mean loss."""
    torch.manual_seed(1)
    x, mask, net = torch.randn(9, 8, 3), torch.arange(9)[:, None].ge(torch.arange(8)).float(), torch.nn.Linear(3, 1)
    parameters = list(net.parameters())
    part = [z[:, index].contiguous() for z in (x, mask)]
    loss = lambda x, mask, generator: ((net(x)[..., 0] - 1).square() * mask).sum() / mask.sum()  # noqa: E731
    mean, steps = ranks.average(parameters, *speed.set_gradient(loss, [part], torch.Generator(), parameters))
    return {"loss": mean, "steps": float(steps), "gradient": [p.grad for p in parameters]}


def muon_steps():
    """A net after three steps by Muon, with gradients that both ranks have alike, and how often this rank made one orthogonal."""
    torch.manual_seed(0)
    net, calls, whole = networks.Estimator((16, 32, 48)), [], muon.orthogonal
    matrices = muon.optimizers(net, lr=0.01)[0]
    muon.orthogonal = lambda x: calls.append(x.shape) or whole(x)
    for _ in range(3):
        for p in net.parameters():
            p.grad = torch.randn(p.shape)
        matrices.step()
    muon.orthogonal = whole
    return {"net": net.state_dict(), "momentum": matrices.state_dict()["state"], "calls": len(calls)}


def ten_updates():
    """Both nets after training.train, with the loop's own worlds."""
    env, held_out = (stacks.make(stacks.METHODS["priv_on_state"], n) for n in training.shares(HP))
    actor, critic = nets()
    run = SimpleNamespace(load_resume=lambda: None, log=lambda **row: None, dir=Path("toy/seed0"), out_of_time=lambda: False)
    training.train(run, HP, env, held_out, actor, critic)
    return {"nets": [net.state_dict() for net in (actor, critic)], "worlds": (env.num_envs, held_out.num_envs)}


def measure(out):
    torch.cpu._is_avx512_bf16_supported = lambda: False  # float32
    ranks.begin(torch.device("cpu"))
    mine = range(ranks.RANK, 12, 2)
    torch.save({"update": one_update([*mine]), "regression": regression([*range(ranks.RANK, 8, 2)]), "trained": ten_updates(),
                "muon": muon_steps(),
                "spread": ranks.spread([*range(5)], lambda job: (job, ranks.RANK)), "shares": ranks.share(5)},
               f"{out}/{ranks.RANK}.pt")
    ranks.end()


def mortal(script, *args):
    """A stage of which rank 1 is killed in its fifth rollout."""
    calls, whole = iter(range(9)), ppo.rollout
    if ranks.RANK == 1:
        ppo.rollout = lambda *a: os.kill(os.getpid(), signal.SIGKILL) if next(calls) == 4 else whole(*a)
    play(script, *args)


def wounded(script, *args):
    """A stage of which rank 1 fails in one of its two nets, while the other's collectives wait."""
    if ranks.RANK == 1:
        ppo.policy_loss = lambda *a: 1 / 0
    play(script, *args)


def play(script, *args):
    stage, sys.argv = import_module(script), [script, *args]
    command.main(stage.Config, stage.PRESETS, stage.main, stage.__doc__)


# --- the tests -----------------------------------------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def of_both(tmp_path_factory):
    out = tmp_path_factory.mktemp("ranks")
    ends(torchrun(__file__, "measure", out))
    return [torch.load(out / f"{rank}.pt", weights_only=True) for rank in (0, 1)]


def test_an_update_of_two_is_that_of_one_on_the_joined_worlds(of_both, float32):
    alone = one_update([*range(12)])
    for rank in of_both:
        torch.testing.assert_close(rank["update"]["nets"], alone["nets"], rtol=1e-5, atol=1e-5)
        assert rank["update"]["stats"] == pytest.approx(alone["stats"], rel=1e-4)


def test_a_mini_batch_of_two_counts_every_step_the_same(of_both):
    alone = regression([*range(8)])
    for rank in of_both:
        torch.testing.assert_close(rank["regression"], alone, rtol=1e-5, atol=1e-5)


def test_muon_shares_its_matrices_out_and_steps_as_one_process_does(of_both, float32):
    alone = muon_steps()
    for rank, calls in zip(of_both, (3, 6)):  # the dearest of three matrices is rank 0's
        torch.testing.assert_close(rank["muon"]["net"], alone["net"], rtol=0, atol=0)
        torch.testing.assert_close(rank["muon"]["momentum"], alone["momentum"], rtol=0, atol=0)
        assert rank["muon"]["calls"] == calls
    assert alone["calls"] == 9


def test_the_nets_of_both_are_equal_after_ten_updates(of_both):
    first, second = (rank["trained"] for rank in of_both)
    torch.testing.assert_close(first["nets"], second["nets"], rtol=0, atol=0)
    assert first["worlds"] == second["worlds"] == (6, 2)
    with pytest.raises(AssertionError):
        torch.testing.assert_close(first["nets"], [net.state_dict() for net in nets()])  # they have learned


def test_jobs_are_shared_out_and_joined_in_order(of_both):
    assert [rank["spread"] for rank in of_both] == [[(0, 0), (1, 1), (2, 0), (3, 1), (4, 0)], []]
    assert [rank["shares"] for rank in of_both] == [3, 2]


def wait_for(path, process, seconds=60):
    begin = time.monotonic()
    while not path.exists():
        assert time.monotonic() < begin + seconds and process.poll() is None, process.communicate()
        time.sleep(0.01)


def trained(out, *words):
    return torchrun(ROOT / "01_train_privileged.py", "smoke", "--out", out, "--updates", 16, *words)


def test_killed_all_or_one_they_go_on_and_end_bit_for_bit_as_uninterrupted(tmp_path):
    here = Path("smoke/01_train_privileged/seed0")
    ends(trained(tmp_path / "whole"))
    process = trained(tmp_path / "killed")
    wait_for(tmp_path / "killed" / here / "resume.pt", process)
    workers = subprocess.run(["pgrep", "-P", str(process.pid)], text=True, capture_output=True).stdout.split()
    for pid in map(int, [process.pid, *workers]):
        os.kill(pid, signal.SIGKILL)
    process.communicate()
    assert len(workers) == 2 and not (tmp_path / "killed" / here / "policy.safetensors").exists()
    begin = time.monotonic()
    stderr = ends(torchrun(__file__, "mortal", "01_train_privileged", "smoke", "--out", tmp_path / "killed", "--updates", 16), 1)[1]
    assert time.monotonic() - begin < 60 and "Signal 9" in stderr
    stderr = ends(start(tmp_path / "killed", SCRIPTS[0], "--updates", "16"), 2)[1]
    assert "was begun with 2 processes, not 1: start as many, or use --force" in stderr
    ends(trained(tmp_path / "killed"))
    whole, killed = (tmp_path / name / here / "policy.safetensors" for name in ("whole", "killed"))
    assert whole.read_bytes() == killed.read_bytes()


def test_a_failure_in_one_net_of_one_rank_ends_all_and_is_told(tmp_path):
    begin = time.monotonic()
    stderr = ends(torchrun(__file__, "wounded", "01_train_privileged", "smoke", "--out", tmp_path / "runs"), 1)[1]
    assert time.monotonic() - begin < 60 and "ZeroDivisionError" in stderr


@pytest.mark.parametrize("words, told", [
    (["01_train_privileged", "--num-envs", 1], "2 processes share 1 worlds"),
    (["03_train_estimator"], "train_states.npy is missing"),
    (["06_robot"], "one arm, one process"),
])
def test_bad_use_is_one_line_from_rank_0(tmp_path, words, told):
    script, *words = words
    stderr = ends(torchrun(ROOT / f"{script}.py", "smoke", "--out", tmp_path / "runs", *words), 2)[1]
    lines = [line for line in stderr.splitlines() if line.startswith("error:")]
    assert len(lines) == 1 and told in lines[0] and stderr.count("Traceback") == 1  # torchrun's own


def test_a_study_of_two_processes(study, tmp_path):
    """02 and 05 give the bits of one process, from the same nets; 03 and 04 go through between them."""
    out, again = tmp_path / "runs", tmp_path / "again"
    copytree(study / "smoke" / "01_train_privileged", out / "smoke" / "01_train_privileged")
    for script, *method in [SCRIPTS[1]], [SCRIPTS[2], "--method", "ours"], [SCRIPTS[3], "--method", "est"], [
            SCRIPTS[3], "--method", "behavior_cloning"]:
        ends(torchrun(ROOT / f"{script}.py", "smoke", "--out", out, *method))
    for path in (study / "smoke" / "02_collect" / "seed0").glob("*.npy"):
        assert path.read_bytes() == (out / path.relative_to(study)).read_bytes()
    copytree(study, again, ignore=lambda folder, names: [name for name in names if name.startswith(("05", "06"))])
    ends(torchrun(ROOT / "05_evaluate.py", "smoke", "--out", again))
    names = "smoke/05_evaluate/seed0/results.json", "smoke/05_evaluate/seed0/tables.md"
    assert all((study / name).read_text() == (again / name).read_text() for name in names)


if __name__ == "__main__":
    {"measure": measure, "mortal": mortal, "wounded": wounded}[sys.argv[1]](*sys.argv[2:])
