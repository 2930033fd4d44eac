"""A stage in several processes: torchrun starts them and tells each its rank; without it there is one, and all of this is free.

Every process runs the whole script on its share of the work. Rank 0 alone locks, writes, logs and shows the bar. What sums or
shares out is called by all ranks in the same order; what two threads call at a time has a group for each.
"""
import functools
import os
import time
from datetime import timedelta

import torch
import torch.distributed as dist

RANK, COUNT, LOCAL, LOCAL_COUNT = (int(os.environ.get(name, default)) for name, default in (
    ("RANK", 0), ("WORLD_SIZE", 1), ("LOCAL_RANK", 0), ("LOCAL_WORLD_SIZE", 1)))  # of all machines; of this one
PATIENCE = timedelta(days=1)  # the others wait while rank 0 draws; that a process has ended is noticed at once all the same
groups = [None, None]  # one for each of two threads, whose collectives come in another order on another rank


def begin(device):
    """Meets the other processes: gloo on CPUs, and nccl with a GPU each."""
    if COUNT > 1:
        if device.type == "cuda":
            torch.cuda.set_device(device)
        dist.init_process_group("gloo" if device.type == "cpu" else "cpu:gloo,cuda:nccl", timeout=PATIENCE)
        groups[:] = [dist.new_group(timeout=PATIENCE) for _ in groups]


def end():
    """Waits for all, and parts from them."""
    if COUNT > 1:
        dist.barrier()
        dist.destroy_process_group()


def share(count):
    """How many of `count` things are this rank's."""
    return count // COUNT + (RANK < count % COUNT)


def lead(function):
    """The function, called on rank 0 alone: what it returns or raises there, all ranks return or raise."""
    @functools.wraps(function)
    def on_rank_0(*arguments, **more):
        if COUNT == 1:
            return function(*arguments, **more)
        outcome = [None, None]
        if RANK == 0:
            try:
                outcome[0] = function(*arguments, **more)
            except Exception as failure:
                outcome[1] = failure
        dist.broadcast_object_list(outcome)
        if outcome[1]:
            raise outcome[1]
        return outcome[0]
    return on_rank_0


def gather(value):
    """Every rank's value, in a list, on every rank."""
    values = [value] * COUNT
    if COUNT > 1:
        dist.all_gather_object(values, value)
    return values


def spread(jobs, work):
    """[work(job) for job in jobs] for rank 0, every COUNT-th job done by each rank; for the others an empty list."""
    mine = [work(job) for job in jobs[RANK::COUNT]]
    if COUNT == 1:
        return mine
    done = [None] * COUNT if RANK == 0 else None
    dist.gather_object(mine, done)
    return [done[i % COUNT][i // COUNT] for i in range(len(jobs))] if RANK == 0 else []


def owners(work):
    """Ranks for jobs of so much work each, the dearest first: each goes to the rank with the least so far."""
    loads, ranks = [0] * COUNT, []
    for dear in work:
        ranks.append(loads.index(min(loads)))
        loads[ranks[-1]] += dear
    return ranks


def hand_out(tensors, ranks):
    """Gives all ranks, for each tensor, its value on the rank given."""
    if COUNT > 1:
        for tensor, rank in zip(tensors, ranks):
            dist.broadcast(tensor, rank)


def totals(*numbers):
    """Sums of numbers over all ranks."""
    sums = torch.tensor(numbers, dtype=torch.float64)
    if COUNT > 1:
        dist.all_reduce(sums)
    return sums.tolist()


def average(parameters, numbers, weight, group=None):
    """Replaces the gradients of `parameters` by their mean over all ranks, each with its weight, in one all-reduce.

    Returns the same mean of `numbers` (k,), a tensor, and the sum of the weights.
    """
    if COUNT == 1:
        return numbers, weight
    parameters = list(parameters)
    flat = torch.cat([*(p.grad.flatten() for p in parameters), numbers, numbers.new_ones(1)]) * weight
    dist.all_reduce(flat, group=group)
    *gradients, numbers = (flat[:-1] / flat[-1]).split([*(p.numel() for p in parameters), len(numbers)])
    for parameter, gradient in zip(parameters, gradients):
        parameter.grad = gradient.view_as(parameter)
    return numbers, flat[-1]


def let_the_cause_speak(failure):
    """Waits before this rank tells of a failure, so that a better placed one may do so: torchrun ends the others then.

    A mistake that all make is told by rank 0, and a lost connection is but the echo of another rank's end.
    """
    if COUNT > 1:
        echo = isinstance(failure, (dist.DistError, RuntimeError)) and any(
            word in str(failure).lower() for word in ("gloo", "nccl", "connection", "store"))
        time.sleep(5 * echo + 10 * (RANK > 0))  # s: so far may the start of one process be behind another's
