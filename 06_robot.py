"""Stage 06: the policy on an arm with a camera, under natural and human-induced occlusions (sec. 6).

    python 06_robot.py [pretrained|smoke|quick|laptop|paper] [--weights DIR] [--scenario natural|hand_5s|hand_full|all] [--runs n]
        [--video] [--seed k] [--realtime] [--view [port]] [--think s] [--arm module:Class] [--camera source] [--print-tags]

Reads est_uncertainty (04) and the estimator ours (03), of the same preset or in the folder --weights. Writes to
runs/<preset>/06_robot/seed<k>/: summary.json, robot.png, a log <scenario>_<run>.npz a run and, with --video, two mp4 a run:
the three views, and the camera alone. A rerun goes on with the next run. --print-tags only writes <out>/tags.pdf.
"""
import contextlib
import importlib
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import cv2
import numpy as np
import torch

from common import belief, command, networks, observation, plots, ranks, runs, speed, statistics, symmetry, tables
from common import task, weights
from common.env import PushVectorEnv
from common.files import UserError, claim, save_json, write_atomic
from common.progress import bar
from common.robot import controller, hardware, page, runlog, safety, scene, tags, views
from common.task import World

SCENARIOS = ("natural", "hand_5s", "hand_full")
PATIENCE = 5 * task.RATE  # ticks to wait for the first sight
CERTAIN = 5  # ticks that the estimate must stay in the tolerance, where nobody knows the truth


@dataclass
class Config(hardware.Gaps, command.Reader):
    scenario: Literal["natural", "hand_5s", "hand_full", "all"] = "all"  # plus a hand over the tags for 5 s, or to the end
    runs: int = 20  # runs of each scenario (the paper: 20, 10, 10)
    passes: int = 50  # M, stochastic passes of the estimator (sec. 4)
    video: bool = False  # write the views and the camera's images of every run as mp4
    realtime: bool = False  # let the simulated arm move in real time and in a thread of its own, as a real one does
    think: float = command.setting(0.03, before=0.0)  # s that the simulated clock runs on while the program thinks; below 1/15
    arm: str = "simulated"  # module:Class of a real one, with the methods of hardware.Arm; it is given this config
    camera: str = ""  # device number or address of a camera that OpenCV opens, instead of a real arm's own
    view: tuple[int, ...] | None = None  # show the runs at http://127.0.0.1:8006, or another port; to join in, with --realtime
    print_tags: bool = False  # write the sheet of tags for the box, and nothing else
    free: ClassVar = (*command.Reader.free, "scenario", "runs", "video", "realtime", "view", "print_tags")


PRESETS = {
    "pretrained": dict(weights=Path(__file__).parent / "pretrained", runs=10),
    "smoke": dict(runs=1, passes=2),
    "quick": dict(runs=1),
    "laptop": dict(runs=100),
    "paper": {},
}


def connect(cfg):
    """The arm behind its guard; UserError where there is no such class, or a setting is not within its limits."""
    for name, most in (*((name, np.inf) for name in vars(hardware.Gaps())), ("think", 1 / task.RATE)):
        if not getattr(cfg, name) < most:
            raise UserError(f"--{name} {getattr(cfg, name)}: {'finite' if most == np.inf else 'below 1/15 s'}")
    module, _, name = cfg.arm.partition(":")
    try:  # whatever goes wrong in somebody's class
        make = hardware.SimulatedArm if cfg.arm == "simulated" else getattr(importlib.import_module(module), name)
        arm = safety.Guarded(make(cfg))
    except Exception as error:
        raise UserError(f"--arm {cfg.arm}: {type(error).__name__}: {error}; say simulated, or module:Class") from None
    if cfg.camera and arm.simulated:
        raise UserError(f"--camera {cfg.camera}: the simulated arm has its own")
    return arm


def prepare(arm, cfg, scenario, k, world=World()):
    """Box and look-pose of run k of a scenario, of a safety.Guarded. Returns from when to when a hand covers the tags, in s."""
    rng = np.random.default_rng([cfg.seed, SCENARIOS.index(scenario), k, 4])
    torch.manual_seed(int(rng.integers(2**62)))  # of the dropout masks
    start = rng.uniform(1, 5)
    hand = {"natural": (np.inf, np.inf), "hand_5s": (start, start + 5), "hand_full": (start, np.inf)}[scenario]
    if not arm.simulated:
        arm.waiting = True
        try:
            input(f"{scenario}, run {k + 1}: place the box, bring the pusher to where the camera sees it, and press Enter ")
        except EOFError:
            raise UserError("a real arm needs someone at the terminal, to place the box") from None
        finally:
            arm.waiting = False
        return hand
    env = PushVectorEnv(1, world=world)
    while True:  # a start of the study from which the camera sees the box
        env.reset(seed=int(rng.integers(2**31)))
        arm.simulated.place(rng, env.box[0], env.pusher[0], env.dynamics, hand)
        if tags.Tracker().update(arm.arm.grab()[1], scene.wrist_camera(arm.model, arm.arm.joints)).seen is not None:
            return hand


def sense(arm, tracker):
    """grab -> track. The first columns of a tick's row: see runlog.log_of."""
    (now, q), force, (taken, image) = arm.joints, arm.force, arm.grab()
    _, points, rotation = arm.model.chain(q)
    sight = tracker.update(image, scene.wrist_camera(arm.model, arm.joints_then(taken)))
    return dict(time=now, joints=q, points=points, pusher=points[-1, :2], force=(rotation @ force)[:2], image=image,
                **vars(sight))


def think(f, pi, passes, row, memory):
    """believe -> act, in the mirrored frame in which the nets have learned.

    Returns belief (12,) and action (2,) in the workspace's frame, and the next memory; `memory` is None at a run's start.
    """
    o = observation.assemble(np.concatenate([row["seen"], row["pusher"], row["force"]])[None], np.array([row["age"] > 0]))
    sign, hidden, recall = memory or (symmetry.signs(o), None, None)
    s_hat, hidden = belief.believe(f, symmetry.mirror(o, sign), hidden, passes)
    with torch.no_grad(), speed.autocast("cpu"):
        logits, recall = pi(torch.as_tensor(s_hat)[None], recall)
    action = symmetry.mirror_action(networks.mode(logits[0]).numpy(), sign)
    return symmetry.mirror(s_hat, sign)[0], action[0], (sign, hidden, recall)


def control(drive, f, pi, cfg, hand, horizon, rows, screen):
    """One run: grab -> track -> believe -> act -> aim, 15 times a second. Returns how it ended.

    `drive` is a controller.Controller, `hand` (from, to) in s for who covers the tags of a real arm, `horizon` the most ticks;
    `rows` is a list that gets a dict a tick, which the page.Page `screen` shows, if there is one.
    """
    arm, simulated = drive.arm, drive.arm.simulated
    cues = {int(moment * task.RATE): f"now {word} the tags" for moment, word in zip(hand, ("cover", "uncover")) if moment < 60}
    tracker, memory, certain = tags.Tracker(), None, 0
    for _ in range(PATIENCE):
        drive.tick()
        drive.aim(np.zeros(2))  # not before the tick, or the silence until the first real target would be a step longer
        if (row := sense(arm, tracker))["seen"] is not None:
            break
    else:
        return f"box not seen for {PATIENCE // task.RATE} s"

    for tick in range(horizon):
        began = time.perf_counter()
        row = sense(arm, tracker) if tick else row
        row |= dict(true=simulated.box.copy() if simulated else np.full(3, np.nan), covered=bool(simulated and simulated.covered))
        s_hat, action, memory = think(f, pi, cfg.passes, row, memory)
        arm.require(np.isfinite(s_hat).all(), "the estimate is not finite")
        drive.aim(task.SPEEDS[action])
        row |= dict(estimated=task.unscale_pose(s_hat[:4]), sigma=s_hat[8:], action=action)
        if not simulated and tick in cues:
            print(cues[tick])
        waited = drive.tick()
        row |= dict(unsolved=drive.unsolved, busy=time.perf_counter() - began - waited)
        rows.append(row)
        if screen:
            screen.show(row, tick)
        box, pusher = simulated.box if simulated else row["estimated"], arm.model.chain(arm.joints[1])[1][-1, :2]
        certain = certain + 1 if task.reached(box) else 0
        if certain >= (1 if simulated else CERTAIN):
            return "success" if simulated else "success by estimate"
        if simulated and simulated.ended:
            return "ended on the page"
        if task.outside(box, pusher):
            return "out of the workspace"
    return "out of time"


def perform(arm, f, pi, run, logs, scenario, k, screen):
    """Run k of a scenario, its film and figure, and last its log, by which a rerun knows it; Stop where the arm was stopped."""
    rows, stop, name = [], None, f"{scenario}_{k:03d}"
    hand = prepare(arm, run.cfg, scenario, k, run.world)
    arm.check()  # what was stopped before a run is no failure of it
    if screen:
        screen.begin(f"{scenario}, run {k + 1}")
    try:
        with controller.Controller(arm, run.cfg.realtime or not arm.simulated, run.cfg.think) as drive:
            ended = control(drive, f, pi, run.cfg, hand, run.world.horizon, rows, screen)
    except safety.Stop as reason:
        if arm.simulated and (isinstance(reason.__context__, KeyboardInterrupt) or page.BUTTON in arm.stopped):
            raise  # not the policy's failure: the same command plays the run again
        ended, stop = "stopped", reason
    log = runlog.log_of(rows, ended, bool(arm.simulated and arm.simulated.joined))
    if rows and run.cfg.video:
        views.write(rows, run.dir / f"{name}.mp4", run.dir / f"{name}_camera.mp4")
    others = [runlog.worth(other) for done in logs.values() for other in done.values() if "age" in other]
    if rows and runlog.worth(log) > max(others, default=()):
        plots.robot(views.columns(rows), f"{scenario}, run {k + 1}: {ended}", run.dir / "robot.png")
    write_atomic(run.dir / f"{name}.npz", lambda temporary: np.savez(temporary, **log))
    logs[scenario][k] = log
    save_json(run.dir / "summary.json", statistics.robot_runs(logs))
    if stop:
        raise stop
    if not rows:
        print(f"{name}: {ended}")
    return f"{name} {ended} after {len(rows) / task.RATE:.1f} s"


def play(cfg, arm, f, pi, paths, scenarios, screen):
    """The runs that are still to do of the scenarios, and their summary."""
    try:
        run = runs.Run(cfg, "06_robot", paths)
    except UserError as mistake:
        raise UserError(f"{mistake}, or another --seed") from None
    logs = {scenario: runlog.read(run.dir, scenario) for scenario in SCENARIOS}
    todo = [(scenario, k) for scenario in scenarios for k in range(cfg.runs) if k not in logs[scenario]]
    if cfg.video and len(todo) < len(scenarios) * cfg.runs:
        print(f"--video: does nothing for {len(scenarios) * cfg.runs - len(todo)} finished runs, whose images are gone")
    if run.finished and not todo:
        print(f"{tables.robot(statistics.robot_runs(logs))}\n")
        return run.skip()
    progress = bar(len(todo), "06_robot", unit="run")
    for scenario, k in todo:
        progress.set_postfix_str(perform(arm, f, pi, run, logs, scenario, k, screen), refresh=False)
        progress.update()
        if run.out_of_time():
            return run.stop()
    progress.close()
    summary = statistics.robot_runs(logs)
    save_json(run.dir / "summary.json", summary)  # a kill may have come between the last log and its summary
    print(f"\n{tables.robot(summary)}\n\nfigure, logs and summary.json: {run.dir}")
    run.finish(["summary.json"])


def main(cfg):
    if ranks.COUNT > 1:
        raise UserError("one arm, one process: run it as python 06_robot.py, without torchrun")
    if cfg.print_tags:
        tags.print_sheet(cfg.out / "tags.pdf")
        return print(f"{cfg.out / 'tags.pdf'}: print it at 100 %, and measure the ruler")
    cv2.setNumThreads(1)  # images are small, and threads wait for each other
    paths = {"estimator": runs.find(cfg, "03_train_estimator", "estimator.safetensors", "ours"),
             "policy": runs.find(cfg, "04_train_policy", "policy.safetensors", "est_uncertainty")}
    f, pi = weights.load(networks.Estimator, paths["estimator"]), weights.load(networks.Recurrent, paths["policy"])
    world = runs.world_of(cfg, paths.values())
    for name in ("box", "pusher_height", "max_force"):  # which tags, arm, pictures and program are made for
        if (known := getattr(world, name)) != getattr(World, name):
            raise UserError(f"--{name.replace('_', '-')} {known}: the robot is made for {getattr(World, name)} only")
    folder = runs.run_folder(cfg.own, "06_robot", None, cfg.seed)
    scenarios = SCENARIOS if cfg.scenario == "all" else (cfg.scenario,)
    if cfg.force and any(runlog.read(folder, other) for other in SCENARIOS if other not in scenarios):
        raise UserError(f"--force redoes all scenarios of {folder}: say --scenario all, or another --seed")
    claim(folder)  # before anything touches an arm that another process may drive
    # the first pass takes ten times as long as any other
    think(f, pi, cfg.passes, dict(seen=np.zeros(3), pusher=np.zeros(2), force=np.zeros(2), age=0), None)
    with contextlib.nullcontext() if cfg.view is None else page.Page(*cfg.view) as screen, connect(cfg) as arm:
        if screen:
            screen.arm = arm
            print(f"see http://127.0.0.1:{screen.server_port}")
        own = contextlib.nullcontext(arm.camera)
        with hardware.VideoCamera(cfg.camera, cfg.latency / task.RATE) if cfg.camera else own as arm.camera:
            play(cfg, arm, f, pi, paths, scenarios, screen)


if __name__ == "__main__":
    command.main(Config, PRESETS, main, __doc__)
