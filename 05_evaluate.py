"""Stage 05: the paper's tables and figures (sec. 5), from a fixed list of episodes that every method plays alike.

    python 05_evaluate.py [pretrained|smoke|quick|laptop|paper] [--weights DIR] [--episodes n] [--seed k] [--field value ...]

Reads pi_priv (01), the test set (02), every finished seed of the estimators (03) and policies (04) and the metrics.csv of
all: those in the folder --weights, which is pretrained/ with the preset pretrained, and the others of the same preset. Writes
runs/<preset>/05_evaluate/seed<k>/: results.json, tables.md, film.mp4, film.gif, and as PNG the figures of sec. 5 and of the
appendix: success_rate, occlusion_duration, trajectory_with_uncertainty, sim, success_rate_priv, likelihood_loss, mse_loss,
bc_loss; other_worlds, calibration. What is not trained is left out; after a further training the same command measures what
is new, and no more (measurements/, a file each). Resumes after the last finished measurement.
"""
import hashlib
import math
from collections import defaultdict
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common import calibration, command, film, particles, plots, ranks, runs, stacks, statistics, tables, task, trajectories
from common.files import UserError, load_json, save_json, write_atomic
from common.measurements import FILTERED, Measurement, measurements, other_worlds
from common.players import LIST, Players, first_seed
from common.progress import bar
from common.stacks import ESTIMATORS, METHODS, TRAINED


@dataclass
class Config(command.Reader):
    episodes: int = 2000  # episodes of the fixed list for each success rate
    sweep_episodes: int = 2000  # episodes for each point of the occlusion-duration sweep (sec. 5.3)
    switch_episodes: int = 20_000  # episodes for the contact switches (sec. 5.4)
    passes: int = 50  # M, stochastic passes of the estimator in the loop (sec. 4)
    other_episodes: int | None = 1000  # episodes for each policy in each of the other worlds; none: these are left out
    # trajectories of each kind that the particle filter is measured on, half as many as its episodes; none: it is left out
    filter_trajectories: int | None = command.setting(100, before=None)
    particles: int = 1000  # of the filter
    test: int = 150_000  # most trajectories of the test set (appendix B.2)
    test_passes: int = 50  # M on the test set
    num_envs: int = 1000  # worlds at once: so many episodes of the list share a seed, so another number is another list


PRESETS = {
    "pretrained": dict(episodes=200, sweep_episodes=200, switch_episodes=200, other_episodes=None, passes=10, num_envs=200,
                       filter_trajectories=None, weights=Path(__file__).parent / "pretrained"),
    "smoke": dict(episodes=16, sweep_episodes=8, switch_episodes=16, other_episodes=None, passes=2, test=12,
                  num_envs=16, filter_trajectories=2, particles=10),
    "quick": dict(episodes=900, sweep_episodes=300, switch_episodes=900, other_episodes=300, passes=10, test=2000, num_envs=300,
                  filter_trajectories=20, particles=300),
    "laptop": dict(switch_episodes=2000, passes=10),
    "paper": {},
}


def trained(cfg):
    """What is there to measure, and names of what is not: {kind: [path]}, {"kind/seed": [path]} of further seeds,
    {(method, seed): path}, [name].

    Raises UserError: pi_priv is missing, or something is damaged or stale.
    """
    pi_priv = runs.find(cfg, "01_train_privileged", "policy.safetensors")
    estimators, again, policies, left_out = {}, {}, {}, []

    @contextmanager
    def unless_missing(label, told=True):
        try:
            yield
        except runs.Missing:
            left_out.extend([label] * told)
        except runs.Mixed:
            left_out.append(f"{label} (of other nets than these)")

    def belongs(path):
        runs.check_lineage(cfg, path.parent, runs.hashes_of(cfg, [pi_priv, *sum(estimators.values(), []), path]))
        return path

    for kind in sorted(reversed(ESTIMATORS), key=lambda kind: kind not in TRAINED):  # the order of tab. estimator_ablation
        with unless_missing(f"estimator {kind}", kind in TRAINED):
            estimators[kind] = stacks.find_estimator(cfg, kind)
    for kind, k in [(kind, k) for kind in TRAINED for k in runs.seeds(cfg.roots, "03_train_estimator", kind) if k]:
        with unless_missing(f"estimator {kind}, seed {k}"):
            path = runs.find(cfg, "03_train_estimator", "estimator.safetensors", kind, k)
            if kind not in estimators:
                raise runs.Missing
            again[f"{kind}/{k}"] = [belongs(path)]
    for name, method in METHODS.items():
        stage, folder = ("01_train_privileged", None) if method.training == "pi_priv" else ("04_train_policy", name)
        for k in sorted({*runs.seeds(cfg.roots, stage, folder)} | ({0} if method.published else set())):
            with unless_missing(f"{name}, seed {k}" if k else name):
                path = runs.find(cfg, stage, "policy.safetensors", folder, k)
                if method.estimator not in (None, *estimators) or k and (name, 0) not in policies:
                    raise runs.Missing
                policies[name, k] = belongs(path)
    return estimators, again, policies, left_out


def estimator_errors(cfg, players, test, name):
    """Row of tab. estimator_ablation on the test set, or, for the filter's table, sums of each trajectory, which
    trajectories.compared makes; vision is the pose in o, held when occluded.
    """
    section, kind = name.split("/", 1)
    data, limit, size = test, cfg.test, 100
    if section == "filter":
        row, kind = kind.split("/")
        data, limit, size = test if row == "test" else players.trajectories(row), cfg.filter_trajectories, 1
    estimator = players.estimator(None if kind == "vision" else kind)
    progress = bar(min(limit, len(data[1]) - 1), name, unit="trajectory")

    def predict(o):
        progress.update(o.shape[1])
        return estimator.predict(o, passes=cfg.test_passes)[:2] if estimator else (o[..., :4], None)

    sums = trajectories.measure(data, limit, size, LIST + cfg.seed, players.device, predict, players.world,
                                getattr(estimator, "scale", None))
    progress.close()
    if section == "filter":
        return {part: values.tolist() for part, values in sums.items()}
    return statistics.error_table(sums) if sums else None


def measure(run, players, todo, test, files, kept):
    """Adds to `kept` what {name: file} has and it has not, and writes the file; False when the time limit stopped it.

    Chunks of episodes, and batches of the test set, are shared out among the processes.
    """
    def keep(name, values):
        kept[name] = values
        save_json(files[name], values, indent=None)

    for name in [name for name in files if name not in todo and name not in kept]:
        ranks.lead(keep)(name, estimator_errors(run.cfg, players, test, name))
        if run.out_of_time():
            return False
    new = {name: m for name, m in todo.items() if name not in kept}
    chunks = [(name, number) for name, m in new.items() for number in range(math.ceil(m.episodes / m.width(run.cfg)))]
    total, ahead = (sum(m.episodes for m in several.values()) for several in (todo, new))
    progress, values = bar(total, "05_evaluate", unit="episode", initial=total - ahead), defaultdict(list)
    for jobs in trajectories.batches(chunks, ranks.COUNT):
        for (name, _), more in zip(jobs, ranks.spread(jobs, lambda job: players.measure(todo[job[0]], job[1]))):
            values[name] += more
            mean = "" if todo[name].errors else f"{np.mean(values[name]):{'.1f' if todo[name].switches else '.1%'}}"
            progress.set_postfix_str(f"{name} {mean}", refresh=False)
            progress.update(len(more))
            if len(values[name]) == todo[name].episodes:
                keep(name, values[name])
        if run.out_of_time():
            return False
    progress.close()
    return True


def report(run):
    """Prints the two main tables and the folder of the figures."""
    results = load_json(run.dir / "results.json", "rerun with --force")
    if run.cfg.preset == "pretrained":
        print(f"\nA quick look, {run.cfg.episodes} episodes a point: the published tables and figures are in results/")
    print(f"\n{tables.beside_paper(results)}\n\n{tables.success_rate(results)}\n")
    print(f"figures, film, tables.md and results.json: {run.dir}")


def draw(run, players, results, done):
    """Every figure that the methods measured allow, and the film."""
    cfg = run.cfg
    for old in (*run.dir.glob("*.png"), *run.dir.glob("film.*")):
        old.unlink()
    levels = {m: row["mean"] for m, row in results["success_rate"].items() if METHODS[m].training != "rl"}
    levels.pop("priv_on_state")
    plots.success_rate(cfg.roots, run.dir / "success_rate.png", levels)
    plots.success_rate_priv(cfg.roots, run.dir / "success_rate_priv.png")
    for name, (_, methods, _) in plots.LOSSES.items():
        if {*methods} & {*results["estimator_ablation"], *results["success_rate"]}:
            plots.validation_loss(cfg.roots, name, run.dir / f"{name}.png")
    plots.sim(run.dir / "sim.png", players.world)
    if any("calibration" in row for row in results["estimator_ablation"].values()):
        plots.calibration(results, run.dir / "calibration.png")
    if results["other_worlds"]:
        plots.other_worlds(results, run.dir / "other_worlds.png")
    if results["occlusion_duration"]:
        plots.occlusion_duration(results["occlusion_duration"], run.dir / "occlusion_duration.png")

    pair = ("est_uncertainty", "priv_on_estimate")
    if results["success_rate"].keys() >= {*pair}:
        ours, theirs = (done[f"occlusion_duration/{m}/full"] for m in pair)
        cases = [i for i, (won, other) in enumerate(zip(ours, theirs)) if won and not other]
        first = cases[0] if cases else 0
        plots.trajectory_with_uncertainty(
            {m: players.episode(Measurement(m, len(ours), occlusion=math.inf), first) for m in pair},
            run.dir / "trajectory_with_uncertainty.png", len(cases), len(ours), first, players.world.box)
    if "est_uncertainty" in results["success_rate"]:
        success, length, env = players.chunk(Measurement("est_uncertainty", cfg.episodes), 0)
        hidden = np.array([env.episode(i, n)["o"][:, 8].sum() for i, n in enumerate(length)])
        long = np.flatnonzero(success & (hidden >= 5 * task.RATE))  # the first success with 5 s of occlusion
        world = int(long[0]) if long.size else 0
        film.write(env.episode(world, length[world]), run.dir / "film.mp4", run.dir / "film.gif", players.world)


def main(cfg):
    if cfg.filter_trajectories and cfg.particles < particles.LEAST:
        raise UserError(f"--particles {cfg.particles}: say {particles.LEAST} or more")
    for name in ("switch_episodes", "filter_trajectories"):
        if getattr(cfg, name) == 1:
            raise UserError(f"--{name.replace('_', '-')} 1: one tells no interval, say 2 or more")
    first_seed(cfg)
    device = command.device_of(cfg)
    estimators, again, policies, left_out = trained(cfg)
    test, test_paths = trajectories.load_set(cfg, "test")
    nets = {(kind, i): path for kind, paths in (estimators | again).items() for i, path in enumerate(paths)}
    run = runs.Run(cfg, "05_evaluate", nets | policies | test_paths, grows=True)
    if left_out:
        print(f"left out, as not trained to the end, or without their nets: {'; '.join(left_out)}")
    players, todo = Players(cfg, estimators | again | policies, device, run.world), measurements(cfg, policies, run.world)
    def sha(*paths):
        return [*runs.hashes_of(cfg, paths).values()]

    pi_priv, tested = policies["priv_on_state", 0], [kind for kind in estimators if not ESTIMATORS[kind].scaled]
    sources = {f"estimator_ablation/{kind}": [*test_paths.values(), *estimators.get(kind, ())] for kind in ("vision", *tested)}
    sources |= {f"estimator_seeds/{kind}": [*test_paths.values(), *paths] for kind, paths in again.items()}
    sources = {name: sha(*paths) + [calibration.SUMMARY] for name, paths in sources.items()}
    sources |= {f"filter/{row}/{kind}": sha(*test_paths.values(), pi_priv, *estimators.get(kind, ())) + [calibration.PARTS]
                for row in ("test", "drifting", *(row for row in FILTERED if row in other_worlds(run.world)))
                if cfg.filter_trajectories for kind in ("vision", *tested, "filter")}
    sources |= {name: sha(policies[m.method, m.seed], *estimators.get(METHODS[m.method].estimator, ()))
                + [calibration.PARTS] * m.errors for name, m in todo.items()}
    files = {name: run.dir / "measurements" / name / f"{hashlib.sha256(repr(made_of).encode()).hexdigest()[:16]}.json"
             for name, made_of in sources.items()}
    kept = ranks.lead(lambda: {name: load_json(path, "delete it, and the same command measures it anew")
                               for name, path in files.items() if path.exists()})()
    if run.finished and files.keys() == kept.keys() and ranks.lead((run.dir / "results.json").exists)():
        report(run)
        return run.skip()

    if not measure(run, players, todo, test, files, kept):
        return run.stop()
    if ranks.RANK:
        return
    done = {name: kept[name] for name in files}  # in their order, whenever they were measured
    results = statistics.summarise(done)
    write_atomic(run.dir / "tables.md", lambda path: path.write_text(tables.every(results)))
    draw(run, players, results, done)
    save_json(run.dir / "results.json", results)
    run.finish(["results.json", "tables.md"])
    report(run)


if __name__ == "__main__":
    command.main(Config, PRESETS, main, __doc__)
