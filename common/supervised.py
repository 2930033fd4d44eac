"""Training on stored trajectories, for the estimators and for behaviour cloning (appendix B.2, B.3)."""
import math

import numpy as np
import torch

from common import artifacts, trajectories
from common.networks import threads


def halves(batch):
    """A batch in two for two threads, each as long as its longest trajectory; on a GPU, or with one trajectory, it stays whole."""
    if batch[0].is_cuda or batch[0].shape[1] == 1:
        return [batch]
    parts = [[x[:, i::2] for x in batch] for i in range(2)]
    return [[x[:int(part[2].sum(0).max())].contiguous() for x in part] for part in parts]


def fit(run, net, loss, save, data, held_out, *, seed, sequences, epochs, lr, lr_end, grad_norm, validation):
    """Adam over shuffled trajectories; an epoch is a resume point and draws its noise and occlusions afresh.

    Args:
        run: artifacts.Run; metrics get a row an epoch.
        loss: loss(o, s, mask, generator) of a batch of trajectories.observe, averaged over the steps it looks at. It runs in
            two threads at once, draws from the generator alone, and needs every parameter.
        save: called after each epoch with the lowest validation loss so far.
        data, held_out: trajectories to train and to validate on.
        sequences, epochs, lr, lr_end (none: lr), grad_norm, validation: as in the stages' Config.
    Raises:
        artifacts.UserError: the validation loss is not finite.
    Returns:
        True when trained to the end, False when the time limit stopped it.
    """
    parameters = list(net.parameters())
    device, optimizer = parameters[0].device, torch.optim.Adam(parameters, lr=lr)
    lr_end = lr if lr_end is None else lr_end
    count, first, best = len(data[1]) - 1, 0, math.inf
    if state := run.load_resume():
        net.load_state_dict(state["net"]), optimizer.load_state_dict(state["optimizer"])
        first, best = state["epoch"], state["best"]
    updates, usual = math.ceil(count / sequences), data[1][-1] / count * sequences  # steps of a mini-batch
    bar = artifacts.bar(epochs * updates, run.dir.parent.name, initial=first * updates, unit="update")

    def value_of(batch, draws):
        """Loss of a batch and its number of valid steps; `draws` seeds what the loss draws."""
        return loss(*batch, torch.Generator(device).manual_seed(draws)), batch[2].sum().item()

    def descent(batch, draws):
        """Loss, valid steps and gradients of a part of a mini-batch: a step counts the same in each, clipped or not."""
        value, steps = value_of(batch, draws)
        return value.item(), steps, torch.autograd.grad(value * (steps / usual), parameters)

    for epoch in range(first, epochs):
        rng = np.random.default_rng([seed, epoch])
        losses, weights = [], []
        for k, index in enumerate(trajectories.shuffled(data, sequences, rng)):
            progress = (epoch + k / updates) / epochs
            optimizer.param_groups[0]["lr"] = lr_end + (lr - lr_end) * (1 + math.cos(math.pi * progress)) / 2
            # the last number of the seed keeps apart what it is for
            parts = halves(trajectories.observe(data, index, (seed, epoch, k, 1), device))
            jobs = [threads.submit(descent, part, int(rng.integers(2**62))) for part in parts]
            values, steps, gradients = zip(*(job.result() for job in jobs))
            for parameter, *shares in zip(parameters, *gradients):
                parameter.grad = sum(shares)
            torch.nn.utils.clip_grad_norm_(parameters, grad_norm * sum(steps) / usual)
            optimizer.step()
            losses += values
            weights += steps
            bar.update()
            bar.set_postfix_str(f"loss {losses[-1]:.3f}", refresh=False)
        with torch.no_grad():  # the same noise, occlusions and dropout every epoch
            batches = trajectories.batches(trajectories.subset(held_out, validation), sequences)
            values, steps = zip(*(value_of(trajectories.observe(held_out, index, (0, 0, k, 2), device), k)
                                  for k, index in enumerate(batches)))
        validation_loss = float(np.average([v.item() for v in values], weights=steps))
        if not math.isfinite(validation_loss):
            raise artifacts.UserError(f"{run.dir}: training diverged in epoch {epoch + 1}: use a lower rate, and --force")
        run.log(epoch=epoch + 1, train_loss=float(np.average(losses, weights=weights)), validation_loss=validation_loss)
        if validation_loss < best:
            best = validation_loss
            save()
        run.save_resume(dict(epoch=epoch + 1, best=best, net=net.state_dict(), optimizer=optimizer.state_dict()))
        if run.out_of_time() and epoch + 1 < epochs:
            run.stop()
            return False
    return True


def outcome(run):
    """What config.json keeps of a finished training: its epochs, and the loss of the epoch that was saved."""
    losses = [row["validation_loss"] for row in run.rows()]
    return {"epochs": len(losses), "validation_loss": min(losses)}
