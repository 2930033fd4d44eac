"""Stage 06: its runs, what is kept of them, and what a real arm's helper is told."""
import importlib
import json
import sys

import cv2
import numpy as np
import pytest
import torch
from conftest import SHORT
from robot_arms import mistakes

from common import networks, stacks, symmetry, task
from common.robot import controller, scene, tags
from common.robot.iiwa import IIWA


def test_a_box_that_is_never_seen_ends_the_run_with_one_line(robot, monkeypatch):
    module = importlib.import_module("06_robot")
    prepare = module.prepare

    def hidden(arm, *args):
        prepare(arm, *args)
        arm.simulated.hand = (0.0, np.inf)
        arm.simulated.past.clear(), arm.simulated.remember()
        return arm.simulated.hand

    monkeypatch.setattr(module, "prepare", hidden)
    stdout, _, code, folder = robot("--scenario", "natural")
    assert code == 0 and "natural_000: box not seen for 5 s" in stdout
    assert np.load(folder / "natural_000.npz")["ended"] == "box not seen for 5 s"
    summary = json.loads((folder / "summary.json").read_text())["natural"]
    assert summary["tick_p99_ms"] is None and summary["runs"] == 0 and summary["not_begun"] == 1 and "1 not begun" in stdout


def test_leaving_the_workspace_ends_a_run_and_the_next_begins(robot, monkeypatch):
    monkeypatch.setattr(networks, "mode", lambda logits: torch.tensor([[10, 10]]))
    monkeypatch.setattr(symmetry, "mirror_action", lambda action, sign: action)
    _, _, code, folder = robot("--scenario", "natural", "--runs", "2")
    logs = [np.load(folder / f"natural_{k:03d}.npz") for k in range(2)]
    assert code == 0 and all(log["ended"] == "out of the workspace" for log in logs)
    assert not json.loads((folder / "summary.json").read_text())["natural"]["stops"]


def test_a_run_is_logged_and_filmed_and_its_film_shows_the_same(robot):
    stdout, _, code, folder = robot("--scenario", "hand_5s", "--video", seed=3)
    assert code == 0 and "hand_5s" in stdout
    log = np.load(folder / "hand_5s_000.npz")
    ticks = len(log["time"])
    assert {"time", "joints", "true", "seen", "estimated", "sigma", "force", "action", "unsolved", "busy", "age"} <= set(log)
    assert np.allclose(np.diff(log["time"]), 1 / task.RATE) and np.isfinite(log["sigma"]).all() and not log["unsolved"].any()
    assert log["joints"].shape == (ticks, 7) and log["true"].shape == log["seen"].shape == (ticks, 3)
    summary = json.loads((folder / "summary.json").read_text())["hand_5s"]
    assert summary.keys() >= {"successes", "runs", "low", "high", "occluded_share", "tick_p99_ms", "stops"}
    assert np.isclose(summary["occluded_share"], (log["age"] > 0).mean())
    covered = np.flatnonzero(log["covered"])
    assert not covered.size or task.RATE <= covered[0] <= 5 * task.RATE + 1 and len(covered) in (75, ticks - covered[0])
    seen = log["age"] == 0
    assert np.linalg.norm((log["seen"] - log["true"])[seen, :2], axis=1).max() < 0.012  # latency and hand-eye error

    film, tracker, misses = cv2.VideoCapture(str(folder / "hand_5s_000_camera.mp4")), tags.Tracker(), []
    for tick in range(ticks):
        joints = log["joints"][max(tick - 1, 0)]
        sight = tracker.update(film.read()[1], scene.wrist_camera(IIWA, joints))
        if log["age"][tick] == 0 and sight.age == 0 and tick:
            misses.append(np.linalg.norm(sight.seen[:2] - log["seen"][tick, :2]))
    assert np.median(misses) < 1e-3 and not film.read()[0]


def test_what_is_stopped_before_a_run_is_no_failure_of_it(robot, monkeypatch):
    module = importlib.import_module("06_robot")
    prepare = module.prepare
    monkeypatch.setattr(module, "prepare", lambda arm, *args: (prepare(arm, *args), arm.halt("a reason"))[0])
    _, stderr, code, folder = robot("--scenario", "natural")
    assert code == 2 and mistakes(stderr) == ["error: arm stopped: a reason"] and not list(folder.glob("*.npz"))


def test_force_deletes_no_other_scenario(robot):
    folder = robot("--scenario", "natural", seed=23)[3]
    _, stderr, code, _ = robot("--scenario", "hand_5s", "--force", seed=23)
    assert code == 2 and "--scenario all" in mistakes(stderr)[0] and (folder / "natural_000.npz").exists()


def test_the_video_of_a_finished_run_is_said_to_do_nothing(robot):
    assert "--video" not in robot("--scenario", "natural", seed=24)[0]
    stdout, _, code, folder = robot("--scenario", "natural", "--video", seed=24)
    assert code == 0 and "--video: does nothing for 1 finished runs" in stdout and not list(folder.glob("*.mp4"))


@pytest.mark.parametrize("words", [("--arm", "six_joints:SixJoints"), ("--latency", "2"), ("--think", "0")])
def test_another_arm_or_gap_needs_another_seed(robot, words):
    folder = robot("--scenario", "natural", seed=25)[3]
    _, stderr, code, _ = robot("--scenario", "natural", *words, seed=25)
    assert code == 2 and words[0][2:] in stderr and "or another --seed" in mistakes(stderr)[0]
    assert len(list(folder.glob("*.npz"))) == 1


def test_a_damaged_log_is_named(robot):
    folder = robot("--scenario", "natural", seed=22)[3]
    (folder / "natural_000.npz").write_bytes(b"")
    _, stderr, code, _ = robot("--scenario", "natural", seed=22)
    assert code == 2 and len(mistakes(stderr)) == 1 and "natural_000.npz is damaged: delete it" in stderr


@pytest.mark.parametrize("args, words", [(("--latency", "inf"), "finite"), (("--arm", "json:loads"), "TypeError"),
                                         (("--camera", "0"), "has its own"), (("--think", "0.07"), "below 1/15"),
                                         (("--arm", "builtins:str"), "no model, read_joints"),
                                         (("--arm", "nothing:Arm"), "module:Class"), (("--arm", "nothing"), "module:Class"),
                                         (("--runs", "0"), "at least 1")])
def test_mistakes_are_one_line(robot, args, words):
    _, stderr, code, _ = robot(*args)
    assert code == 2 and len(mistakes(stderr)) == 1 and words in stderr and "Traceback" not in stderr


def test_the_tags_can_be_printed_before_anything_is_trained(robot, nets):
    stdout, _, code, _ = robot("--print-tags")
    assert code == 0 and (nets / "tags.pdf").stat().st_size > 2_000


def test_the_same_seed_plays_the_same_run(robot):
    folder = robot("--scenario", "natural", seed=11)[3]
    first = dict(np.load(folder / "natural_000.npz"))
    robot("--scenario", "natural", "--force", seed=11)
    again = np.load(folder / "natural_000.npz")
    assert all((first[key] == again[key]).all() for key in ("joints", "true", "seen", "action"))


@pytest.fixture
def at_once(monkeypatch):
    """A real arm is driven without a thread, as fast as it goes."""
    make = controller.Controller
    monkeypatch.setattr(controller, "Controller", lambda arm, threaded, think: make(arm, False))


def test_a_real_arm_is_judged_by_the_estimate(robot, monkeypatch, at_once):
    asked = []
    monkeypatch.setattr("builtins.input", asked.append)
    monkeypatch.setattr(task, "reached", lambda box: True)
    stdout, _, code, folder = robot("--arm", "robot_arms:Driver", "--scenario", "hand_5s", "--video")
    log = np.load(folder / "hand_5s_000.npz")
    assert len(log["time"]) == 5 and log["ended"] == "success by estimate" and np.isnan(log["true"]).all()
    assert len(asked) == 1 and "1/1 by estimate" in stdout and (folder / "robot.png").exists()


def test_a_real_arms_helper_is_told_when_to_cover_the_tags(robot, monkeypatch, at_once):
    monkeypatch.setattr("builtins.input", lambda words: None)
    monkeypatch.setattr(task, "outside", lambda box, pusher: False)
    monkeypatch.setattr(networks, "mode", lambda logits: torch.full((1, 2), 5))
    stdout, _, _, folder = robot("--arm", "robot_arms:Driver", "--scenario", "hand_5s")
    assert stdout.index("now cover the tags") < stdout.index("now uncover the tags")
    assert len(np.load(folder / "hand_5s_000.npz")["time"]) == SHORT.horizon


def test_a_real_arm_needs_someone_at_the_terminal(robot, monkeypatch):
    monkeypatch.setattr(sys, "stdin", open("/dev/null"))
    _, stderr, code, _ = robot("--arm", "robot_arms:Driver")
    assert code == 2 and len(mistakes(stderr)) == 1 and "terminal" in stderr


@pytest.mark.parametrize("corner", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_the_program_thinks_as_the_training_stack_does(corner, float32):
    """The same observations, estimates and actions as Mirrored, Believed and the policy."""
    torch.manual_seed(1)
    f, pi = networks.Estimator((16, 16, 16), dropout=0.0).requires_grad_(False), networks.policy(12, (16, 16, 16))
    torch.nn.init.normal_(pi.head[-1].weight)
    env, think = stacks.make(stacks.METHODS["est_uncertainty"], 1, f, 1), importlib.import_module("06_robot").think
    start = {"box": [0.1 * corner[0], 0.04 * corner[1], 0.5], "pusher": [0.1 * corner[0], -0.08 * corner[1]]}
    obs, infos = env.reset(seed=0, options=start)
    memory = recall = None
    for _ in range(20):
        o = infos["o"][0]
        row = {"seen": task.unscale_pose(o[:4]), "age": o[8], "pusher": o[4:6] * task.HALF,
               "force": o[6:8] * task.World.max_force}
        s_hat, action, memory = think(f, pi, 1, row, memory)
        assert np.allclose(s_hat, symmetry.mirror(infos["belief"], env.env.sign)[0], atol=1e-4)
        with torch.no_grad():
            logits, recall = pi(torch.as_tensor(obs)[None], recall)
        mirrored = networks.mode(logits[0]).numpy()
        assert (symmetry.mirror_action(mirrored, env.env.sign)[0] == action).all()
        obs, _, _, _, infos = env.step(mirrored)


def test_a_mistake_does_not_keep_the_right_command_from_starting(robot):
    assert robot("--camera", "0", "--scenario", "natural", seed=21)[2] == 2
    assert robot("--scenario", "natural", seed=21)[2] == 0
    stdout, _, code, folder = robot("--scenario", "hand_full", "--runs", "2", seed=21)
    assert code == 0 and {path.stem for path in folder.glob("*.npz")} == {"natural_000", "hand_full_000", "hand_full_001"}


def test_an_arm_of_six_joints_plays_a_run(robot):
    _, _, code, folder = robot("--arm", "six_joints:SixJoints", "--scenario", "natural")
    log = np.load(folder / "natural_000.npz")
    assert code == 0 and log["joints"].shape[1] == 6 and not log["unsolved"].any() and log["ended"] != "stopped"
