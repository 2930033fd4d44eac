"""The robot's natural runs beside the same policy in 05's world: the same starts and dynamics, the same share of occlusion.

    python tests/robot_gap.py [quick|laptop|paper] [--weights DIR] [--seed k] [--out root]

Reads the logs of `python 06_robot.py <preset> --scenario natural --runs n` and plays each start five times in the stack of
est_uncertainty, with occlusions of one duration that hide as large a share of the frames as the robot's did.
"""
import importlib
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
from common import command, episodes, film, networks, runs, stacks, statistics, tables, task, weights
from common.files import UserError
from common.progress import bar
from common.robot import hardware, runlog, safety

REPEATS = 5
robot = importlib.import_module("06_robot")


def main(cfg):
    folder = runs.run_folder(cfg.own, "06_robot", None, cfg.seed)
    logs = {k: log for k, log in runlog.read(folder, "natural").items() if statistics.counts(log)}
    if not logs:
        raise UserError(f"{folder}: no natural runs; run python 06_robot.py {cfg.preset} --scenario natural first")
    settings = runs.record_of(cfg, folder)["settings"]
    cfg = replace(cfg, **{name: settings[name] for name in ("passes", *vars(hardware.Gaps()))})
    paths = [runs.find(cfg, "03_train_estimator", "estimator.safetensors", "ours"),
             runs.find(cfg, "04_train_policy", "policy.safetensors", "est_uncertainty")]
    world, arm, starts = runs.world_of(cfg, paths), hardware.SimulatedArm(cfg), []
    for k in bar(logs, "starts", unit="run"):
        robot.prepare(safety.Guarded(arm), cfg, "natural", k, world)
        dynamics = {name: value[0] for name, value in arm.worlds.dynamics.items()}
        starts.append({"box": arm.box.copy(), "pusher": arm.points[-1, :2]} | dynamics)
    starts = {key: np.array([start[key] for start in starts]) for key in starts[0]}
    share = statistics.robot_runs({"natural": logs})["natural"]["occluded_share"]
    seconds = share / (1 - share) / world.occlusion_start / task.RATE
    estimator, policy = (weights.load(kind, path) for kind, path in zip((networks.Estimator, networks.Recurrent), paths))
    won, hidden, steps = [], 0, 0
    for seed in bar(REPEATS, "05's world", unit="repeat"):
        env = stacks.make(stacks.METHODS["est_uncertainty"], len(logs), estimator, cfg.passes, seconds, world=world)
        env = film.Recorded(env)
        env.reset = partial(env.reset, options=starts)
        success, length = episodes.play(env, policy, 2**47 + seed)
        won += success.tolist()
        hidden += sum(env.episode(i, n)["o"][:, 8].sum() for i, n in enumerate(length))
        steps += length.sum() + len(length)
    here = statistics.wilson([str(log["ended"]).startswith("success") for log in logs.values()])
    print(f"robot, natural:          {tables.percent(here)}, {len(logs)} runs, {share:.1%} of the frames occluded\n"
          f"05's world, same starts: {tables.percent(statistics.wilson(won))}, {len(won)} episodes, "
          f"{hidden / steps:.1%} occluded (occlusions of {seconds:.2f} s)")


if __name__ == "__main__":
    command.main(robot.Config, robot.PRESETS, main, __doc__)
