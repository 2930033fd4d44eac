"""Is sigma true? Coverage, NLL, CRPS and NEES of predicted Gaussians, and whether sigma foresees a failure."""
import math

import numpy as np
import torch

from common import task

UNITS = np.array([1e3, 1e3, np.rad2deg(1)])  # x, y in mm, theta in degrees
BOUNDS = (0.32, 0.67, 1.0, 1.28, 1.64, 2.0)  # of central intervals, in sigmas
LEVELS = [math.erf(bound / 2**0.5) for bound in BOUNDS]  # the share of a Gaussian within each: 25, 50, 68, 80, 90, 95 %
EDGES = np.geomspace(1, 32, 6)  # mm, of sigma in x and y together: error against sigma
AGES = range(11)  # s since the box was last seen
SOON = 2 * task.RATE  # steps within which a failure is to be foreseen
SCORES = ("sigma", "rise", "time", "sigma_minus_time")  # what foresees a failure; last, sigma's area minus time's
TALLIES = ("calibration", "scaled")  # of the predicted sigma, and of it times the scale that the validation set gave
# Of a tally, with their widths; a part that comes to mean another thing takes another name, and 05 measures it anew
PARTS = {"ratios": 4, "within": 3 * len(LEVELS), "nll": 3, "crps": 3, "count": len(EDGES) + 1,
         "squares": len(EDGES) + 1, "variances": len(EDGES) + 1, "aged": len(AGES), "nees": len(AGES)}
SUMMARY = 2  # one more whenever error_table or `summary` tell something else: 05 measures anew what it stores as such


def pose_error(q_hat, q):
    """Errors (..., 3) in m, m, rad of scaled poses (..., 4)."""
    error = task.unscale_pose(q_hat) - task.unscale_pose(q)
    error[..., 2] = task.wrap(error[..., 2])
    return error


def deviations(q_hat, variance, q):
    """Errors and standard deviations (..., 3) of x, y (mm) and theta (degrees) from scaled poses (..., 4).

    The truth lies on the unit circle, so the errors of sin and cos are those of one turn and far from independent: to first
    order theta has the variance (var_sin + var_cos) / (sin^2 + cos^2).
    """
    turned = variance[..., 2:].sum(-1, keepdims=True) / np.square(q_hat[..., 2:]).sum(-1, keepdims=True)
    return UNITS * pose_error(q_hat, q), UNITS * np.sqrt(np.concatenate([variance[..., :2] * task.HALF**2, turned], -1))


def tally(q_hat, variance, q, occluded, mask):
    """What `summary` needs of each trajectory, (B, sum of PARTS), from poses and variances (T, B, 4), flags and mask (T, B).

    Sums over the valid steps; of the NEES, e^T P^-1 e of (x, y, theta), over those at each of AGES.
    """
    error, sigma = deviations(q_hat, variance, q)
    z, mask = np.abs(error) / sigma, mask > 0
    crps = sigma * (z * torch.special.erf(torch.as_tensor(z / 2**0.5)).numpy()
                    + (2 / np.pi)**0.5 * np.exp(-z**2 / 2) - np.pi**-0.5)
    spread, off = (np.linalg.norm(x[..., :2], axis=-1) for x in (sigma, error))
    bins = np.digitize(spread, EDGES)[..., None] == np.arange(len(EDGES) + 1)
    steps = np.arange(len(mask))[:, None]
    age = steps - np.maximum.accumulate(np.where(occluded > 0, 0, steps))
    aged = age[..., None] == task.RATE * np.array(AGES)
    terms = [np.square(q_hat - q) / variance, np.concatenate([z <= bound for bound in BOUNDS], -1),
             z**2 / 2 + np.log(2 * np.pi * sigma**2) / 2, crps,
             bins, bins * off[..., None]**2, bins * spread[..., None]**2, aged, aged * np.square(z).sum(-1)[..., None]]
    return np.concatenate([(term * mask[..., None]).sum(0) for term in terms], 1)


def parts(tallies):
    """{name: (N, width)} of tallies (N, sum of PARTS)."""
    return dict(zip(PARTS, np.split(np.asarray(tallies, float), np.cumsum([*PARTS.values()])[:-1], 1)))


def scale(tallies):
    """Factors (4,) on the standard deviations of x, y, sin and cos that make these steps the most likely."""
    sums = parts(tallies)
    return np.sqrt(sums["ratios"].sum(0) / sums["count"].sum()).tolist()


def bootstrap(statistic, count):
    """statistic(weights (count,)) with all weights 1, and its 95 % interval where they tell how often each of `count`
    independent ones was drawn; what a draw cannot tell is nan.
    """
    rng = np.random.default_rng(0)
    values = [statistic(rng.multinomial(count, np.full(count, 1 / count))) for _ in range(200)]
    low, high = np.nanpercentile(values, (2.5, 97.5), axis=0)
    return {"mean": statistic(np.ones(count)), "low": low, "high": high}


def summary(tallies):
    """Calibration of tallies (N, sum of PARTS): shares within 1 and 2 sigma, with intervals, NLL and CRPS of x, y (mm), theta
    (degrees); the curve, {level: shares}; of bins of sigma (mm) the root mean square error (mm); and the NEES / 3, 1 if true,
    at those of AGES that there are, each a mean over so many trajectories.
    """
    sums = parts(tallies)
    steps, ages = sums["count"].sum(), sums["aged"].any(0).sum()  # who comes to 3 s came to 2 s
    aged = sums["aged"][:, :ages]
    reached, nees = aged > 0, sums["nees"][:, :ages] / 3 / np.maximum(aged, 1)  # one value a trajectory
    within = bootstrap(lambda weights: weights @ sums["within"] / (weights @ sums["count"].sum(1)), len(nees))
    within = {name: x.reshape(-1, 3).tolist() for name, x in within.items()}
    count = np.maximum(sums["count"].sum(0), 1)

    def mean_nees(weights):
        told = weights @ reached
        return np.divide(weights @ nees, told, out=np.full(ages, np.nan), where=told > 0)

    return {f"within_{k}_sigma": {name: x[of] for name, x in within.items()} for k, of in ((1, 2), (2, 5))} | {
        name: (sums[name].sum(0) / steps).tolist() for name in ("nll", "crps")} | {
        "curve": dict(zip(map("{:.3f}".format, LEVELS), within["mean"])), "steps": sums["count"].sum(0).tolist(),
        **{f"{name}_mm": np.sqrt(sums[of].sum(0) / count).tolist() for name, of in (("sigma", "variances"), ("rmse", "squares"))},
        "nees": {name: x.tolist() for name, x in bootstrap(mean_nees, len(nees)).items()},
        "nees_count": reached.sum(0).tolist()}


def course(variance, length, success, horizon):
    """Of each episode (N, 2 + seconds): length, whether it left the workspace (nan where the time was out, or all used), and
    sigma in mm at each second.

    From scaled variances (T, N, 4), lengths (N,), success (N,) and the most steps that there can be.
    """
    left = np.where(success, 0.0, np.where(length < horizon, 1.0, np.nan))
    sigma = np.full((horizon, len(length)), np.nan)
    sigma[:len(variance)] = 1e3 * np.sqrt((variance[..., :2] * task.HALF**2).sum(-1))
    return np.column_stack([length, left, sigma[::task.RATE].T])


def area(score, label, weight):
    """Area under the ROC curve of scores with 0-1 labels, each counted `weight` times; ties count half; nan of one label."""
    _, rank = np.unique(score, return_inverse=True)
    yes, no = (np.bincount(rank, weight * chosen) for chosen in (label, 1 - label))
    pairs = yes.sum() * no.sum()
    return float((yes * (np.cumsum(no) - no / 2)).sum() / pairs) if pairs else math.nan


def foreseen(courses):
    """How well sigma tells, each second of an episode from 2 s on (the first sigma enters the rise at 1 s), whether it leaves
    the workspace within 2 s, from `course`'s rows: areas under ROC curves of sigma, its rise in the last second and elapsed
    time alone, and sigma's minus time's, with intervals over episodes. Time-outs left out; none if there is nothing to tell
    apart.
    """
    courses = np.asarray(courses, float)
    courses = courses[np.isfinite(courses[:, 1])]
    (length, left), sigma = courses[:, :2].T, courses[:, 2:]
    seconds = np.arange(sigma.shape[1])
    episode, second = np.nonzero((task.RATE * seconds < length[:, None]) & (seconds > 1))
    now = sigma[episode, second]
    label = left[episode] * (length[episode] - task.RATE * second <= SOON)
    if not 0 < label.sum() < len(label):
        return None
    scores = now, now - sigma[episode, second - 1], second

    def areas(weights):
        by = [area(score, label, weights[episode]) for score in scores]
        return np.array([*by, by[0] - by[2]])

    told = bootstrap(areas, len(length))
    return {score: {name: float(x[i]) for name, x in told.items()} for i, score in enumerate(SCORES)} | {
        "episodes": len(length), "left": int(left.sum())}
