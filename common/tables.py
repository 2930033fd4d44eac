"""The numbers of sec. 5 and their tables: rates with intervals, paired differences, Markdown."""
import math

import numpy as np

from common import task

Z = 1.959964  # 95 % of a normal distribution
ERRORS = ("trans_mean_l2_mm", "trans_rmse_mm", "rot_mean_abs_deg", "rot_rmse_deg")
PAPER_ERRORS = {"vision": (49.83, 59.65, 22.56, 39.61), "mse": (7.62, 6.49, 2.51, 3.37),
                "likelihood": (6.83, 5.92, 2.46, 3.39), "ours": (4.42, 3.84, 2.10, 2.96)}
PAPER_SUCCESS = {"est_uncertainty": 94, "est": 92, "est_mse": 64, "priv_on_estimate": 83, "end_to_end": 12,
                 "behavior_cloning": 38}  # %
PAPER_LOSS = {"est_uncertainty": 6.7, "est": 8.3, "end_to_end": 45.8, "behavior_cloning": 37.6}  # points, none to full
PAPER_ROBOT = {"natural": "19/20", "hand_5s": "10/10", "hand_full": "7/10"}
PAPER_SWITCHES = {"priv_on_state": "2.68 +- 1.53", "est_uncertainty": "4.22 +- 2.67"}


def wilson(values):
    """Success rate of 0s and 1s with its 95 % Wilson interval."""
    n, p = len(values), float(np.mean(values))
    center, half = p + Z**2 / (2 * n), Z * math.sqrt(p * (1 - p) / n + Z**2 / (4 * n**2))
    low, high = ((center + side * half) / (1 + Z**2 / n) for side in (-1, 1))
    return {"mean": p, "low": min(p, max(0.0, low)), "high": max(p, min(1.0, high)), "episodes": n}  # rounding: p = 0, 1


def paired(values, reference):
    """Mean difference over the same episodes with its 95 % interval."""
    d = np.subtract(values, reference, dtype=float)
    mean, half = float(d.mean()), Z * float(d.std()) / math.sqrt(len(d))
    return {"mean": mean, "low": mean - half, "high": mean + half}


def errors(sums):
    """Row of tab. estimator_ablation from sums (5, N) of trajectories.pose_errors: ERRORS in mm and degrees, and their half_95.

    Steps are pooled; the intervals take trajectories as independent, their steps not.
    """
    unit = np.array([1e3, 1e3 / math.sqrt(2), np.rad2deg(1), np.rad2deg(1)])  # the paper's RMSE in mm is per axis
    steps = max(sums[0].sum(), 1)
    mean = sums[1:].sum(1) / steps
    half = Z * np.linalg.norm(sums[1:] - mean[:, None] * sums[0], axis=1) / steps
    mean[[1, 3]] **= 0.5
    half[[1, 3]] /= np.maximum(2 * mean[[1, 3]], 1e-12)
    return dict(zip(ERRORS, (unit * mean).tolist())) | {"half_95": dict(zip(ERRORS, (unit * half).tolist()))}


def error_table(sums):
    """`errors` over all steps and, below "seen" and "occluded", over those."""
    return errors(sums["all"]) | {name: errors(sums[name]) for name in ("seen", "occluded")}


def spread(values):
    return {"mean": float(np.mean(values)), "std": float(np.std(values))}


def summarise(done):
    """results.json from {section/key/...: one number an episode, or an error table}, as 05 measures them."""
    results = {}
    for name, values in done.items():
        section, key, *point = name.split("/")
        rows = results.setdefault(section, {})
        if section == "estimator_ablation":
            rows[key] = values
        elif section == "contact_switches":
            rows[key] = spread(values) | {"episodes": len(values)}
        elif section == "occlusion_duration":
            rows.setdefault(key, {})[point[0]] = wilson(values)
        elif section == "success_rate":
            rows.setdefault(key, {})[int(point[0])] = values
        else:
            rows[key] = wilson(values)
    for row in results["estimator_ablation"].values():
        vision = results["estimator_ablation"]["vision"]
        row |= {f"{key}_of_vision": row[key] / vision[key] for key in (ERRORS[0], ERRORS[2])}
    results["occlusion_loss"] = {
        method: paired(done[f"occlusion_duration/{method}/0"], done[f"occlusion_duration/{method}/full"])
        for method in results["occlusion_duration"]}
    by_seed = results["success_rate"]
    for method, values in list(by_seed.items()):
        row = wilson(values[0])
        if method != "est_uncertainty":
            row["minus_est_uncertainty"] = paired(values[0], done["success_rate/est_uncertainty/0"])
        if len(values) > 1:
            row["seeds"] = spread([np.mean(v) for v in values.values()]) | {"count": len(values)}
        by_seed[method] = row
    return results


def aligned(header, rows):
    """A Markdown table whose columns line up: the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(header, *rows)]
    cells = [[row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])] for row in (header, *rows)]
    lines = ["| " + " | ".join(row) + " |" for row in cells]
    rule = "|" + "|".join("-" * (w + 1) + (":" if i else "-") for i, w in enumerate(widths)) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])


def percent(rate):
    return f"{rate['mean']:.1%} [{100 * rate['low']:.1f}, {100 * rate['high']:.1f}]"


def within(mean, half):
    return f"{mean:.2f} [{mean - half:.2f}, {mean + half:.2f}]"


def beside_paper(results):
    """Every number of sec. 5 beside the paper's, with 95 % intervals."""
    rows = []
    for kind, e in results["estimator_ablation"].items():
        for key, unit, paper in zip(ERRORS, ("mean L2, mm", "RMSE, mm", "mean abs., deg", "RMSE, deg"), PAPER_ERRORS[kind]):
            rows.append([f"error of {kind}: {unit}", within(e[key], e["half_95"][key]), f"{paper:.2f}"])
    rows += [[f"success of {method}", percent(results["success_rate"][method]), f"{paper}%"]
             for method, paper in PAPER_SUCCESS.items()]
    for method, paper in PAPER_LOSS.items():
        d = results["occlusion_loss"][method]
        rows.append([f"loss of {method} from no to full occlusion, points",
                     f"{100 * d['mean']:.1f} [{100 * d['low']:.1f}, {100 * d['high']:.1f}]", f"{paper}"])
    for method, s in results["contact_switches"].items():
        mean = within(s["mean"], Z * s["std"] / math.sqrt(s["episodes"]))
        rows.append([f"contact switches of {method}, mean +- std", f"{mean} +- {s['std']:.2f}", PAPER_SWITCHES[method]])
    return "Beside the paper, with 95 % intervals\n\n" + aligned(["number", "here", "paper"], rows)


def estimator_ablation(results):
    """Tab. estimator_ablation, with the share of the vision baseline and the errors where the box is seen and occluded."""
    rows = []
    for kind, e in results["estimator_ablation"].items():
        share = f"{e[f'{ERRORS[0]}_of_vision']:.1%}, {e[f'{ERRORS[2]}_of_vision']:.1%}"
        parts = [f"{e[part][ERRORS[0]]:.2f}, {e[part][ERRORS[2]]:.2f}" for part in ("seen", "occluded")]
        rows.append([kind, *(f"{e[key]:.2f}" for key in ERRORS), share, *parts])
    header = ["estimator", "L2 (mm)", "RMSE (mm)", "abs. (deg)", "RMSE (deg)", "of vision", "seen", "occluded"]
    return ("Errors of the estimators on the test set (tab. estimator_ablation); in pairs: mean L2 (mm), mean abs. (deg)\n\n"
            + aligned(header, rows))


def success_rate(results):
    """Success under occlusion with 95 % intervals, paired differences and, where there are several, the seeds."""
    rows = []
    for method, r in results["success_rate"].items():
        d, s = r.get("minus_est_uncertainty"), r.get("seeds")
        difference = f"{100 * d['mean']:+.1f} [{100 * d['low']:+.1f}, {100 * d['high']:+.1f}]" if d else ""
        seeds = f"{s['mean']:.1%} +- {100 * s['std']:.1f} ({s['count']})" if s else ""
        rows.append([method, percent(r), difference, seeds])
    header = ["method", "success [95 %]", "minus est_uncertainty, paired", "mean +- std (seeds)"]
    return f"Success on the fixed list of {r['episodes']:,} episodes (sec. 5.2)\n\n" + aligned(header, rows)


def occlusion_duration(results):
    """The numbers of fig. occlusion_duration."""
    sweep = results["occlusion_duration"]
    rows = [[method, *map(percent, points.values())] for method, points in sweep.items()]
    points = next(iter(sweep.values()))
    header = ["method", *({"0": "none", "full": "full"}.get(name, f"{name} s") for name in points)]
    title = f"Success by occlusion duration, {points['0']['episodes']:,} episodes a point (fig. occlusion_duration)"
    return title + "\n\n" + aligned(header, rows)


def further(results):
    """Starts over the whole workspace, and sampled actions."""
    lines = [f"- {method}, starts over the whole workspace: success {percent(r)}"
             for method, r in results["whole_workspace_starts"].items()]
    lines += [f"- {method}, actions sampled: success {percent(r)}" for method, r in results["sampled_actions"].items()]
    return "\n".join(lines)


def robot_runs(logs):
    """summary.json from {scenario: {run: log}}: successes with their interval, occlusion, times of the ticks, stops."""
    summary = {}
    for scenario, runs in logs.items():
        if runs:
            ended = [str(log["ended"]) for log in runs.values()]
            ticks = {key: np.concatenate([log.get(key, []) for log in runs.values()]) for key in ("age", "busy")}
            won = [end.startswith("success") for end in ended]
            rate, some = wilson(won), len(ticks["busy"]) > 0
            summary[scenario] = {
                "successes": sum(won), "runs": len(won), "low": rate["low"], "high": rate["high"],
                "by_estimate": any("estimate" in end for end in ended),
                "occluded_share": float((ticks["age"] > 0).mean()) if some else None,
                "tick_p50_ms": float(1e3 * np.percentile(ticks["busy"], 50)) if some else None,
                "tick_p99_ms": float(1e3 * np.percentile(ticks["busy"], 99)) if some else None,
                "missed": int((ticks["busy"] > 1 / task.RATE).sum()), "stops": ended.count("stopped")}
    return summary


def robot(summary):
    """The hardware experiments (sec. 6) beside the paper's."""
    rows = []
    for scenario, r in summary.items():
        some = r["tick_p50_ms"] is not None
        rows.append([scenario, f"{r['successes']}/{r['runs']}{' by estimate' * r['by_estimate']}",
                     f"[{100 * r['low']:.0f}, {100 * r['high']:.0f}] %", PAPER_ROBOT[scenario],
                     f"{r['occluded_share']:.0%}" if some else "",
                     f"{r['tick_p50_ms']:.1f} / {r['tick_p99_ms']:.1f}" if some else "", str(r["missed"]), str(r["stops"])])
    header = ["scenario", "success", "95 %", "paper", "occluded frames", "tick p50 / p99 (ms)", "missed deadlines", "stops"]
    return aligned(header, rows)
