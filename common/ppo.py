"""Recurrent PPO (Schulman et al. 2017) with the paper's hyper-parameters: rollout, gae, update. The loop is training.py's.

PPO sees only a vector env: every policy of the study is another stack of wrappers.
"""
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch.nn import functional as F

from common import ranks, speed
from common.command import setting
from common.networks import forget, log_prob, log_softmax, sample


@dataclass
class Hyperparameters:
    num_envs: int = 4000  # parallel worlds, of all processes together (tab. hyperparameters)
    rollout_steps: int = 100  # steps of each world per update (tab. hyperparameters)
    updates: int = 2000  # rollouts, each followed by an update; the paper gives no number
    minibatch: int = 25000  # steps per mini-batch (tab. hyperparameters)
    epochs: int = 5  # passes over a rollout (tab. hyperparameters)
    clip: float = 0.2  # clip range epsilon (tab. hyperparameters)
    gamma: float = 0.993  # discount factor (tab. hyperparameters)
    lam: float = 0.95  # GAE parameter lambda (tab. hyperparameters)
    entropy_coef: float = setting(0.01, was="entropy")  # entropy loss coefficient (tab. hyperparameters)
    value_coef: float = setting(1.0, was="value")  # value loss coefficient (tab. hyperparameters)
    kl_target: float = 7e-3  # target of the KL-adaptive learning rate (appendix B.1)
    kl_target_end: float | None = None  # the target at the end, linearly approached; none: it stays, as the paper's
    lr_min: float = 1.5e-4  # least learning rate (appendix B.1)
    lr_max: float = 1e-2  # greatest learning rate (appendix B.1)
    lr: float = 1e-3  # first learning rate; the paper gives none
    grad_norm: float = 1.0  # clip of the gradient norm, policy and value apart; the paper names none
    sizes: tuple[int, int, int] = (128, 256, 128)  # linear, LSTM and linear layer of the policy and value nets (appendix B.1)
    tolerance: float = 1.0  # curriculum: first factor on the success tolerance (training.lowered); 1 is none
    near_share: float = 0.0  # curriculum: first share of starts near the target, the pusher beside the box; falls to 0
    eval_every: int = 20  # updates between measurements of held-out success (study's starts, 1x tolerance)
    eval_episodes: int = 500  # episodes of such a measurement
    resume_every: int = 50  # updates between resume points; there all worlds start anew


def rollout(env, actor, critic, carry, steps):
    """Plays `steps` steps with sampled actions. The critic reads the whole observation, the actor its first entries or all.

    Args:
        carry: observations (N, D) and the hidden states of actor and critic, each its (h, c).
    Returns: batch: obs (T, N, D), actions (T, N, 2), logp (T, N, 2, 11), reward, terminated, done, value V(s_t) and next_value
    V(s_{t+1}) (T, N; any where terminated), success and aided (T, N) as the env tells them, hidden_pi and hidden_v at the
    start; and the next carry.
    """
    device = next(actor.parameters()).device
    obs, hidden_pi, hidden_v = carry
    start = {"hidden_pi": hidden_pi, "hidden_v": hidden_v}
    b = {"obs": np.zeros((steps, *obs.shape), np.float32), "reward": np.zeros((steps, len(obs)), np.float32)}
    b |= {name: np.zeros((steps, len(obs)), bool) for name in ("terminated", "done", "success", "aided")}
    actions, logps, value, cut = [], [], [], []

    def see(net, obs, hidden):
        with torch.no_grad(), speed.autocast(device):
            return net(torch.as_tensor(obs, device=device)[None, :, :net.inputs], hidden)

    for t in range(steps):
        b["obs"][t] = obs
        judging = speed.pool.submit(see, critic, obs, hidden_v)  # while the policy acts and the worlds move
        logits, hidden_pi = see(actor, obs, hidden_pi)
        action = sample(logits[0])
        actions.append(action)
        logps.append(log_softmax(logits[0]))
        obs, b["reward"][t], b["terminated"][t], truncated, infos = env.step(action.cpu().numpy())
        b["done"][t] = b["terminated"][t] | truncated
        b["success"][t], b["aided"][t] = infos["success"], infos["aided"]
        v, hidden_v = judging.result()
        value.append(v[0, :, 0])
        if "final_obs" in infos:
            late = np.flatnonzero(truncated & ~b["terminated"][t])
            if late.size:
                cut.append((t, late, see(critic, infos["final_obs"][late], tuple(h[:, late] for h in hidden_v))[0][0, :, 0]))
            ended = torch.as_tensor(b["done"][t], device=device)
            hidden_pi, hidden_v = forget(hidden_pi, ended), forget(hidden_v, ended)
    batch = {k: torch.as_tensor(v, device=device) for k, v in b.items()}
    batch |= start | {"actions": torch.stack(actions), "logp": torch.stack(logps), "value": torch.stack(value)}
    batch["next_value"] = torch.cat([batch["value"][1:], see(critic, obs, hidden_v)[0][..., 0]])
    for t, worlds, v in cut:  # the time limit: the episode would have gone on
        batch["next_value"][t, worlds] = v
    return batch, (obs, hidden_pi, hidden_v)


def split(done):
    """Where each step of a rollout goes when it is split at episode ends and padded to whole sequences.

        world 0:  a a a | b b        ->  a a a
        world 1:  c c c c c              b b .
                                         c c c c c

    Returns, of `done` (T, N) bool: position (T, N) in the sequence, sequence (T, N), and world (S,) and start (S,) of each.
    """
    steps, n = done.shape
    begins = torch.ones_like(done)
    begins[1:] = done[:-1]
    flat = begins.T.flatten()
    sequence = flat.cumsum(0) - 1
    first = flat.nonzero().squeeze(1)
    position = torch.arange(steps * n, device=done.device) - first[sequence]
    return position.view(n, steps).T, sequence.view(n, steps).T, first // steps, first % steps


def pad(x, position, sequence):
    """Steps (T, N, ...) as padded sequences (L, S, ...); the last of them, at least one, are empty."""
    out = x.new_zeros(int(position.max()) + 1, ((int(sequence.max()) + 1) // speed.WIDTH + 1) * speed.WIDTH, *x.shape[2:])
    out[position, sequence] = x
    return out


def gae(reward, value, next_value, terminated, done, gamma, lam):
    """Generalised advantages (T, N). A time limit bootstraps from the final observation's value; a termination does not."""
    # TD error: r_t + gamma * V(s_{t+1}) - V(s_t)
    delta = reward + gamma * next_value * ~terminated - value
    advantage = torch.zeros_like(delta)
    last = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        # A_t = delta_t + gamma * lambda * A_{t+1}
        last = delta[t] + gamma * lam * last * ~done[t]
        advantage[t] = last
    return advantage


def moments(x):
    """Mean and standard deviation of x over all processes."""
    count, total = ranks.totals(x.numel(), x.double().sum())
    squares, = ranks.totals((x.double() - total / count).square().sum())
    return total / count, math.sqrt(squares / max(count - 1, 1))


def sequences(batch, gamma, lam):
    """A rollout as padded sequences (L, S, ...), with advantages, returns and the hidden states at their starts."""
    advantage = gae(*(batch[name] for name in ("reward", "value", "next_value", "terminated", "done")), gamma, lam)
    returns = advantage + batch["value"]
    mean, std = moments(advantage)
    explained = 1 - (std / (moments(returns)[1] + 1e-8))**2
    advantage = (advantage - mean) / (std + 1e-8)
    position, sequence, world, start = split(batch["done"])
    seq = {name: pad(x, position, sequence) for name, x in {
        "obs": batch["obs"], "actions": batch["actions"], "logp": batch["logp"], "advantage": advantage, "returns": returns,
        "mask": torch.ones_like(advantage)}.items()}

    def at_start(hidden):
        return tuple(F.pad(h[:, world] * (start == 0)[None, :, None], (0, 0, 0, seq["mask"].shape[1] - len(world)))
                     for h in hidden)

    return seq | {name: at_start(batch[name]) for name in ("hidden_pi", "hidden_v")} | {"explained": explained}


def _columns(seq, cols, *names):
    """The named entries of the sequences `cols` of a padded rollout, cut to the longest."""
    rows = int(seq["mask"][:, cols].sum(0).max())
    return [seq[name][:rows, cols] for name in names]


def _mean(x, mask):
    return (x * mask).sum() / mask.sum()


def policy_loss(actor, seq, cols, hp):
    """Clipped surrogate with entropy bonus over valid steps; and the loss, entropy, KL from the old policy, clip fraction."""
    mask, obs, actions, old, advantage = _columns(seq, cols, "mask", "obs", "actions", "logp", "advantage")
    with speed.autocast(obs.device):
        logits = actor(obs[..., :actor.inputs], tuple(h[:, cols] for h in seq["hidden_pi"]))[0]
    logp = log_softmax(logits)
    ratio = (log_prob(logp, actions) - log_prob(old, actions)).exp()
    surrogate = _mean(torch.minimum(ratio * advantage, ratio.clamp(1 - hp.clip, 1 + hp.clip) * advantage), mask)
    entropy = _mean(-(logp.exp() * logp).sum((-1, -2)), mask)
    kl = _mean((old.exp() * (old - logp)).sum((-1, -2)), mask)
    clipped = _mean(((ratio - 1).abs() > hp.clip).float(), mask)
    loss = -surrogate - hp.entropy_coef * entropy
    return loss, torch.stack([loss, entropy, kl, clipped]).detach()


def value_loss(critic, seq, cols, hp):
    """Squared error to the returns, averaged over valid steps; and itself without its coefficient."""
    mask, obs, returns = _columns(seq, cols, "mask", "obs", "returns")
    with speed.autocast(obs.device):
        v = critic(obs, tuple(h[:, cols] for h in seq["hidden_v"]))[0].squeeze(-1)
    loss = _mean((v - returns).square(), mask)
    return hp.value_coef * loss, loss.detach()[None]


def optimizer(net, lr):
    return torch.optim.Adam(net.parameters(), lr=lr, eps=1e-5, fused=True)


def _descend(net, optimizer, loss, group, seq, batches, hp):
    """One step of Adam a mini-batch; what else the loss returned, (mini-batches, .), over all processes, as the gradient is.

    Gradients are clipped per net: together the value's would drown the policy's.
    """
    stats = []
    for cols in batches:
        objective, extra = loss(net, seq, cols, hp)
        optimizer.zero_grad(set_to_none=True)
        objective.backward()
        extra, _ = ranks.average(net.parameters(), extra, seq["mask"][:, cols].sum(), group)
        torch.nn.utils.clip_grad_norm_(net.parameters(), hp.grad_norm)
        optimizer.step()
        stats.append(extra)
    return torch.stack(stats)


def adapted(lr, kl, hp):
    """The learning rate after an update with this KL divergence (appendix B.1; Heess et al. 2017; Rudin et al. 2022)."""
    if kl > 2 * hp.kl_target:
        return max(hp.lr_min, lr / 1.5)
    elif kl < hp.kl_target / 2:
        return min(hp.lr_max, lr * 1.5)
    return lr


def update(actor, critic, optimizers, seq, hp):
    """`hp.epochs` passes of PPO over a rollout's sequences; the learning rate follows the KL of the last pass.

    The two nets share nothing: each descends in a thread of its own, with its own of the two `optimizers`. All processes make
    the same number of mini-batches, each of its own sequences.

    Returns: means over the last pass of policy_loss, entropy, kl, clip_fraction and value_loss; the next lr; and explained,
    the share of the returns' variance that the value net explained before the update.
    """
    count = int(seq["mask"][0].sum())
    counts, steps = zip(*ranks.gather((count, seq["mask"].sum().item())))
    per_epoch = min(*counts, max(1, round(sum(steps) / hp.minibatch)))
    block = speed.WIDTH if count > speed.WIDTH * (per_epoch - 1) else 1

    def deal():
        """All sequences in random order, in mini-batches of whole blocks, filled up with the empty one after the last."""
        order = F.pad(torch.randperm(count), (0, -count % block), value=count).to(seq["mask"].device)
        return [blocks.flatten() for blocks in order.view(-1, block).tensor_split(per_epoch)]

    batches = [cols for _ in range(hp.epochs) for cols in deal()]
    both = map if seq["mask"].is_cuda and ranks.COUNT > 1 else speed.side_by_side  # nccl knows one order of collectives
    stats = [*both(lambda *own: _descend(*own, seq, batches, hp),
                   (actor, critic), optimizers, (policy_loss, value_loss), ranks.groups)]
    last_pass = torch.cat(stats, 1)[-per_epoch:].mean(0).tolist()
    stats = dict(zip(("policy_loss", "entropy", "kl", "clip_fraction", "value_loss"), last_pass))
    lr = adapted(optimizers[0].param_groups[0]["lr"], stats["kl"], hp)
    for optimizer in optimizers:
        optimizer.param_groups[0]["lr"] = lr
    return stats | {"explained": seq["explained"], "lr": lr}
