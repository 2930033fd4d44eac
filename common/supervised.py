"""Training on stored trajectories, for the estimators and for behaviour cloning (appendix B.2, B.3)."""
import math

import numpy as np
import torch

from common import muon, ranks, speed, trajectories
from common.files import UserError
from common.progress import bar

EXPLODED = 1e4  # norm of a gradient that came through an LSTM at the edge of chaos: of 1e5 to 1e17, not of 40


def check(data, sequences):
    """Raises UserError: there are more processes than trajectories in a mini-batch."""
    if (most := min(sequences, len(data[1]) - 1)) < ranks.COUNT:
        raise UserError(f"{ranks.COUNT} processes share a mini-batch of {most} trajectories: start at most so many")


@torch.no_grad()
def validate(loss, data, limit, sequences, device, world):
    """Mean loss over the valid steps of at most `limit` trajectories: the same noise, occlusions and dropout every time."""
    def one(job):
        batch = trajectories.observe(data, job[1], (0, 0, job[0], 2), device, world)
        return loss(*batch, torch.Generator(device).manual_seed(job[0])).item(), batch[2].sum().item()

    parts = trajectories.batches(trajectories.subset(data, limit), sequences)
    values, steps = zip(*ranks.gather(ranks.spread([*enumerate(parts)], one))[0])
    return float(np.average(values, weights=steps))


def _descend(loss, batch, draws, parameters, optimizers, grad_norm, usual):
    """One step on a mini-batch, weighed by its steps, `usual` ones on average: mean loss and valid steps of all ranks.

    None where the gradient has exploded: clipped, it points nowhere, and a few such steps in a row lose the net for good.
    """
    halves = speed.halves(batch) if ranks.COUNT == 1 else [batch]  # two threads, or a process each
    mean, steps = speed.set_gradient(loss, halves, draws, parameters)
    mean, steps = ranks.average(parameters, mean, steps)
    if torch.nn.utils.clip_grad_norm_(parameters, grad_norm) < EXPLODED:  # nor is NaN
        for parameter in parameters:  # a step counts the same in each mini-batch
            parameter.grad *= steps / usual
        for optimizer in optimizers:
            optimizer.step()
    return mean.item(), float(steps)


def fit(run, net, loss, save, data, held_out, *, seed, sequences, epochs, lr, lr_end, grad_norm, validation, optimizer, fresh):
    """Descent over shuffled trajectories, validated on those of `held_out`; False when the time limit stopped it.

    `optimizer` is "adam", or "muon" for muon.optimizers. An epoch is a resume point, a row of metrics, and draws its
    mini-batches, noise and occlusions anew or, not `fresh`, has those of the first in another order. loss(o, s, mask, generator)
    of a batch of trajectories.observe is the mean over the steps it looks at; it may run in two threads at once, draws from the
    generator alone, and needs every parameter. save() is called on rank 0 after each epoch of the lowest validation loss so
    far. Raises UserError: a loss is not finite.
    """
    parameters = list(net.parameters())
    device = parameters[0].device
    optimizers = muon.optimizers(net, lr) if optimizer == "muon" else [torch.optim.Adam(parameters, lr, fused=True)]
    count, first, best, lr_end = len(data[1]) - 1, 0, math.inf, lr if lr_end is None else lr_end
    if state := run.load_resume():
        first, best = state["epoch"], state["best"]
        several = state.get("optimizers") or [state["optimizer"]]  # of older code: one
        for part, saved in zip((net, *optimizers), (state["net"], *several)):
            part.load_state_dict(saved)
    updates, usual = math.ceil(count / sequences), data[1][-1] / count * sequences  # steps of a mini-batch
    progress = bar(epochs * updates, run.dir.parent.name, initial=first * updates, unit="update")

    def finite(value):
        if not math.isfinite(value):
            raise UserError(f"{run.dir}: training diverged in epoch {epoch + 1}: use a lower rate, and --force")
        return value

    for epoch in range(first, epochs):
        drawn = epoch if fresh else 0
        rng = np.random.default_rng([seed, drawn])
        draws = torch.Generator().manual_seed(int(np.random.default_rng([seed, epoch, ranks.RANK]).integers(2**62)))
        parts = [index[ranks.RANK::ranks.COUNT] for index in trajectories.shuffled(data, sequences, rng)
                 if len(index) >= ranks.COUNT]  # else it is left out, in this epoch
        order = np.random.default_rng([seed, epoch]).permutation(len(parts)) if drawn < epoch else range(len(parts))

        def observed(k):  # 1: to train; other numbers elsewhere
            return trajectories.observe(data, parts[k], (seed, drawn, k, 1, ranks.RANK), device, run.world)

        losses, weights = [], []
        for k, batch in enumerate(speed.ahead(observed, order)):
            fall = 1 + math.cos(math.pi * ((epoch + k / updates) / epochs))  # along a cosine from 2 to 0
            for group in (group for part in optimizers for group in part.param_groups):
                group["lr"] = lr_end + (lr - lr_end) * fall / 2
            mean, steps = _descend(loss, batch, draws, parameters, optimizers, grad_norm, usual)
            losses.append(finite(mean))
            weights.append(steps)
            progress.update()
            progress.set_postfix_str(f"loss {losses[-1]:.3f}", refresh=False)
        validation_loss = finite(validate(loss, held_out, validation, sequences, device, run.world))
        run.log(epoch=epoch + 1, train_loss=float(np.average(losses, weights=weights)), validation_loss=validation_loss)
        if validation_loss < best:
            best = validation_loss
            ranks.lead(save)()
        run.save_resume(dict(epoch=epoch + 1, best=best, net=net.state_dict(),
                             optimizers=[part.state_dict() for part in optimizers]))
        if run.out_of_time() and epoch + 1 < epochs:
            run.stop()
            return False
    return True


def outcome(run):
    """What config.json keeps of a finished training: its epochs, and the loss of the epoch that was saved."""
    losses = [row["validation_loss"] for row in run.rows()]
    return {"epochs": len(losses), "validation_loss": min(losses)}
