"""Recurrent PPO (Schulman et al. 2017) with the paper's hyper-parameters: rollout, gae, update, and the loop around them.

PPO sees only a vector env: every policy of the study is another stack of wrappers.
"""
import math
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn import functional as F

from common import artifacts, episodes
from common.networks import autocast, forget, log_prob, log_softmax, sample, threads


@dataclass
class Hyperparameters:
    num_envs: int = 4000
    """parallel worlds (tab. hyperparameters)"""
    rollout_steps: int = 100
    """steps of each world per update (tab. hyperparameters)"""
    updates: int = 2000
    """rollouts, each followed by an update; the paper gives no number"""
    minibatch: int = 25000
    """steps per mini-batch (tab. hyperparameters)"""
    epochs: int = 5
    """passes over a rollout (tab. hyperparameters)"""
    clip: float = 0.2
    """clip range epsilon (tab. hyperparameters)"""
    gamma: float = 0.993
    """discount factor (tab. hyperparameters)"""
    lam: float = 0.95
    """GAE parameter lambda (tab. hyperparameters)"""
    entropy: float = 0.01
    """entropy loss coefficient (tab. hyperparameters)"""
    value: float = 1.0
    """value loss coefficient (tab. hyperparameters)"""
    kl_target: float = 7e-3
    """target of the KL-adaptive learning rate (appendix B.1)"""
    kl_target_end: float | None = None
    """the target at the end, linearly approached; none: it stays, as the paper's"""
    lr_min: float = 1.5e-4
    """least learning rate (appendix B.1)"""
    lr_max: float = 1e-2
    """greatest learning rate (appendix B.1)"""
    lr: float = 1e-3
    """first learning rate; the paper gives none"""
    grad_norm: float = 1.0
    """clip of the gradient norm, policy and value apart; the paper names none"""
    sizes: tuple[int, int, int] = (128, 256, 128)
    """linear, LSTM and linear layer of the policy and value nets (appendix B.1)"""
    tolerance: float = 1.0
    """aid: first factor on the success tolerance, lowered by 5 % after 512 episodes of which 60 % succeed; 1 is none"""
    near_share: float = 0.0
    """aid: share of training episodes that start with the box nearer to the target and the pusher beside it, falling to 0
    over the training"""
    eval_every: int = 20
    """updates between measurements of the success rate (study's starts, 1x tolerance, worlds that no update sees)"""
    eval_episodes: int = 500
    """episodes of such a measurement"""
    resume_every: int = 50
    """updates between resume points; there all worlds start anew"""


WIDTH = 16  # sequences side by side are a multiple of it: at 149, a prime, oneDNN's LSTM takes three times as long as at 144
STATS = ("kl", "entropy", "value_loss", "ratio", "lr", "explained")  # of an update, in metrics.csv


def rollout(env, actor, critic, carry, steps):
    """Plays `steps` steps with sampled actions.

    Args:
        actor, critic: the critic reads the whole observation, the actor its first entries (stacks.Privileged) or all.
        carry: observations (N, D) and the hidden states of actor and critic, each with its own (h, c).
    Returns:
        batch: obs (T, N, D), actions (T, N, 2), logp (T, N, 2, 11), reward, terminated, done (T, N), final (T, N, D; set
        where done, and the next observation in the last row), success (episodes, successes), hidden_pi and hidden_v
        at the start; and the next carry.
    """
    device = next(actor.parameters()).device
    obs, hidden_pi, hidden_v = carry
    n, d = obs.shape
    b = {"obs": np.empty((steps, n, d), np.float32), "final": np.zeros((steps, n, d), np.float32),
         "reward": np.empty((steps, n), np.float32), "terminated": np.empty((steps, n), bool),
         "done": np.empty((steps, n), bool)}
    actions, logps, successes = [], [], 0
    start = {"hidden_pi": hidden_pi, "hidden_v": hidden_v}

    def see(net, x, hidden):
        with torch.no_grad(), autocast(device):
            return net(x, hidden)

    for t in range(steps):
        b["obs"][t] = obs
        x = torch.as_tensor(obs, device=device)[None]
        remembering = threads.submit(see, critic, x, hidden_v)  # while the policy acts and the worlds move
        logits, hidden_pi = see(actor, x[..., :actor.inputs], hidden_pi)
        action = sample(logits[0])
        actions.append(action)
        logps.append(log_softmax(logits[0]))
        obs, b["reward"][t], b["terminated"][t], truncated, infos = env.step(action.cpu().numpy())
        b["done"][t] = b["terminated"][t] | truncated
        hidden_v = remembering.result()[1]
        if "final_obs" in infos:
            b["final"][t] = infos["final_obs"]
            ended = torch.as_tensor(b["done"][t], device=device)
            hidden_pi, hidden_v = forget(hidden_pi, ended), forget(hidden_v, ended)
            successes += int((infos["success"] & b["done"][t]).sum()) if "success" in infos else 0
    b["final"][-1] = np.where(b["done"][-1][:, None], b["final"][-1], obs)
    batch = {k: torch.as_tensor(v, device=device) for k, v in b.items()}
    batch |= start | {"actions": torch.stack(actions), "logp": torch.stack(logps)}
    batch["success"] = (int(b["done"].sum()), successes)
    return batch, (obs, hidden_pi, hidden_v)


def split(done):
    """Where each step of a rollout goes when it is split at episode ends and padded to whole sequences.

        world 0:  a a a | b b        ->  a a a
        world 1:  c c c c c              b b .
                                         c c c c c

    Args:
        done: (T, N) bool.
    Returns:
        position (T, N) in the sequence, sequence (T, N), and the first world (S,) and start (S,) of each sequence.
    """
    steps, n = done.shape
    begins = torch.ones_like(done)
    begins[1:] = done[:-1]
    flat = begins.T.flatten()
    sequence = flat.cumsum(0) - 1
    first = flat.nonzero().squeeze(1)
    position = torch.arange(steps * n, device=done.device) - first[sequence]
    return position.view(n, steps).T, sequence.view(n, steps).T, first // steps, first % steps


def pad(x, position, sequence, length=None):
    """Steps (T, N, ...) as padded sequences (L, S, ...); the last of them, at least one, are empty."""
    length = length or int(position.max()) + 1
    out = x.new_zeros(length, ((int(sequence.max()) + 1) // WIDTH + 1) * WIDTH, *x.shape[2:])
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


def sequences(batch, critic, gamma, lam):
    """A rollout as padded sequences (L, S, ...), with advantages, returns and the hidden states at their starts."""
    position, sequence, world, start = split(batch["done"])
    # One more row holds what follows a sequence's last step, so that one fused pass gives V(s_t) and V(s_{t+1}).
    obs = pad(batch["obs"], position, sequence, int(position.max()) + 2)
    last = batch["done"].clone()
    last[-1] = True
    obs[position[last] + 1, sequence[last]] = batch["final"][last]

    def at_start(hidden):
        return tuple(F.pad(h[:, world] * (start == 0)[None, :, None], (0, 0, 0, obs.shape[1] - len(world))) for h in hidden)

    hidden_pi, hidden_v = at_start(batch["hidden_pi"]), at_start(batch["hidden_v"])
    with torch.no_grad(), autocast(obs.device):
        v = critic(obs, hidden_v)[0].squeeze(-1)
    value, next_value = v[position, sequence], v[position + 1, sequence]
    advantage = gae(batch["reward"], value, next_value, batch["terminated"], batch["done"], gamma, lam)
    returns = advantage + value
    explained = 1 - (returns - value).var() / returns.var()
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)

    def padded(x):
        return pad(x, position, sequence)

    return {"obs": obs[:-1], "hidden_pi": hidden_pi, "hidden_v": hidden_v, "actions": padded(batch["actions"]),
            "logp": padded(batch["logp"]), "advantage": padded(advantage), "returns": padded(returns),
            "mask": padded(torch.ones_like(batch["reward"])), "explained": explained.item()}


def _columns(seq, cols, *names):
    """The sequences `cols` of a padded rollout, cut to the longest: mask (L, b) and the named entries."""
    mask = seq["mask"][:, cols]
    rows = int(mask.sum(0).max())
    return mask[:rows], *(seq[name][:rows, cols] for name in names)


def _mean(x, mask):
    return (x * mask).sum() / mask.sum()


def policy_loss(actor, seq, cols, hp):
    """Clipped surrogate with entropy bonus over valid steps; and entropy, KL from the old policy, max |ratio - 1|."""
    mask, obs, actions, old, advantage = _columns(seq, cols, "obs", "actions", "logp", "advantage")
    with autocast(obs.device):
        logits = actor(obs[..., :actor.inputs], tuple(h[:, cols] for h in seq["hidden_pi"]))[0]
    logp = log_softmax(logits)
    ratio = (log_prob(logp, actions) - log_prob(old, actions)).exp()
    surrogate = _mean(torch.minimum(ratio * advantage, ratio.clamp(1 - hp.clip, 1 + hp.clip) * advantage), mask)
    entropy = _mean(-(logp.exp() * logp).sum((-1, -2)), mask)
    kl = _mean((old.exp() * (old - logp)).sum((-1, -2)), mask)
    return -surrogate - hp.entropy * entropy, (entropy.detach(), kl.detach(), ((ratio.detach() - 1).abs() * mask).max())


def value_loss(critic, seq, cols, hp):
    """Squared error to the returns, averaged over valid steps."""
    mask, obs, returns = _columns(seq, cols, "obs", "returns")
    with autocast(obs.device):
        v = critic(obs, tuple(h[:, cols] for h in seq["hidden_v"]))[0].squeeze(-1)
    loss = _mean((v - returns).square(), mask)
    return hp.value * loss, (loss.detach(),)


def _descend(net, optimizer, loss, seq, batches, hp):
    """One step of Adam a mini-batch; what else the loss returned, stacked (mini-batches, ...).

    Gradients are clipped per net: together the value's would drown the policy's.
    """
    told = []
    for cols in batches:
        value, more = loss(net, seq, cols, hp)
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), hp.grad_norm)
        optimizer.step()
        told.append(torch.stack(more))
    return torch.stack(told)


def update(actor, critic, optimizers, seq, hp):
    """`hp.epochs` passes of PPO over a rollout's sequences; the learning rate follows the KL of the last pass.

    The two nets share nothing: each descends in a thread of its own.

    Args:
        optimizers: of actor and critic.
    Returns:
        STATS but `explained`; `ratio` is the largest |ratio - 1| at the first mini-batch.
    """
    count = int(seq["mask"][0].sum())
    per_epoch = min(count, max(1, round(seq["mask"].sum().item() / hp.minibatch)))

    def deal():
        """All sequences in random order to mini-batches of one width, filled up with the empty one after the last."""
        order = F.pad(torch.randperm(count), (0, -count % (WIDTH * per_epoch)), value=count)
        return order.to(seq["mask"].device).view(-1, per_epoch).T

    batches = [cols for _ in range(hp.epochs) for cols in deal()]
    jobs = zip((actor, critic), optimizers, (policy_loss, value_loss))
    told = [job.result() for job in [threads.submit(_descend, *job, seq, batches, hp) for job in jobs]]
    last = len(batches) // hp.epochs
    entropy, kl, _ = told[0][-last:].mean(0).tolist()
    lr = optimizers[0].param_groups[0]["lr"]
    lr = max(hp.lr_min, lr / 1.5) if kl > 2 * hp.kl_target else min(hp.lr_max, lr * 1.5) if kl < hp.kl_target / 2 else lr
    for optimizer in optimizers:
        optimizer.param_groups[0]["lr"] = lr
    return {"kl": kl, "entropy": entropy, "value_loss": told[1][-last:].mean().item(), "ratio": told[0][0, 2].item(),
            "lr": lr}


def train(run, hp, env, held_out, actor, critic, keep=None):
    """PPO from the last resume point to `hp.updates`; every `hp.eval_every` updates a row of metrics.

    Args:
        run: artifacts.Run, for metrics, resume points and the time limit.
        hp: Hyperparameters, with the stage's seed.
        env, held_out: stacks of wrappers over a PushVectorEnv to train and to measure in, of hp.num_envs and hp.eval_episodes
            worlds.
        keep: keep(update, actor), called before each update and after the last, for checkpoints.
    Raises:
        artifacts.UserError: the KL or the value loss of an update is not finite.
    Returns:
        True when trained to the end, False when the time limit stopped it.
    """
    device = next(actor.parameters()).device
    aids = env.unwrapped
    aids.tolerance = hp.tolerance
    optimizers = [torch.optim.Adam(net.parameters(), lr=hp.lr, eps=1e-5) for net in (actor, critic)]
    kl_end = hp.kl_target if hp.kl_target_end is None else hp.kl_target_end
    first, ended, successes = 0, 0, 0
    if state := run.load_resume():
        actor.load_state_dict(state["actor"]), critic.load_state_dict(state["critic"])
        for optimizer, saved in zip(optimizers, state["optimizers"]):
            optimizer.load_state_dict(saved)
        first, ended, successes, aids.tolerance = (state[k] for k in ("update", "episodes", "successes", "tolerance"))
    bar = artifacts.bar(hp.updates, run.dir.parent.name, initial=first, unit="update")
    clock, played, stats = time.perf_counter(), 0, dict.fromkeys(STATS, float("nan"))
    for k in range(first, hp.updates + 1):
        if keep:
            keep(k, actor)
        if (k % hp.eval_every == 0 or k == hp.updates) and (k > first or not k):
            rate = played / max(time.perf_counter() - clock, 1e-9)
            with torch.random.fork_rng():
                torch.manual_seed(hp.seed)
                success = episodes.play(held_out, actor, seed=10**6 + hp.seed)[0].mean()
            clock, played = time.perf_counter(), 0
            row = dict(update=k, steps=k * hp.num_envs * hp.rollout_steps, success=success, tolerance=aids.tolerance)
            run.log(**row, **stats, steps_per_s=rate)
            bar.set_postfix_str(f"success {success:.1%}, tolerance {aids.tolerance:.2f}x, {rate:,.0f} steps/s")
        if k == hp.updates:
            break
        aids.near_share = hp.near_share * (1 - k / hp.updates)
        if k % hp.resume_every == 0:  # all worlds start anew here, in an uninterrupted run too
            if k > first:
                run.save_resume(dict(update=k, actor=actor.state_dict(), critic=critic.state_dict(),
                                     optimizers=[optimizer.state_dict() for optimizer in optimizers],
                                     tolerance=aids.tolerance, episodes=ended, successes=successes))
                if run.out_of_time():
                    run.stop()
                    return False
            draw = int(np.random.SeedSequence([hp.seed, k]).generate_state(1)[0])
            torch.manual_seed(draw)
            obs, _ = env.reset(seed=draw)
            carry = obs, actor.initial(hp.num_envs, device), critic.initial(hp.num_envs, device)
        batch, carry = rollout(env, actor, critic, carry, hp.rollout_steps)
        seq = sequences(batch, critic, hp.gamma, hp.lam)
        kl_target = hp.kl_target + (kl_end - hp.kl_target) * k / hp.updates
        stats = update(actor, critic, optimizers, seq, replace(hp, kl_target=kl_target)) | {"explained": seq["explained"]}
        if not math.isfinite(stats["kl"] + stats["value_loss"]):
            raise artifacts.UserError(f"{run.dir}: training diverged in update {k + 1}: use a lower rate, and --force")
        ended, successes = ended + batch["success"][0], successes + batch["success"][1]
        if ended >= 512:
            if successes > 0.6 * ended:
                aids.tolerance = max(1.0, 0.95 * aids.tolerance)
            ended = successes = 0
        played += hp.num_envs * hp.rollout_steps
        bar.update()
    return True


def outcome(run):
    """What config.json keeps of a finished training: steps played, and success at the end."""
    last = run.rows()[-1]
    return {"steps": int(last["steps"]), "success": last["success"]}
