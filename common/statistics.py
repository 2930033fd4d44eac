"""The numbers of sec. 5 and 6 from what was measured: rates with intervals, paired differences, errors."""
import math

import numpy as np

from common import calibration, task

Z = 1.959964  # 95 % of a normal distribution
ERRORS = ("trans_mean_l2_mm", "trans_rmse_mm", "rot_mean_abs_deg", "rot_rmse_deg")
MEANS = ERRORS[::2]


def wilson(values):
    """Success rate of 0s and 1s with its 95 % Wilson interval."""
    n, p = len(values), float(np.mean(values))
    center, half = p + Z**2 / (2 * n), Z * math.sqrt(p * (1 - p) / n + Z**2 / (4 * n**2))
    low, high = ((center + side * half) / (1 + Z**2 / n) for side in (-1, 1))
    return {"mean": p, "low": min(p, max(0.0, low)), "high": max(p, min(1.0, high)), "episodes": n}  # rounding: p = 0, 1


def ratio(sums, steps):
    """Mean (...) over all steps, and half its 95 % interval, of sums (..., N) over `steps` (N,) steps of each trajectory: only
    trajectories are independent.
    """
    total = steps.sum()
    mean = sums.sum(-1) / total
    return mean, Z * np.linalg.norm(sums - mean[..., None] * steps, axis=-1) / total


def paired(values, reference, steps=None):
    """Mean difference over the same episodes, or, of values that are sums over `steps` steps each, over all steps, with its
    95 % interval.
    """
    d = np.subtract(values, reference, dtype=float)
    mean, half = map(float, ratio(d, np.ones(len(d)) if steps is None else np.asarray(steps)))
    return {"mean": mean, "low": mean - half, "high": mean + half}


def errors(sums):
    """Row of tab. estimator_ablation from sums (5, N) of trajectories.pose_errors: ERRORS in mm and degrees, and half_95."""
    unit = np.array([1e3, 1e3 / math.sqrt(2), np.rad2deg(1), np.rad2deg(1)])  # the paper's RMSE in mm is per axis
    mean, half = ratio(sums[1:], sums[0])
    mean[[1, 3]] **= 0.5
    half[[1, 3]] /= np.maximum(2 * mean[[1, 3]], 1e-12)
    return dict(zip(ERRORS, (unit * mean).tolist())) | {"half_95": dict(zip(ERRORS, (unit * half).tolist()))}


def error_table(sums):
    """Of {name: sums of each trajectory} `errors` over all steps and, below "seen" and "occluded", over those that there are;
    and whether sigma is true.
    """
    sums = {name: np.asarray(values) for name, values in sums.items()}
    return errors(sums["all"]) | {name: errors(sums[name]) for name in ("seen", "occluded") if sums[name][0].any()} | {
        name: calibration.summary(sums[name].T) for name in calibration.TALLIES if name in sums}


def in_the_loop(values):
    """Errors, calibration and what sigma foresees, from the episodes of trajectories.in_the_loop."""
    sums = {name: np.array([value[name] for value in values]).T for name in values[0]}
    told = error_table(sums) | {"episodes": len(values)}
    return told | ({"foreseen": calibration.foreseen(sums["course"].T)} if "course" in sums else {})


def spread(values):
    """Mean and sample standard deviation of two values or more."""
    return {"mean": float(np.mean(values)), "std": float(np.std(values, ddof=1))}


def summarise(done):
    """results.json from {section/key/...: a number or trajectories.in_the_loop of each episode, sums of each trajectory, or an
    error table}, as 05 measures them.
    """
    results = {"occlusion_duration": {}, "other_worlds": {}}
    kinds = {"estimator_ablation": dict, "estimator_seeds": dict, "filter": error_table, "success_rate": list,
             "in_the_loop": in_the_loop, "contact_switches": lambda v: spread(v) | {"episodes": len(v)}}
    for name, values in done.items():
        *keys, last = name.split("/")
        rows = results
        for key in keys:
            rows = rows.setdefault(key, {})
        rows[last] = kinds.get(keys[0], wilson)(values)
    vision = results["estimator_ablation"]["vision"]
    for row in results["estimator_ablation"].values():
        row |= {f"{key}_of_vision": row[key] / vision[key] for key in MEANS if vision[key]}
    for kind, by_seed in results.pop("estimator_seeds", {}).items():
        several = [first := results["estimator_ablation"][kind], *by_seed.values()]
        first["seeds"] = {key: spread([row[key] for row in several]) for key in MEANS} | {"count": len(several)}
    results["occlusion_loss"] = {method: paired(*(done[f"occlusion_duration/{method}/{name}"] for name in ("0", "full")))
                                 for method in results["occlusion_duration"]}

    def minus_est_uncertainty(name):
        """{method: `paired`} on the same episodes, of done[name.format(method)]."""
        reference, others = done.get(name.format("est_uncertainty")), set(results["success_rate"]) - {"est_uncertainty"}
        return {m: paired(done[name.format(m)], reference) for m in sorted(others) if reference and name.format(m) in done}

    for method, by_seed in results["success_rate"].items():
        row = results["success_rate"][method] = wilson(by_seed["0"])
        if len(by_seed) > 1:
            row["seeds"] = spread([np.mean(values) for values in by_seed.values()]) | {"count": len(by_seed)}
    for method, difference in minus_est_uncertainty("success_rate/{}/0").items():
        results["success_rate"][method]["minus_est_uncertainty"] = difference
    for row, by in results.get("filter", {}).items():
        if "ensemble" in by:
            (steps, l2, *_), (_, other, *_) = (done[f"filter/{row}/{kind}"]["all"] for kind in ("filter", "ensemble"))
            by["filter"]["minus_ensemble_mm"] = paired(1e3 * np.array(l2), 1e3 * np.array(other), steps)
    for method, rate in results.get("filter_loop", {}).get("filter", {}).items():
        rate["minus_ours"] = paired(*(done[f"filter_loop/{name}/{method}"] for name in ("filter", "ours")))
    results["minus_est_uncertainty"] = {"full occlusion": minus_est_uncertainty("occlusion_duration/{}/full")} | {
        world: minus_est_uncertainty(f"other_worlds/{world}/{{}}") for world in results["other_worlds"]}
    return results


def counts(log):
    """Whether a robot's run tells of the policy: it began, and nobody joined in."""
    return not str(log["ended"]).startswith("box not seen") and not log.get("joined", False)


def robot_runs(logs):
    """summary.json from {scenario: {run: log}}: successes with their interval, occlusion, times of the ticks, stops.

    What does not count is in `not_begun` and `joined` alone.
    """
    summary = {}
    for scenario, every in logs.items():
        if every:
            runs = [log for log in every.values() if counts(log)]
            ended = [str(log["ended"]) for log in runs]
            won = [end.startswith("success") for end in ended]
            rate = wilson(won) if won else {"low": None, "high": None}
            age, busy = (np.concatenate([[], *(log.get(key, []) for log in runs)]) for key in ("age", "busy"))
            p50, p99 = (1e3 * np.percentile(busy, (50, 99))).tolist() if busy.size else (None, None)
            joined = sum(bool(log.get("joined", False)) for log in every.values())
            summary[scenario] = {
                "successes": sum(won), "runs": len(won), "low": rate["low"], "high": rate["high"],
                "by_estimate": any("estimate" in end for end in ended),
                "occluded_share": float((age > 0).mean()) if busy.size else None, "tick_p50_ms": p50, "tick_p99_ms": p99,
                "missed": int((busy > 1 / task.RATE).sum()), "stops": ended.count("stopped"),
                "joined": joined, "not_begun": len(every) - len(runs) - joined}
    return summary
