"""Speed, apart from the mathematics: every trick here gives what its plain form gives, sooner (tests/test_speed.py)."""
import contextlib
import ctypes
import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

WIDTH = 16  # sequences side by side in PPO are a multiple of it: at 149, a prime, oneDNN's LSTM takes 3 times as long as at 144
one_thread = {"initializer": torch.set_num_threads, "initargs": (1,)}  # OpenMP keeps its number per thread
workers = 2  # threads of the pool
pool = ThreadPoolExecutor(workers, **one_thread)  # runs independent jobs side by side; a job must not wait for another


def set_up(threads=2, processes=1):
    """Makes the process a stage's: one thread inside an operation, `threads` above it, freed memory kept.

    Of several `processes` on this machine each has its share of the cores, and no more threads than these.

    Two threads inside an operation wait for each other at each, and for any other job: 30 times slower on a busy machine. And
    a training takes and frees arrays of the same sizes all the time, whose pages the kernel would zero anew, a fifth of PPO's
    time: with glibc they stay, in one arena for all threads (in a thread's own none above 64 MB would).
    """
    global pool, workers
    torch.set_num_threads(1)
    torch.backends.cuda.matmul.allow_tf32 = True  # as cuDNN's LSTM does anyway
    workers = threads if processes == 1 else max(1, min(threads, os.cpu_count() // processes))
    pool = ThreadPoolExecutor(workers, **one_thread)
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in ((-8, 1), (-4, 0), (-1, -1)):  # M_ARENA_MAX, M_MMAP_MAX, M_TRIM_THRESHOLD
            mallopt(parameter, value)


def side_by_side(function, *arguments):
    """list(map(function, *arguments)), in the pool's threads."""
    return list(pool.map(function, *arguments))


def ahead(function, arguments):
    """map(function, arguments), the next result computed in a thread while the last one is in use."""
    with ThreadPoolExecutor(1, **one_thread) as worker:
        coming = deque()
        for argument in arguments:
            coming.append(worker.submit(function, argument))
            if len(coming) > 1:
                yield coming.popleft().result()
        yield from (last.result() for last in coming)


def autocast(device):
    """bfloat16 autocast on a CPU that computes in it, else float32: CUDA's runs an LSTM in float16, too coarse for PPO."""
    device = torch.device(device)
    return _bfloat16(device, device.type == "cpu" and torch.cpu._is_avx512_bf16_supported())


def _bfloat16(device, enabled):
    """Autocast without its cache of weights, which would share their graph between threads."""
    return torch.autocast(device.type, torch.bfloat16, enabled=enabled, cache_enabled=False)


class Float32Linear(nn.Linear):
    """A linear layer in float32 under any autocast, for outputs: bfloat16 would round a value near 40 by up to 0.125."""

    def forward(self, x):
        with _bfloat16(x.device, enabled=False):
            return super().forward(x.float())


def dropout(x, p, generator=None):
    """F.dropout, p rounded to 256ths, with a random byte an element: six times as fast on a CPU, where masks cost most."""
    drop = min(round(256 * p), 255)
    if drop == 0:
        return x
    draws = torch.empty((x.numel() + 7) // 8, dtype=torch.int64, device=x.device).random_(-2**63, None, generator=generator)
    keep = draws.view(torch.int8)[:x.numel()].view(x.shape).clamp_(drop - 129, drop - 128).sub_(drop - 129)  # 0 or 1
    return x * keep * (256 / (256 - drop))


class EvenLSTM(nn.LSTM):
    """An LSTM that gives odd inputs one more, always zero: oneDNN's matrix units take even widths only, three times as fast."""

    def __init__(self, inputs, size):
        super().__init__(inputs + inputs % 2, size)
        self.odd = inputs % 2

    def forward(self, x, hidden=None):
        return super().forward(F.pad(x, (0, self.odd)), hidden)


def passes(head, z, count):
    """`count` calls of head(z, generator), each with draws of its own, stacked: outputs (count, *z.shape[:-1], .).

    Several calls at a time, as one on the expanded z: all of them where that is small, else as many as the memory allows, and
    at least two parts, on a CPU in the pool's threads. The draws are the same for any number of threads.
    """
    small = count * z.numel() <= 2**16
    at_once = min(max(1, 2**15 // z[..., 0].numel()), count if small else (count + 1) // 2)
    counts = [min(at_once, count - i) for i in range(0, count, at_once)]
    seeds, graph = torch.randint(2**62, (len(counts),)).tolist(), torch.is_grad_enabled()

    def several(part, seed):  # in a thread that knows no autocast or no_grad of ours
        with torch.set_grad_enabled(graph), _bfloat16(z.device, z.dtype == torch.bfloat16):
            return head(z.expand(part, *z.shape), torch.Generator(z.device).manual_seed(seed))

    outputs = (map if small or z.device.type != "cpu" else side_by_side)(several, counts, seeds)
    return [None if parts[0] is None else torch.cat(parts) for parts in zip(*outputs)]


def fewer(wanted):
    """Indices into (N,) bool of what is wanted, with some others to make a multiple of WIDTH; all where that spares little."""
    few = np.argsort(~wanted, kind="stable")[:-(-wanted.sum() // WIDTH) * WIDTH]
    return np.sort(few) if len(few) <= 0.9 * len(wanted) else np.arange(len(wanted))


def halves(batch):
    """A padded batch (T, B, .), its mask (T, B) last, in two halves, each cut to its longest; one alone, or a GPU's, whole."""
    if batch[0].is_cuda or batch[0].shape[1] == 1:
        return [batch]
    parts = [[x[:, i::2] for x in batch] for i in range(2)]
    return [[x[:int(part[-1].sum(0).max())].contiguous() for x in part] for part in parts]


def set_gradient(loss, parts, draws, parameters):
    """Sets the gradient of the loss, a mean over the valid steps of a batch, from its parts (`halves`), each in a thread.

    loss(*part, generator) needs every parameter; `draws` is the generator of the parts' seeds.
    Returns the loss (1,) and the number of valid steps.
    """
    steps = [part[-1].sum().item() for part in parts]

    def descent(part, count, seed):
        value = loss(*part, torch.Generator(part[0].device).manual_seed(seed)) * (count / sum(steps))
        return value.detach()[None], torch.autograd.grad(value, parameters)

    seeds = torch.randint(2**62, (len(parts),), generator=draws).tolist()
    values, gradients = zip(*side_by_side(descent, parts, steps, seeds))
    for parameter, *shares in zip(parameters, *gradients):
        parameter.grad = sum(shares)
    return sum(values), sum(steps)
