"""Stored trajectories of clean states: memory-mapped arrays, padded batches, and the errors of estimates on them."""
import numpy as np
import torch

from common import calibration, observation, ranks, runs, speed, symmetry, task
from common.files import UserError

POOL = 16  # mini-batches that are sorted by length together: random ones are a quarter padding


def load(states_path, offsets_path):
    """States (steps, 7) float32, memory-mapped, and offsets (n + 1,): trajectory i is states[offsets[i]:offsets[i + 1]].

    Raises UserError if the two files do not belong together, or are damaged.
    """
    try:
        states, offsets = np.load(states_path, mmap_mode="r"), np.load(offsets_path)
        if states.shape != (offsets[-1], 7):
            raise ValueError
    except (ValueError, OSError, EOFError, IndexError):
        raise UserError(f"{states_path} is damaged: rerun 02_collect.py with --force") from None
    return states, offsets


def files(name):
    """File names of a set: train, validation, test, teacher_train or teacher_validation."""
    return [f"{name}_states.npy", f"{name}_offsets.npy"]


def load_set(cfg, name):
    """A set of 02_collect, and the paths it was read from."""
    paths = {file: runs.find(cfg, "02_collect", file) for file in files(name)}
    return load(*paths.values()), paths


def padded(data, index):
    """Trajectories `index` as states (T, B, 7) and mask (T, B); the last state is repeated behind a trajectory's end."""
    states, offsets = data
    start, length = offsets[index], offsets[index + 1] - offsets[index]
    t = np.arange(length.max())[:, None]
    return states[start + np.minimum(t, length - 1)], (t < length).astype(np.float32)


def batches(indices, size):
    """Indices of trajectories in batches of `size`, the last one what is left."""
    return [indices[i:i + size] for i in range(0, len(indices), size)]


def shuffled(data, size, rng):
    """Indices of all trajectories in batches of `size` in random order; those of a batch are of similar length."""
    lengths = np.diff(data[1])
    pools = batches(rng.permutation(len(lengths)), POOL * size)
    parts = [part for pool in pools for part in batches(pool[lengths[pool].argsort(kind="stable")], size)]
    return [parts[i] for i in rng.permutation(len(parts))]


def subset(data, limit):
    """Indices of at most `limit` trajectories, evenly spaced over a set, which is in the order of its checkpoints."""
    total = len(data[1]) - 1
    return np.linspace(0, total - 1, min(limit, total)).astype(int)


def observe(data, index, seed, device, world=task.World()):
    """Batch of freshly drawn o (T, B, 9) and scaled true states (T, B, 8), mirrored by o[0] as in a stack, and mask (T, B)."""
    states, mask = padded(data, index)
    o = observation.ObservationModel(len(index), seed, world=world).trajectory(states)
    sign = symmetry.signs(o[0])
    o, s = symmetry.mirror(o, sign), symmetry.mirror(task.scale(states, world.max_force), sign)
    return tuple(torch.as_tensor(x, device=device) for x in (o, s, mask))


def pose_errors(q_hat, q, occluded, mask):
    """Errors of scaled poses (T, B, 4), summed over the valid steps of each trajectory; occluded, mask (T, B).

    {"all" | "seen" | "occluded": (5, B) sums of (1, |d_xy|, |d_xy|^2, |d_theta|, d_theta^2) in m and rad}.
    """
    error, occluded, mask = calibration.pose_error(q_hat, q), occluded > 0, mask > 0
    l2, angle = np.linalg.norm(error[..., :2], axis=-1), np.abs(error[..., 2])
    terms = np.stack([np.ones_like(l2), l2, l2**2, angle, angle**2])
    steps = {"all": mask, "seen": mask & ~occluded, "occluded": mask & occluded}
    return {name: (terms * chosen).sum(1) for name, chosen in steps.items()}


def compared(q_hat, variance, q, occluded, mask, scale=None):
    """`pose_errors`, and of estimates that tell a variance (T, B, 4) calibration's tallies (., B), also of it scaled."""
    told = pose_errors(q_hat, q, occluded, mask)
    if variance is not None and variance.any():
        told |= {name: calibration.tally(q_hat, variance * np.square(factors), q, occluded, mask).T
                 for name, factors in zip(calibration.TALLIES, ([1.0], scale)) if factors}
    return told


def in_the_loop(env, length, success, scale=None):
    """Of the beliefs while a policy played, from a film.Recorded `env`, lengths and success (N,) of the episodes: for each
    episode `compared`'s parts, and calibration's "course".
    """
    rows = env.rows[:length.max()]
    state, o, belief = (np.stack([row[name] for row in rows]).astype(float) for name in ("state", "o", "belief"))
    q = symmetry.mirror(task.scale(state), symmetry.signs(o[0]))[..., :4]
    mask, variance = (np.arange(len(q))[:, None] < length).astype(np.float32), np.square(belief[..., 8:])
    told = compared(belief[..., :4], variance, q, o[..., 8], mask, scale)
    if "calibration" in told:
        told["course"] = calibration.course(variance, length, success, env.unwrapped.world.horizon).T
    return [dict(zip(told, values)) for values in zip(*(sums.T.tolist() for sums in told.values()))]


@torch.no_grad()
def measure(data, limit, size, seed, device, predict, world=task.World(), scale=None):
    """`compared` for predict(o), poses and variances (T, B, 4) or none, over at most `limit` trajectories, `size` at a time.

    Each process measures some, and rank 0 has them all, the others none. The noise is the same for every predict. Seeds torch
    for each batch.
    """
    def one(job):
        k, index = job
        o, s, mask = observe(data, index, (seed, 0, k, 3), device, world)
        torch.manual_seed(int(np.random.SeedSequence([seed, k]).generate_state(1)[0]))
        with speed.autocast(device):
            told = predict(o)
        arrays = [x if x is None else x.double().cpu().numpy() for x in (*told, s[..., :4], o[..., 8], mask)]
        return compared(*arrays, scale)

    parts = ranks.spread([*enumerate(batches(subset(data, limit), size))], one)
    return {name: np.concatenate([part[name] for part in parts], 1) for name in (parts[0] if parts else ())}
