"""Training on stored trajectories, for the estimators and for behaviour cloning (appendix B.2, B.3)."""
import math

import numpy as np
import torch

from common import artifacts, trajectories


def fit(run, net, loss, save, data, held_out, *, seed, sequences, epochs, lr, lr_end, grad_norm, validation):
    """Adam over shuffled trajectories; an epoch is a resume point and draws its noise and occlusions afresh.

    Args:
        run: artifacts.Run; metrics get a row an epoch.
        loss: loss(data, index, (seed, epoch, mini-batch, purpose)) returns the loss, averaged over the steps it looks at,
            and the number of valid steps.
        save: called after each epoch with the lowest validation loss so far.
        data, held_out: trajectories to train and to validate on.
        sequences, epochs, lr, lr_end (none: lr), grad_norm, validation: as in the stages' Config.
    Raises:
        artifacts.UserError: the validation loss is not finite.
    Returns:
        True when trained to the end, False when the time limit stopped it.
    """
    optimizer = torch.optim.Adam(net.parameters(), lr=lr)
    lr_end = lr if lr_end is None else lr_end
    count, first, best = len(data[1]) - 1, 0, math.inf
    if state := run.load_resume():
        net.load_state_dict(state["net"]), optimizer.load_state_dict(state["optimizer"])
        first, best = state["epoch"], state["best"]
    updates, usual = math.ceil(count / sequences), data[1][-1] / count * sequences  # steps of a mini-batch
    bar = artifacts.bar(epochs * updates, run.dir.parent.name, initial=first * updates, unit="update")
    for epoch in range(first, epochs):
        rng = np.random.default_rng([seed, epoch])
        torch.manual_seed(int(rng.integers(2**62)))
        losses, weights = [], []
        for k, index in enumerate(trajectories.shuffled(data, sequences, rng)):
            progress = (epoch + k / updates) / epochs
            optimizer.param_groups[0]["lr"] = lr_end + (lr - lr_end) * (1 + math.cos(math.pi * progress)) / 2
            value, steps = loss(data, index, (seed, epoch, k, 1))  # the last number keeps apart what the seeds are for
            optimizer.zero_grad(set_to_none=True)
            share = steps / usual  # a step counts the same in every mini-batch, clipped or not
            (value * share).backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), grad_norm * share)
            optimizer.step()
            losses.append(value.item()), weights.append(steps)
            bar.update()
            bar.set_postfix_str(f"loss {losses[-1]:.3f}", refresh=False)
        torch.manual_seed(seed)
        with torch.no_grad():  # the same noise, occlusions and dropout every epoch
            batches = trajectories.batches(trajectories.subset(held_out, validation), sequences)
            values, steps = zip(*(loss(held_out, index, (0, 0, k, 2)) for k, index in enumerate(batches)))
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
