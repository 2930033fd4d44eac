"""The tables of sec. 5 and 6 in Markdown, of whatever methods were measured."""
import math

from common import calibration, paper
from common.statistics import ERRORS, MEANS, Z


def aligned(header, rows):
    """A Markdown table whose columns line up: the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(header, *rows)]
    cells = [[row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])] for row in (header, *rows)]
    head, *lines = (f"| {' | '.join(row)} |" for row in cells)
    rule = "|" + "|".join("-" * (w + 1) + (":" if i else "-") for i, w in enumerate(widths)) + "|"
    return "\n".join([head, rule, *lines])


def titled(title, header, rows):
    """A table below its title, nothing if it has no rows."""
    return f"{title}\n\n{aligned(header, rows)}" if rows else ""


def percent(rate):
    return f"{rate['mean']:.1%} [{100 * rate['low']:.1f}, {100 * rate['high']:.1f}]"


def points(difference, sign=""):
    """A difference of rates with its interval, in points."""
    mean, low, high = (f"{100 * difference[key]:{sign}.1f}" for key in ("mean", "low", "high"))
    return f"{mean} [{low}, {high}]"


def within(mean, half):
    return f"{mean:.2f} [{mean - half:.2f}, {mean + half:.2f}]"


def coverage(told):
    """Shares of x, y and theta within one and two sigma, in percent, +- half the widest of the three intervals."""
    cells = []
    for share in (told["within_1_sigma"], told["within_2_sigma"]):
        half = max(high - low for low, high in zip(share["low"], share["high"])) / 2
        cells.append(f"{', '.join(f'{100 * x:.0f}' for x in share['mean'])} +- {100 * half:.1f}")
    return cells


def beside_paper(results):
    """Every number of sec. 5 beside the paper's, with 95 % intervals."""
    rows, units = [], ("mean L2, mm", "RMSE, mm", "mean abs., deg", "RMSE, deg")
    for kind, published in paper.ERRORS.items():
        if e := results["estimator_ablation"].get(kind):
            rows += [[f"error of {kind}: {unit}", within(e[key], e["half_95"][key]), f"{number:.2f}"]
                     for key, unit, number in zip(ERRORS, units, published)]
    rows += [[f"success of {method}", percent(results["success_rate"][method]), f"{published}%"]
             for method, published in paper.SUCCESS.items() if method in results["success_rate"]]
    rows += [[f"loss of {method} from no to full occlusion, points", points(results["occlusion_loss"][method]), f"{published}"]
             for method, published in paper.LOSS.items() if method in results["occlusion_loss"]]
    for method, s in results.get("contact_switches", {}).items():
        mean = within(s["mean"], Z * s["std"] / math.sqrt(s["episodes"]))
        rows.append([f"contact switches of {method}, mean +- std", f"{mean} +- {s['std']:.2f}", paper.SWITCHES[method]])
    return titled("Beside the paper, with 95 % intervals", ["number", "here", "paper"], rows)


def estimator_ablation(results):
    """Tab. estimator_ablation, with the share of the vision baseline and the errors where the box is seen and occluded."""
    rows = []
    for kind, e in results["estimator_ablation"].items():
        share = ", ".join(f"{e[f'{key}_of_vision']:.1%}" for key in MEANS if f"{key}_of_vision" in e)
        parts = [", ".join(f"{e[part][key]:.2f}" for key in MEANS) if part in e else "" for part in ("seen", "occluded")]
        s = e.get("seeds")
        seeds = f"{', '.join('{mean:.2f} +- {std:.2f}'.format(**s[key]) for key in MEANS)} ({s['count']})" if s else ""
        rows.append([kind, *(f"{e[key]:.2f}" for key in ERRORS), share, *parts, seeds])
    title = "Errors of the estimators on the test set (tab. estimator_ablation); in pairs: mean L2 (mm), mean abs. (deg)"
    header = ["estimator", "L2 (mm)", "RMSE (mm)", "abs. (deg)", "RMSE (deg)", "of vision", "seen", "occluded",
              "mean +- std (seeds)"]
    return titled(title, header, rows)


def in_the_loop(results):
    """Errors of the estimates while each policy plays."""
    rows = [[method, *(within(e[key], e["half_95"][key]) for key in MEANS)]
            for method, e in results.get("in_the_loop", {}).items()]
    return titled("Errors of the estimate in the loop, with 95 % intervals", ["policy", "mean L2 (mm)", "mean abs. (deg)"], rows)


def calibrated(results):
    """Whether sigma is true, on the test set and in each policy's loop, as it is and scaled on the validation set; and the
    filter's.
    """
    rows, filters = [], {f"filter, {row}": rates["filter"] for row, rates in results.get("filter", {}).items()}
    for name, e in (results["estimator_ablation"] | results.get("in_the_loop", {}) | filters).items():
        for key in calibration.TALLIES:
            if told := e.get(key):
                mean = told["nees"]["mean"]
                nees = [mean[age] for age in (0, 3, 10) if age < len(mean)]
                scores = [", ".join(f"{x:.2f}" for x in values) for values in (told["nll"], told["crps"], nees)]
                rows.append([f"{name}{', scaled' * (key == 'scaled')}", *coverage(told), *scores])
    title = "Calibration of x, y (mm), theta (deg); shares +- half the widest 95 % interval, NEES by time since the last sight"
    header = ["sigma of", "1 (68 %)", "2 (95 %)", "NLL", "CRPS", "NEES / 3: 0, 3, 10 s"]
    return titled(title, header, rows)


def foreseen(results):
    """Whether sigma tells that an episode leaves the workspace."""
    rows = [[method, str(told["left"]), *(points(told[score]) for score in calibration.SCORES)]
            for method, e in results.get("in_the_loop", {}).items() if (told := e.get("foreseen"))]
    header = ["policy", "left", "by sigma", "by its rise in 1 s", "by elapsed time", "sigma minus time"]
    return titled("Leaving the workspace within 2 s, foreseen: area under the ROC curve in %, with 95 % intervals", header, rows)


def filtered(results):
    """The particle filter beside the estimators, on the same trajectories."""
    sets, rows = results.get("filter", {}), []
    against = any("ensemble" in rates for rates in sets.values())
    kinds = [*next(iter(sets.values()), {})]
    for name, rates in sets.items():
        cells = ["; ".join([*(within(e[key], e["half_95"][key]) for key in MEANS), f"{e['trans_rmse_mm']:.2f}"])
                 for e in rates.values()]
        if against:
            cells.append("{mean:+.2f} [{low:+.2f}, {high:+.2f}]".format(**rates["filter"]["minus_ensemble_mm"]))
        rows.append([name, *cells])
    title = "The particle filter beside the estimators: mean L2 (mm) and abs. (deg) with 95 % intervals; RMSE (mm)"
    return titled(title, ["trajectories", *kinds, *["L2, minus ensemble"] * against], rows)


def success_rate(results):
    """Success under occlusion with 95 % intervals, paired differences and, where there are several, the seeds."""
    rows = []
    for method, r in results["success_rate"].items():
        difference, s = r.get("minus_est_uncertainty"), r.get("seeds")
        seeds = f"{s['mean']:.1%} +- {100 * s['std']:.1f} ({s['count']})" if s else ""
        rows.append([method, percent(r), points(difference, "+") if difference else "", seeds])
    header = ["method", "success [95 %]", "minus est_uncertainty, paired", "mean +- std (seeds)"]
    episodes = results["success_rate"]["priv_on_state"]["episodes"]
    return titled(f"Success on the fixed list of {episodes:,} episodes (sec. 5.2)", header, rows)


def occlusion_duration(results):
    """The numbers of fig. occlusion_duration."""
    sweep = results["occlusion_duration"]
    if not sweep:
        return ""
    rows = [[method, *map(percent, rates.values())] for method, rates in sweep.items()]
    rates = next(iter(sweep.values()))
    header = ["method", *({"0": "none", "full": "full"}.get(name, f"{name} s") for name in rates)]
    title = f"Success by occlusion duration, {rates['0']['episodes']:,} episodes a point (fig. occlusion_duration)"
    return titled(title, header, rows)


def other_worlds(results):
    """Success where one thing is other than in training, beside that in the world as trained, on the same episodes."""
    if not (worlds := results.get("other_worlds")):
        return ""
    methods = list(trained := worlds["as trained"])
    rows = [[row, *(percent(rates[m]) if m in rates else "" for m in methods)] for row, rates in worlds.items()]
    title = f"Success in other worlds, one thing changed at a time, the list's first {trained[methods[0]]['episodes']:,} episodes"
    return titled(title, ["world", *methods], rows)


def further(results):
    """Other starts, the particle filter in the loop and ours on the same episodes, and sampled actions."""
    sections = {f"starts {name}": rates for name, rates in results.get("starts", {}).items()}
    sections |= {f"{name} in the loop": rates for name, rates in results.get("filter_loop", {}).items()}
    sections["actions sampled"] = results.get("sampled_actions", {})
    return "\n".join(f"- {method}, {what}: success {percent(rate)}" + (
        f", minus ours, paired {points(rate['minus_ours'], '+')}" if "minus_ours" in rate else "")
        for what, rates in sections.items() for method, rate in rates.items())


SECTIONS = (beside_paper, estimator_ablation, success_rate, in_the_loop, calibrated, foreseen, filtered,
            occlusion_duration, other_worlds, further)


def every(results):
    """tables.md: what there is of every section."""
    return "\n\n".join(filter(None, (section(results) for section in SECTIONS))) + "\n"


def robot(summary):
    """The hardware experiments (sec. 6) beside the paper's."""
    rows = []
    for scenario, r in summary.items():
        success = f"{r['successes']}/{r['runs']}{' by estimate' * r['by_estimate']}"
        interval, ticks = "" if r["low"] is None else f"[{100 * r['low']:.0f}, {100 * r['high']:.0f}] %", ["", ""]
        if r["tick_p50_ms"] is not None:
            ticks = [f"{r['occluded_share']:.0%}", f"{r['tick_p50_ms']:.1f} / {r['tick_p99_ms']:.1f}"]
        others = ", ".join(f"{r[key]} {key.replace('_', ' ')}" for key in ("not_begun", "joined") if r[key])
        rows.append([scenario, success, interval, paper.ROBOT[scenario], *ticks, str(r["missed"]), str(r["stops"]), others])
    header = ["scenario", "success", "95 %", "paper", "occluded frames", "tick p50 / p99 (ms)", "missed deadlines", "stops",
              "not counted"]
    return aligned(header, rows)
