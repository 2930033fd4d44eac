"""Every figure, named as in the paper, from what the runs wrote. A seed or method that is not there is left out.

`study` is the folder of a preset's runs, as <out>/<preset>.
"""
import csv

import cv2
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from common import task
from common.artifacts import write_atomic
from common.env import PushEnv, corners

matplotlib.use("Agg")
matplotlib.rcParams.update({
    "font.size": 10, "axes.titlesize": 10.5, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": "0.9",
    "axes.axisbelow": True, "legend.frameon": False, "legend.fontsize": 8.5, "lines.linewidth": 1.8, "savefig.dpi": 150})

# method -> name in the paper, colour (Okabe and Ito's, told apart by the colour-blind) and marker, the same in every figure
METHODS = {
    "est_uncertainty": (r"$\pi_{est}(\hat{s}, \hat{\Sigma})$", "#0072B2", "o"),
    "est": (r"$\pi_{est}(\hat{s})$", "#56B4E9", "s"),
    "est_mse": (r"$\pi_{est}(\hat{s})$, MSE estimator", "#E69F00", "^"),
    "priv_on_estimate": (r"$\pi_{priv}(\hat{s})$", "#009E73", "D"),
    "end_to_end": ("end-to-end RL", "#D55E00", "v"),
    "behavior_cloning": ("behavior cloning", "#CC79A7", "P"),
    "priv_on_state": (r"$\pi_{priv}(s)$", "#444444", "X"),
}
ESTIMATORS = {"ours": ("ours (likelihood + MC dropout)", "#0072B2"), "likelihood": ("likelihood loss", "#56B4E9"),
              "mse": ("MSE loss", "#E69F00")}
LOSSES = {  # figure: stage, {method: (label, colour)}, what is on the y axis
    "likelihood_loss": ("03_train_estimator", {m: ESTIMATORS[m] for m in ("ours", "likelihood")}, "loss (eq. 1)"),
    "mse_loss": ("03_train_estimator", {"mse": ESTIMATORS["mse"]}, "mean squared error"),
    "bc_loss": ("04_train_policy", {"behavior_cloning": METHODS["behavior_cloning"][:2]}, "cross-entropy")}


def new(width, height, rows=1, columns=1, **kw):
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, **kw)


def save(figure, path):
    write_atomic(path, figure.savefig)


def curves(folder, x, y):
    """Columns x and y of the metrics of all seeds in a folder that came as far as the furthest: (K,), (seeds, K)."""
    found = []
    for file in sorted(folder.glob("seed*/metrics.csv")):
        rows = [row for row in csv.DictReader(file.read_text().splitlines()) if row.get(y)]
        if rows:
            found.append(np.array([[float(row[x]), float(row[y])] for row in rows]))
    furthest = max((c[-1, 0] for c in found), default=0)
    found = [c for c in found if c[-1, 0] == furthest]
    return (found[0][:, 0], np.stack([np.interp(found[0][:, 0], *c.T) for c in found])) if found else (None, None)


def band(ax, folder, x, y, label, color, x_scale=1.0, y_scale=1.0, **kw):
    """Mean over seeds, and one standard deviation to either side where there are several."""
    xs, ys = curves(folder, x, y)
    if xs is None:
        return
    xs, mean, std, count = xs * x_scale, ys.mean(0) * y_scale, ys.std(0) * y_scale, len(ys)
    ax.plot(xs, mean, color=color, label=f"{label}, {count} seed{'s' * (count > 1)}", **kw)
    if count > 1:
        ax.fill_between(xs, mean - std, mean + std, color=color, alpha=0.2, lw=0)


def success_axis(ax):
    ax.set(ylabel="success rate (%)", ylim=(-2, 102))


def success_rate_priv(study, path):
    """Fig. success_rate_priv: held-out success of pi_priv over training."""
    figure, ax = new(5, 3)
    name, color, _ = METHODS["priv_on_state"]
    band(ax, study / "01_train_privileged", "steps", "success", name, color, 1e-6, 100)
    ax.set(xlabel="environment steps (millions)")
    success_axis(ax)
    if ax.lines:
        ax.legend(loc="lower right")
    save(figure, path)


def checkpoints(rows, path):
    """Success of each checkpoint of pi_priv in the trajectories collected; rows of 02's metrics."""
    figure, ax = new(5, 3)
    success = [100 * row["success"] for row in rows]
    ax.plot([row["checkpoint"] for row in rows], success, "o-", ms=3, color=METHODS["priv_on_state"][1])
    ax.set(xlabel=r"checkpoint of $\pi_{priv}$", title="actions sampled, study's starts", xlim=(-0.5, len(rows) - 0.5))
    ax.xaxis.get_major_locator().set_params(integer=True)
    success_axis(ax)
    save(figure, path)


def passes(errors, path):
    """Error of the estimator on the validation set against M; errors is {M: error table}."""
    figure, axes = new(7, 2.8, 1, 2)
    labels = {"trans_mean_l2_mm": "mean L2 error (mm)", "rot_mean_abs_deg": "mean abs. error (deg)"}
    for ax, (key, label) in zip(axes, labels.items()):
        for part, style in (("occluded", ":"), (None, "-"), ("seen", "--")):
            rows = {int(m): row[part] if part else row for m, row in errors.items()}
            ax.plot(list(rows), [row[key] for row in rows.values()], style, marker="o", ms=4,
                    color=ESTIMATORS["ours"][1], label=part or "all steps")
        ax.set_xscale("log")
        ax.set_xticks(list(rows), list(rows), minor=False)
        ax.set_xticks([], minor=True)
        ax.set(xlabel="stochastic passes M", ylabel=label, ylim=(0, 1.1 * ax.dataLim.y1))
    axes[0].legend(handlelength=3)
    save(figure, path)


def validation_loss(study, name, path):
    """Figs. likelihood_loss, mse_loss and bc_loss, by `name`: validation loss over epochs."""
    figure, ax = new(5, 3)
    stage, shown, ylabel = LOSSES[name]
    for method, (label, color) in shown.items():
        band(ax, study / stage / method, "epoch", "validation_loss", label, color, marker="o", ms=3)
    ax.set(xlabel="epoch", ylabel=f"validation {ylabel}", yscale="log" if name == "mse_loss" else "linear")
    ax.xaxis.get_major_locator().set_params(integer=True)
    if ax.lines:
        ax.legend()
    save(figure, path)


def success_rate(study, path, levels={}):
    """Fig. success_rate: held-out success over training; levels {method: rate} of methods without RL are dashed lines."""
    figure, ax = new(7, 3.6)
    for i, method in enumerate(METHODS):  # those with a curve: what PPO trained
        band(ax, study / "04_train_policy" / method, "steps", "success", *METHODS[method][:2], 1e-6, 100, zorder=2.9 - i / 10)
    for method, level in levels.items():
        name, color, _ = METHODS[method]
        ax.axhline(100 * level, color=color, ls="--", lw=1.4, label=f"{name}, after training")
    ax.set(xlabel="environment steps (millions)")
    success_axis(ax)
    if ax.lines:
        figure.legend(loc="outside right upper")
    save(figure, path)


def occlusion_duration(results, path):
    """Fig. occlusion_duration: success with Wilson intervals against the duration; results as in results.json."""
    figure, ax = new(7, 3.6)
    for i, (method, points) in enumerate(results.items()):
        name, color, marker = METHODS[method]
        mean, low, high = (100 * np.array([p[key] for p in points.values()]) for key in ("mean", "low", "high"))
        x = np.arange(len(points)) + 0.05 * (i - (len(results) - 1) / 2)  # side by side, so that no bar hides another
        ax.errorbar(x, mean, (mean - low, high - mean), color=color, marker=marker, ms=5, capsize=2, elinewidth=1,
                    label=name)
    ax.set_xticks(range(len(points)), [{"0": "none"}.get(key, key) for key in points])
    episodes = next(iter(points.values()))["episodes"]
    ax.set(xlabel="occlusion duration (s)", title=f"{episodes:,} episodes a point, 95 % intervals")
    success_axis(ax)
    figure.legend(loc="outside right upper")
    save(figure, path)


def trajectory_with_uncertainty(episodes, path, cases, count, index):
    """Fig. trajectory_with_uncertainty: the true and the estimated box at six instants, and the estimator's variance below.

    Args:
        episodes: {method: film.Recorded.episode}.
        cases, count: in how many episodes of the list the first method succeeds and the second fails.
        index: of the episode in the list.
    """
    figure, axes = new(10, 5.6, 2, len(episodes), sharex="row", sharey="row", squeeze=False, height_ratios=(1.25, 1))
    for (view, chart), (method, episode) in zip(axes.T, episodes.items()):
        name, color, _ = METHODS[method]
        state, belief, xi = episode["state"], episode["belief"], episode["o"][:, 8]
        t = np.arange(len(state)) / task.RATE
        q_hat = task.unscale_pose(belief[:, :4])
        failure = "leaves the workspace" if task.outside(state[-1, :3], state[-1, 3:5]) else "runs out of time"
        view.set(title=f"{name} {'succeeds' if episode['success'] else failure} after {t[-1]:.1f} s", aspect="equal",
                 xlabel="x (m)", xlim=(-0.34, 0.34), ylim=(-0.19, 0.19))
        view.grid(False)
        view.add_patch(Rectangle(-task.HALF, *task.WORKSPACE, fill=False, ec="0.6", lw=1))
        view.add_patch(Polygon(corners(np.zeros(3)), fc="#AACDF0", ec="none", label="target"))
        view.plot(*state[:, 3:5].T, color="#D22828", lw=1, clip_on=False, label="pusher")
        view.add_patch(Circle(state[-1, 3:5], task.RADIUS, color="#D22828", clip_on=False))
        for k, i in enumerate(np.linspace(0, len(state) - 1, 6).astype(int)):
            shade = matplotlib.colormaps["viridis"](0.95 * (1 - k / 5))
            for pose, label, style in ((state[i], "true box", "-"), (q_hat[i], "estimate", (0, (2, 1.5)))):
                view.add_patch(Polygon(corners(pose), fill=False, ec=shade, lw=1.6, ls=style, clip_on=False,
                                       label=label if k == 5 else None))
            chart.plot(t[i], variance(belief[i]), "o", color=shade, ms=7, zorder=3)
        chart.plot(t, variance(belief), color=color, label=r"predicted $\sigma_x^2 + \sigma_y^2$")
        error = 1e6 * ((q_hat - state[:, :3])[:, :2] ** 2).sum(1)
        chart.plot(t, error, color="0.45", lw=1, ls=":", label="squared position error")
        chart.fill_between(t, 0, 1, xi > 0, transform=chart.get_xaxis_transform(), color="0.93", lw=0, label="occluded")
        chart.set(xlabel="time (s)", yscale="log")
    axes[0, 0].set(ylabel="y (m)")
    axes[1, 0].set(ylabel="position variance (mm²)")
    axes[1, 0].set_ylim(bottom=max(0.5, axes[1, 0].get_ylim()[0]))
    handles, labels = (sum(pair, []) for pair in zip(*(ax.get_legend_handles_labels() for ax in axes[:, 0])))
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    first, second = (METHODS[method][0] for method in episodes)
    figure.suptitle(f"Full occlusion, episode {index} of the list. In {cases:,} of {count:,} episodes {first} succeeds "
                    f"and {second} fails", fontsize=10)
    save(figure, path)


def variance(belief):
    """Sum (...) of the predicted variances of x and y, in mm^2, of beliefs (..., 12)."""
    return 1e6 * ((belief[..., 8:10] * task.HALF) ** 2).sum(-1)


def sim(path):
    """Fig. sim: the environment at a start of the study."""
    world = PushEnv("rgb_array")
    world.reset(seed=0)
    write_atomic(path, lambda temporary: cv2.imwrite(str(temporary), world.render()[..., ::-1]))


def robot(columns, title, path):
    """Fig. 1: scene, camera and top view in rows; columns (time in s, occluded, three images), occluded ones framed."""
    figure, axes = new(2.6 * len(columns), 6.2, 3, len(columns), squeeze=False, height_ratios=(3, 3, 2.05))
    for column, (seconds, occluded, images) in zip(axes.T, columns):
        for ax, image in zip(column, images):
            ax.imshow(image)
            ax.set(xticks=[], yticks=[])
            ax.grid(False)
            for spine in ax.spines.values():
                spine.set(visible=True, color="#D55E00" if occluded else "0.7", lw=3 if occluded else 0.8)
        column[0].set_title(f"t = {seconds:.1f} s{', occluded' * bool(occluded)}")
    for ax, label in zip(axes[:, 0], ("scene", "robot's camera", "from above")):
        ax.set_ylabel(label)
    figure.suptitle(title, fontsize=10)
    save(figure, path)
