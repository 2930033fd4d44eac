"""Stage 05: the paper's tables and figures (sec. 5), from a fixed list of episodes that every method plays alike.

    python 05_evaluate.py [pretrained|smoke|quick|laptop|paper] [--weights DIR] [--episodes n] [--seed k] [--field value ...]

Reads pi_priv (01), the test set (02), the estimators (03), every finished seed of the policies (04) and the metrics.csv of
all: of the same preset, or in the folder --weights, which is pretrained/ with the preset pretrained. Writes
runs/<preset>/05_evaluate/seed<k>/: results.json, tables.md, film.mp4, film.gif, and as PNG the figures of sec. 5 and of the
appendix: success_rate, occlusion_duration, trajectory_with_uncertainty, sim, success_rate_priv, likelihood_loss, mse_loss,
bc_loss. Resumes after the last finished measurement.
"""
import json
import math
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch

from common import artifacts, episodes, film, geometry, networks, plots, stacks, tables, task, trajectories

ESTIMATORS = ("vision", "mse", "likelihood", "ours")
METHODS = tuple(stacks.ESTIMATOR)
SWEPT = tuple(m for m in METHODS if m != "priv_on_state")  # pi_priv on the true state knows no occlusion
DURATIONS = {"0": 0.0, "2.5": 2.5, "5": 5.0, "10": 10.0, "full": math.inf}  # s; the paper's own grid is in its plot only
LIST = 2**40  # first seed of the fixed list: no training draws one as large


@dataclass
class Config(artifacts.Reader):
    episodes: int = 2000
    """episodes of the fixed list for each success rate"""
    sweep_episodes: int = 2000
    """episodes for each point of the occlusion-duration sweep (sec. 5.3)"""
    switch_episodes: int = 20_000
    """episodes for the contact switches (sec. 5.4)"""
    passes: int = 50
    """M, stochastic passes of the estimator in the loop (sec. 4)"""
    test: int = 150_000
    """most trajectories of the test set (appendix B.2)"""
    test_passes: int = 50
    """M on the test set"""
    num_envs: int = 2000
    """worlds at once: so many episodes of the list share a seed, so another number is another list"""


PRESETS = {
    "pretrained": dict(episodes=200, sweep_episodes=200, switch_episodes=200, passes=10, num_envs=200,
                       weights=Path(__file__).parent / "pretrained"),
    "smoke": dict(episodes=16, sweep_episodes=8, switch_episodes=16, passes=2, test=12, num_envs=16),
    "quick": dict(episodes=900, sweep_episodes=300, switch_episodes=900, passes=20, test=2000, num_envs=300),
    "laptop": dict(switch_episodes=2000, passes=10, num_envs=1000),
    "paper": {},
}


@dataclass
class Measurement:
    """So many episodes of the fixed list, played by one policy in one kind of world."""

    method: str
    episodes: int
    seed: int = 0
    occlusion: float | None = None
    whole_workspace: bool = False
    greedy: bool = True
    switches: bool = False


def measurements(cfg, seeds):
    """{where it goes in results.json: Measurement}, in the order in which they are made."""
    todo = {f"success_rate/{m}/{k}": Measurement(m, cfg.episodes, k) for m in METHODS for k in seeds[m]}
    todo |= {f"occlusion_duration/{m}/{name}": Measurement(m, cfg.sweep_episodes, occlusion=seconds)
             for m in SWEPT for name, seconds in DURATIONS.items()}
    for m in ("priv_on_state", "est_uncertainty"):
        todo[f"whole_workspace_starts/{m}"] = Measurement(m, cfg.episodes, whole_workspace=True)
        todo[f"contact_switches/{m}"] = Measurement(m, cfg.switch_episodes, switches=True)
    todo["sampled_actions/est_uncertainty"] = Measurement("est_uncertainty", cfg.episodes, greedy=False)
    return todo


def policy_of(method):
    """Stage, file and method of artifacts.find for a policy."""
    priv = method.startswith("priv")
    return "01_train_privileged" if priv else "04_train_policy", "policy.safetensors", None if priv else method


def finished_seeds(cfg, method):
    """Seed 0 and every other seed of a policy whose training is finished."""
    stage, _, name = policy_of(method)
    folders = {int(folder.name[4:]): folder for folder in artifacts.run_folder(cfg.source, stage, name, 0).parent.glob("seed*")}
    return sorted({0} | {k for k, folder in folders.items() if (artifacts.record_of(cfg, folder) or {}).get("finished")})


class Players:
    """Plays Measurements with the nets at `paths`, a chunk of cfg.num_envs episodes of the fixed list at a time."""

    def __init__(self, cfg, paths, device):
        self.cfg, self.device = cfg, device
        self.policy = cache(lambda m, seed: networks.load_recurrent(paths[m, seed], device))
        self.estimator = cache(lambda kind: networks.load_estimator(paths[kind], device) if kind else None)

    def play(self, m, chunk):
        """Success (N,), length (N,) and film.Recorded of a chunk: starts, dynamics, noise, occlusions as for all."""
        seed = LIST * (1 + self.cfg.seed) + chunk
        torch.manual_seed(seed)
        estimator = self.estimator(stacks.ESTIMATOR[m.method])
        env = stacks.make(m.method, self.cfg.num_envs, estimator, self.cfg.passes, m.occlusion, m.whole_workspace)
        env = film.Recorded(env)
        return *episodes.play(env, self.policy(m.method, m.seed), seed, m.greedy), env

    def measure(self, m, bar, name):
        """One number an episode: 1 for success, or its contact switches."""
        values = []
        for chunk in range(math.ceil(m.episodes / self.cfg.num_envs)):
            success, length, env = self.play(m, chunk)
            if m.switches:
                success = [geometry.contact_switches(env.episode(i, n)["state"]) for i, n in enumerate(length)]
            values += [int(x) for x in success[:m.episodes - len(values)]]
            bar.set_postfix_str(f"{name} {np.mean(values):{'.1f' if m.switches else '.1%'}}", refresh=False)
            bar.update(min(self.cfg.num_envs, m.episodes - chunk * self.cfg.num_envs))
        return values

    def episode(self, m, index):
        """Episode `index` of the list: states, observations, beliefs and success."""
        chunk, world = divmod(index, self.cfg.num_envs)
        success, length, env = self.play(m, chunk)
        return env.episode(world, length[world]) | {"success": bool(success[world])}


def estimator_errors(cfg, players, test, kind):
    """Row of tab. estimator_ablation on the test set; vision is the pose in o, held when occluded."""
    def predict(o):
        if kind == "vision":
            return o[..., :4]
        with networks.autocast(o.device):
            return players.estimator(kind).predict(o, passes=cfg.test_passes)[0]

    torch.manual_seed(LIST + cfg.seed)
    return tables.error_table(trajectories.measure(test, cfg.test, 100, LIST + cfg.seed, players.device, predict))


def report(run):
    """Prints the two tables and the folder of the figures."""
    try:
        results = json.loads((run.dir / "results.json").read_text())
        text = f"{tables.beside_paper(results)}\n\n{tables.success_rate(results)}"
    except (OSError, ValueError, KeyError):
        raise artifacts.UserError(f"{run.dir}/results.json is missing, damaged or old: rerun with --force") from None
    if run.cfg.preset == "pretrained":
        print(f"\nA quick look, {run.cfg.episodes} episodes a point: the published tables and figures are in results/")
    print(f"\n{text}\n")
    print(f"figures, film, tables.md and results.json: {run.dir}")


def draw(run, players, results, done):
    """Every figure, and the film; returns which episodes they show."""
    levels = {m: results["success_rate"][m]["mean"] for m in ("priv_on_estimate", "behavior_cloning")}
    plots.success_rate(run.cfg.source, run.dir / "success_rate.png", levels)
    plots.success_rate_priv(run.cfg.source, run.dir / "success_rate_priv.png")
    for name in plots.LOSSES:
        plots.validation_loss(run.cfg.source, name, run.dir / f"{name}.png")
    plots.occlusion_duration(results["occlusion_duration"], run.dir / "occlusion_duration.png")
    plots.sim(run.dir / "sim.png")

    pair = ("est_uncertainty", "priv_on_estimate")
    ours, theirs = (done[f"occlusion_duration/{m}/full"] for m in pair)
    cases = [i for i, (won, other) in enumerate(zip(ours, theirs)) if won and not other]
    first = cases[0] if cases else 0
    plots.trajectory_with_uncertainty(
        {m: players.episode(Measurement(m, len(ours), occlusion=math.inf), first) for m in pair},
        run.dir / "trajectory_with_uncertainty.png", len(cases), len(ours), first)

    success, length, env = players.play(Measurement("est_uncertainty", run.cfg.episodes), 0)
    hidden = np.array([env.episode(i, n)["o"][:, 8].sum() for i, n in enumerate(length)])
    long = np.flatnonzero(success & (hidden >= 5 * task.RATE))  # the first success with 5 s of occlusion
    shown = int(long[0]) if long.size else 0
    film.write(env.episode(shown, length[shown]), run.dir / "film.mp4", run.dir / "film.gif")
    return {"trajectory_with_uncertainty": {"episode": first, "cases": len(cases), "episodes": len(ours)},
            "film": {"episode": shown}}


def main(cfg):
    device = artifacts.device_of(cfg)
    seeds = {m: finished_seeds(cfg, m) for m in METHODS}
    artifacts.find(cfg, *policy_of("priv_on_state"))  # in the order of the stages: an error names the first that is missing
    test, test_paths = trajectories.load_set(cfg, "test")
    paths = {kind: artifacts.find(cfg, "03_train_estimator", "estimator.safetensors", kind) for kind in ESTIMATORS[1:]}
    paths |= {(m, k): artifacts.find(cfg, *policy_of(m), k) for m in METHODS for k in seeds[m]}
    run = artifacts.Run(cfg, "05_evaluate", paths | test_paths)
    if run.finished:
        report(run)
        return run.skip()

    players, done, todo = Players(cfg, paths, device), run.load_resume() or {}, measurements(cfg, seeds)
    counts = {name: m.episodes for name, m in todo.items()}
    bar = artifacts.bar(sum(counts.values()), "05_evaluate", unit="episode",
                        initial=sum(n for name, n in counts.items() if name in done))
    jobs = {f"estimator_ablation/{kind}": partial(estimator_errors, cfg, players, test, kind) for kind in ESTIMATORS}
    jobs |= {name: partial(players.measure, m, bar, name) for name, m in todo.items()}
    for name, job in jobs.items():
        if name in done:
            continue
        done[name] = job()
        run.save_resume(done)
        if run.out_of_time():
            return run.stop()
    bar.close()

    results = tables.summarise(done)
    artifacts.save_json(run.dir / "results.json", results)
    sections = (tables.beside_paper, tables.estimator_ablation, tables.success_rate, tables.occlusion_duration, tables.further)
    text = "\n\n".join(section(results) for section in sections) + "\n"
    artifacts.write_atomic(run.dir / "tables.md", lambda path: path.write_text(text))
    artifacts.save_json(run.dir / "results.json", results | draw(run, players, results, done))
    run.finish(["results.json", "tables.md"])
    report(run)


if __name__ == "__main__":
    artifacts.main(Config, PRESETS, main, __doc__)
