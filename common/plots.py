"""Every figure, named as in the paper, from the runs below command.Stage.roots; a seed or method not there is left out."""
import csv
from itertools import cycle

import cv2
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from common import draw, env, runs, task
from common.files import write_atomic
from common.stacks import ESTIMATORS, METHODS, TRAINED

matplotlib.rcParams.update({
    "font.size": 10, "axes.titlesize": 10.5, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": "0.9", "axes.axisbelow": True, "legend.frameon": False, "legend.fontsize": 8.5, "lines.linewidth": 1.8,
    "savefig.dpi": 150})

# Okabe and Ito's colours, told apart by the colour-blind, in the order of the registry: the same in every figure
COLOURS = ("#0072B2", "#56B4E9", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#444444", "#B8A100", "#7A4FBF", "#8C564B",
           "#332288", "#117733", "#882255")
SUCCESS_AXIS = {"ylabel": "success rate (%)", "ylim": (-2, 102)}  # the y axis of success rates
LOSSES = {  # figure: stage, methods, what is on the y axis
    "likelihood_loss": ("03_train_estimator", [m for m, kind in TRAINED.items() if kind.likelihood], "loss (eq. 1)"),
    "mse_loss": ("03_train_estimator", [m for m, kind in TRAINED.items() if not kind.likelihood], "mean squared error"),
    "bc_loss": ("04_train_policy", [m for m, method in METHODS.items() if method.training == "cloning"], "cross-entropy")}


def style(name):
    """Label, colour and marker of a method or estimator."""
    registry = METHODS if name in METHODS else ESTIMATORS
    styles = dict(zip(registry, zip(cycle(COLOURS), cycle("os^DvPX*<>hpd8"))))
    return registry[name].label, *styles[name]


def new(width, height, rows=1, columns=1, **kw):
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, **kw)


def curves(folders, x, y):
    """Columns x and y of the metrics in those run folders that came as far as the furthest: (K,), (folders, K)."""
    found = []
    for file in (folder / "metrics.csv" for folder in folders):
        rows = csv.DictReader(file.read_text().splitlines()) if file.exists() else []
        if points := [[float(row[x]), float(row[y])] for row in rows if row.get(y)]:
            found.append(np.array(points))
    found = [c for c in found if c[-1, 0] == max(other[-1, 0] for other in found)]
    return (found[0][:, 0], np.stack([np.interp(found[0][:, 0], *c.T) for c in found])) if found else (None, None)


def band(ax, method, seeds, x, y, x_scale=1.0, y_scale=1.0, **kw):
    """Mean over the run folders {seed: folder}, and one standard deviation to either side where there are several."""
    xs, ys = curves(seeds.values(), x, y)
    if xs is not None:
        xs, mean, std, (label, color, _) = xs * x_scale, ys.mean(0) * y_scale, ys.std(0) * y_scale, style(method)
        ax.plot(xs, mean, color=color, label=f"{label}, {len(ys)} seed{'s' * (len(ys) > 1)}", **kw)
        if len(ys) > 1:
            ax.fill_between(xs, mean - std, mean + std, color=color, alpha=0.2, lw=0)


def success_rate_priv(roots, path):
    """Fig. success_rate_priv: held-out success of pi_priv over training."""
    figure, ax = new(5, 3)
    band(ax, "priv_on_state", runs.seeds(roots, "01_train_privileged"), "steps", "success", 1e-6, 100)
    ax.set(xlabel="environment steps (millions)", **SUCCESS_AXIS)
    ax.legend(handles=ax.lines, loc="lower right")
    write_atomic(path, figure.savefig)


def starts(centres, success, path):
    """Success over where the box's centre starts: centres (N, 2) in m, success (N,)."""
    figure, ax = new(6, 3)
    edges = [np.linspace(-half, half, count + 1) for half, count in zip(task.HALF, (20, 10))]
    tried, won = (np.histogram2d(*centres.T, edges, weights=weights)[0] for weights in (None, success))
    rate = 100 * np.divide(won, tried, out=np.full_like(won, np.nan), where=tried > 0)  # white where none started
    image = ax.pcolormesh(*edges, rate.T, vmin=0, vmax=100, cmap="viridis")
    figure.colorbar(image, label=SUCCESS_AXIS["ylabel"])
    ax.grid(False)
    ax.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title=f"where the box's centre starts, {len(success):,} episodes")
    write_atomic(path, figure.savefig)


def training(rows, path):
    """What PPO told of every update, in eight panels; rows of the metrics of 01 or 04."""
    figure, axes = new(11, 5, 2, 4, sharex=True)
    x = np.array([row["steps"] for row in rows]) * 1e-6
    panels = (("success rate (%)", 100, "train_success", "success"), ("return", 1, "train_return"),
              ("episode length (steps)", 1, "train_length"), ("losses", 1, "policy_loss", "value_loss"),
              ("entropy", 1, "entropy"), ("KL, clip fraction, rate", 1, "kl", "clip_fraction", "lr"),
              ("explained variance", 1, "explained"), ("thousand steps/s", 1e-3, "steps_per_s"))
    for ax, (label, scale, *columns) in zip(axes.flat, panels):
        for colour, column in zip(COLOURS[::2], columns):
            y = scale * np.array([row.get(column, np.nan) for row in rows], float)
            name = {"success": "held out", "train_success": "training"}.get(column, column)
            ax.plot(x[np.isfinite(y)], y[np.isfinite(y)], color=colour, lw=1, label=name)
        ax.set(ylabel=label, yscale="log" if "KL" in label else "linear")
        if len(columns) > 1:
            ax.legend()
    for ax in axes[-1]:
        ax.set(xlabel="environment steps (millions)")
    write_atomic(path, figure.savefig)


def checkpoints(rows, path):
    """Success of each checkpoint of pi_priv in the trajectories collected; rows of 02's metrics."""
    figure, ax = new(5, 3)
    success = [100 * row["success"] for row in rows]
    ax.plot([row["checkpoint"] for row in rows], success, "o-", ms=3, color=style("priv_on_state")[1])
    ax.set(xlabel=r"checkpoint of $\pi_{priv}$", xlim=(-0.5, len(rows) - 0.5), **SUCCESS_AXIS)
    ax.set_title("actions sampled, study's starts")
    ax.xaxis.get_major_locator().set_params(integer=True)
    write_atomic(path, figure.savefig)


def passes(errors, path):
    """Error of the estimator on the validation set against M; errors is {M: error table}."""
    figure, axes = new(7, 2.8, 1, 2)
    labels = {"trans_mean_l2_mm": "mean L2 error (mm)", "rot_mean_abs_deg": "mean abs. error (deg)"}
    x = list(errors)
    for ax, (key, label) in zip(axes, labels.items()):
        for part, line in (("occluded", ":"), (None, "-"), ("seen", "--")):
            y = [(row[part] if part else row)[key] for row in errors.values()]
            ax.plot(x, y, line, marker="o", ms=4, color=style("ours")[1], label=part or "all steps")
        ax.set(xlabel="stochastic passes M", ylabel=label, xscale="log", ylim=(0, 1.1 * ax.dataLim.y1))
        ax.set_xticks(x, x)
        ax.set_xticks([], minor=True)
    axes[0].legend(handlelength=3)
    write_atomic(path, figure.savefig)


def validation_loss(roots, name, path):
    """Figs. likelihood_loss, mse_loss and bc_loss, by `name`: validation loss over epochs."""
    figure, ax = new(5, 3)
    stage, methods, ylabel = LOSSES[name]
    for method in methods:
        band(ax, method, runs.seeds(roots, stage, method), "epoch", "validation_loss", marker="o", ms=3)
    ax.set(xlabel="epoch", ylabel=f"validation {ylabel}", yscale="log" if name == "mse_loss" else "linear")
    ax.xaxis.get_major_locator().set_params(integer=True)
    ax.legend(handles=ax.lines)
    write_atomic(path, figure.savefig)


def success_rate(roots, path, levels={}):
    """Fig. success_rate: held-out success over training; levels {method: rate} of methods without RL are dashed lines."""
    figure, ax = new(7, 3.6)
    for i, method in enumerate(METHODS):  # those with a curve: what PPO trained
        band(ax, method, runs.seeds(roots, "04_train_policy", method), "steps", "success", 1e-6, 100, zorder=2.9 - i / 10)
    for method, level in levels.items():
        ax.axhline(100 * level, color=style(method)[1], ls="--", lw=1.4, label=f"{style(method)[0]}, after training")
    ax.set(xlabel="environment steps (millions)", **SUCCESS_AXIS)
    if ax.lines:  # an empty legend would take room
        figure.legend(loc="outside right upper")
    write_atomic(path, figure.savefig)


def occlusion_duration(results, path):
    """Fig. occlusion_duration: success with Wilson intervals against the duration; results as in results.json."""
    figure, ax = new(7, 3.6)
    for i, (method, points) in enumerate(results.items()):
        name, color, marker = style(method)
        mean, low, high = (100 * np.array([p[key] for p in points.values()]) for key in ("mean", "low", "high"))
        x = np.arange(len(points)) + 0.05 * (i - (len(results) - 1) / 2)  # side by side, so that no bar hides another
        ax.errorbar(x, mean, (mean - low, high - mean), color=color, marker=marker, ms=5, capsize=2, elinewidth=1, label=name)
    ax.set_xticks(range(len(points)), [{"0": "none"}.get(key, key) for key in points])
    ax.set(xlabel="occlusion duration (s)", title=f"{points['0']['episodes']:,} episodes a point, 95 % intervals", **SUCCESS_AXIS)
    figure.legend(loc="outside right upper")
    write_atomic(path, figure.savefig)


def other_worlds(results, path):
    """Success, with Wilson intervals, in each of the other worlds; results as in results.json."""
    rows = results["other_worlds"]
    methods = rows["as trained"]
    figure, ax = new(7, 1.2 + max(0.2, 0.05 * len(methods)) * len(rows))
    for i, method in enumerate(methods):
        name, color, marker = style(method)
        y, points = zip(*((k, rates[method]) for k, rates in enumerate(rows.values()) if method in rates))
        mean, low, high = (100 * np.array([p[key] for p in points]) for key in ("mean", "low", "high"))
        offset = 0.8 * ((i + 0.5) / len(methods) - 0.5)  # one below the other, so that no bar hides another
        ax.errorbar(mean, np.array(y) + offset, xerr=(mean - low, high - mean), color=color, marker=marker, ls="", ms=4,
                    elinewidth=1, label=name)
    ax.set_yticks(range(len(rows)), rows)
    ax.set(xlabel=SUCCESS_AXIS["ylabel"], xlim=SUCCESS_AXIS["ylim"], ylim=(len(rows) - 0.5, -0.5))
    figure.legend(loc="outside upper center", ncols=3)
    write_atomic(path, figure.savefig)


def calibration(results, path):
    """Is sigma true? On the test set, the filter's on some of it, and in the loop of est_uncertainty, as it is and scaled:
    coverage of central intervals, error against sigma, NEES after the last sight.
    """
    summaries = {style(kind)[:2]: e["calibration"] for kind, e in results["estimator_ablation"].items() if "calibration" in e}
    if loop := results.get("in_the_loop", {}).get("est_uncertainty"):
        label = f"{METHODS['est_uncertainty'].estimator}, in the loop"
        summaries |= {(label + end, color): loop[key] for key, end, color in
                      (("calibration", "", "0.3"), ("scaled", ", scaled", "0.6")) if key in loop}
    if filtered := results.get("filter", {}).get("test"):
        summaries["particle filter", "#882255"] = filtered["filter"]["calibration"]
    figure, (curve, errors, nees) = new(11, 3.7, 1, 3)
    for (label, color), c in summaries.items():
        levels = [0, *map(float, c["curve"]), 1]
        curve.plot(levels, [0, *(np.mean(shares) for shares in c["curve"].values()), 1], "o-", ms=4, color=color, label=label)
        enough = np.array(c["steps"]) >= 100
        errors.plot(np.array(c["sigma_mm"])[enough], np.array(c["rmse_mm"])[enough], "o-", ms=4, color=color)
        told = [i for i, count in enumerate(c["nees_count"]) if count >= 10]
        mean, low, high = (np.array(c["nees"][name])[told] for name in ("mean", "low", "high"))
        nees.plot(told, mean, "o-", ms=3, color=color)
        nees.fill_between(told, low, high, color=color, alpha=0.2, lw=0)
    for ax in (curve, errors):
        ax.axline((0, 0), slope=1, color="0.5", lw=1, ls=":")
    nees.axhline(1, color="0.5", lw=1, ls=":")
    curve.set(xlabel="central interval of the predicted Gaussian", ylabel="share of x, y, theta within")
    errors.set(xlabel="sigma in x, y (mm)", ylabel="root mean square error (mm)")
    nees.set(xlabel="time since the box was last seen (s)", ylabel="NEES / 3", ylim=(0, None))
    figure.legend(*curve.get_legend_handles_labels(), loc="outside lower center", ncols=len(summaries))
    write_atomic(path, figure.savefig)


def trajectory_with_uncertainty(episodes, path, cases, count, index, size=task.World.box):
    """Fig. trajectory_with_uncertainty: the true and the estimated box at six instants, and the estimator's variance below.

    {method: film.Recorded.episode}, of number `index` of the list; in `cases` of `count` the first succeeds, the second fails.
    """
    figure, axes = new(10, 5.6, 2, len(episodes), sharex="row", sharey="row", squeeze=False, height_ratios=(1.25, 1))
    for (view, chart), (method, episode) in zip(axes.T, episodes.items()):
        name, color, _ = style(method)
        state, belief, xi = episode["state"], episode["belief"], episode["o"][:, 8]
        t, q_hat = np.arange(len(state)) / task.RATE, task.unscale_pose(belief[:, :4])
        variance = 1e6 * ((belief[:, 8:10] * task.HALF) ** 2).sum(1)  # mm^2, of x and y together
        error = 1e6 * ((q_hat - state[:, :3])[:, :2] ** 2).sum(1)
        failure = "leaves the workspace" if task.outside(state[-1, :3], state[-1, 3:5]) else "runs out of time"
        view.set(title=f"{name} {'succeeds' if episode['success'] else failure} after {t[-1]:.1f} s", aspect="equal",
                 xlabel="x (m)", xlim=(-0.34, 0.34), ylim=(-0.19, 0.19))
        view.grid(False)
        view.add_patch(Rectangle(-task.HALF, *task.WORKSPACE, fill=False, ec="0.6", lw=1))
        view.add_patch(Polygon(draw.corners(np.zeros(3), size), fc="#AACDF0", ec="none", label="target"))
        view.plot(*state[:, 3:5].T, color="#D22828", lw=1, clip_on=False, label="pusher")
        view.add_patch(Circle(state[-1, 3:5], task.RADIUS, color="#D22828", clip_on=False))
        for k, i in enumerate(np.linspace(0, len(state) - 1, 6).astype(int)):
            shade = matplotlib.colormaps["viridis"](0.95 * (1 - k / 5))
            for pose, label, line in ((state[i], "true box", "-"), (q_hat[i], "estimate", (0, (2, 1.5)))):
                view.add_patch(Polygon(draw.corners(pose, size), fill=False, ec=shade, lw=1.6, ls=line, clip_on=False,
                                       label=label if k == 5 else None))
            chart.plot(t[i], variance[i], "o", color=shade, ms=7, zorder=3)
        chart.plot(t, variance, color=color, label=r"predicted $\sigma_x^2 + \sigma_y^2$")
        chart.plot(t, error, color="0.45", lw=1, ls=":", label="squared position error")
        chart.fill_between(t, 0, 1, xi > 0, transform=chart.get_xaxis_transform(), color="0.93", lw=0, label="occluded")
        chart.set(xlabel="time (s)", yscale="log")
    axes[0, 0].set(ylabel="y (m)")
    axes[1, 0].set(ylabel="position variance (mm²)", ylim=(max(0.5, axes[1, 0].get_ylim()[0]), None))
    handles, labels = (sum(pair, []) for pair in zip(*(ax.get_legend_handles_labels() for ax in axes[:, 0])))
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    outcome = " and ".join(f"{style(method)[0]} {word}" for method, word in zip(episodes, ("succeeds", "fails")))
    figure.suptitle(f"Full occlusion, episode {index} of the list. In {cases:,} of {count:,} episodes {outcome}", fontsize=10)
    write_atomic(path, figure.savefig)


def sim(path, world=task.World()):
    """Fig. sim: the environment at a start of the study."""
    one = env.PushEnv("rgb_array", world)
    one.reset(seed=0)
    write_atomic(path, lambda temporary: cv2.imwrite(str(temporary), one.render()[..., ::-1]))


def robot(columns, title, path):
    """Fig. 1: scene, camera and top view in rows; columns (time in s, occluded, three images), occluded ones framed."""
    figure, axes = new(2.6 * len(columns), 6.2, 3, len(columns), squeeze=False, height_ratios=(3, 3, 2.05))
    for column, (seconds, occluded, images) in zip(axes.T, columns):
        for ax, image in zip(column, images):
            ax.imshow(image)
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set(visible=True, color="#D55E00" if occluded else "0.7", lw=3 if occluded else 0.8)
        column[0].set_title(f"t = {seconds:.1f} s{', occluded' * bool(occluded)}")
    for ax, label in zip(axes[:, 0], ("scene", "robot's camera", "from above")):
        ax.set_ylabel(label)
    figure.suptitle(title, fontsize=10)
    write_atomic(path, figure.savefig)
