"""The loop around PPO: curriculum, held-out success, log, resume points."""
import math
import time
from dataclasses import replace

import numpy as np
import torch

from common import episodes, ppo, ranks
from common.files import UserError
from common.progress import bar

# The curriculum lowers the tolerance by 5 % when of the last 512 episodes without aid, which tell a rate within 2 points, 60 %
# succeed: often enough to be found at the next tolerance too, and seldom enough that there is more to learn. Where 60 % are
# out of reach, as some starts cannot be solved, it falls in the third quarter of the training: the last is for the task itself
EPISODES, SHARE, FACTOR = 512, 0.6, 0.95
CURRICULUM = ("tolerance", "episodes", "successes")  # its state, as `lowered` takes it
STATS = ("train_success", "train_return", "train_length", "policy_loss", "clip_fraction", "kl", "entropy", "value_loss",
         "explained", "lr", "steps_per_s")  # of an update, in metrics.csv


def lowered(tolerance, ended, successes, highest=math.inf):
    """The curriculum's factor on the success tolerance, at most `highest`, and the episodes and successes counted since it was
    looked at.
    """
    if ended >= EPISODES:
        tolerance = max(1.0, FACTOR * tolerance) if successes > SHARE * ended else tolerance
        ended = successes = 0
    return min(highest, tolerance), ended, successes


def limit(first, done):
    """The curriculum's highest factor after a share `done` of the training: the `first` up to a half, 1 from three quarters."""
    return first ** min(1.0, max(0.0, 3 - 4 * done))


def ended_episodes(batch, running):
    """Of the episodes that ended in a rollout, in all processes: number and successes of those without aid, which the
    curriculum counts; and {mean success, return, length} of all, nan where none did.

    Args:
        running: (2, N) return and length so far of the episodes that run; goes on.
    """
    rewards, ends, success, aided = (batch[name].cpu().numpy() for name in ("reward", "done", "success", "aided"))
    sums = np.zeros(2)
    for reward, done in zip(rewards, ends):
        running += np.stack([reward, np.ones_like(reward)])
        sums += running[:, done].sum(1)
        running[:, done] = 0
    unaided = ends & ~aided
    counted, won, count, *sums = ranks.totals(unaided.sum(), success[unaided].sum(), ends.sum(), success[ends].sum(), *sums)
    return counted, won, {name: total / count if count else math.nan for name, total in zip(STATS, sums)}


def held_out_success(env, actor, seed):
    """Success in the study's episodes at 1x tolerance, the same ones each time, which no update sees; each rank plays some."""
    device = next(actor.parameters()).device
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        success = episodes.play(env, actor, seed=10**6 + seed + 2**32 * ranks.RANK)[0]
    won, count = ranks.totals(success.sum(), len(success))
    return won / count


def shares(hp):
    """This rank's numbers of worlds to train in and to measure in. Raises UserError: there are more processes than worlds."""
    if (most := min(hp.num_envs, hp.eval_episodes)) < ranks.COUNT:
        raise UserError(f"{ranks.COUNT} processes share {hp.num_envs} worlds and {hp.eval_episodes} of --eval-episodes: start at "
                        f"most {most}")
    return ranks.share(hp.num_envs), ranks.share(hp.eval_episodes)


def begin(env, actor, critic, seed, k):
    """Seeds everything for the updates from `k` on, and starts all worlds anew: the carry of ppo.rollout."""
    draw = int(np.random.SeedSequence([seed, k, 0, ranks.RANK]).generate_state(1)[0])
    torch.manual_seed(draw)
    obs, _ = env.reset(seed=draw)
    device = next(actor.parameters()).device
    return obs, actor.initial(len(obs), device), critic.initial(len(obs), device)


def train(run, hp, env, held_out, actor, critic, keep=None):
    """PPO from the last resume point to `hp.updates`; every update a row of metrics, with held-out success now and then.

    Args:
        run: runs.Run, for metrics, resume points and the time limit; hp: ppo.Hyperparameters, with the stage's seed.
        env, held_out: stacks over a PushVectorEnv to train and to measure in, with this rank's share of hp.num_envs and
        hp.eval_episodes worlds.
        keep: keep(update, actor), called on rank 0 before each update and after the last, for checkpoints.
    Returns: True when trained to the end, False when the time limit stopped it.
    Raises UserError: the KL or the value loss of an update is not finite.
    """
    worlds, running = env.unwrapped, np.zeros((2, env.num_envs))
    optimizers = [ppo.optimizer(net, hp.lr) for net in (actor, critic)]
    kl_end = hp.kl_target if hp.kl_target_end is None else hp.kl_target_end
    first, curriculum, stats, success = 0, (hp.tolerance, 0, 0), dict.fromkeys(STATS, math.nan), math.nan
    if state := run.load_resume():
        first, curriculum = state["update"], tuple(state[name] for name in CURRICULUM)
        for part, saved in zip((actor, critic, *optimizers), (state["actor"], state["critic"], *state["optimizers"])):
            part.load_state_dict(saved)
    progress = bar(hp.updates, run.dir.parent.name, initial=first, unit="update")
    for k in range(first, hp.updates + 1):
        if keep and ranks.RANK == 0:
            keep(k, actor)
        if k > first or not k:
            row = dict(update=k, steps=k * hp.num_envs * hp.rollout_steps)
            if k % hp.eval_every == 0 or k == hp.updates:
                success = row["success"] = held_out_success(held_out, actor, hp.seed)
            run.log(**row, tolerance=curriculum[0], **stats)
        if k == hp.updates:
            return True
        clock = time.perf_counter()
        worlds.tolerance, worlds.near_share = curriculum[0], hp.near_share * (1 - k / hp.updates)
        if k % hp.resume_every == 0:  # all worlds start anew here, in an uninterrupted run too
            if k > first:
                nets = dict(actor=actor.state_dict(), critic=critic.state_dict(), optimizers=[o.state_dict() for o in optimizers])
                run.save_resume(nets | dict(zip(CURRICULUM, curriculum), update=k))
                if run.out_of_time():
                    run.stop()
                    return False
            carry = begin(env, actor, critic, hp.seed, k)
            running[:] = 0
        batch, carry = ppo.rollout(env, actor, critic, carry, hp.rollout_steps)
        kl_target = hp.kl_target + (kl_end - hp.kl_target) * k / hp.updates
        seq = ppo.sequences(batch, hp.gamma, hp.lam)
        ended, successes, stats = ended_episodes(batch, running)
        stats |= ppo.update(actor, critic, optimizers, seq, replace(hp, kl_target=kl_target))
        if not math.isfinite(stats["kl"] + stats["value_loss"]):
            raise UserError(f"{run.dir}: training diverged in update {k + 1}: use a lower rate, and --force")
        curriculum = lowered(curriculum[0], curriculum[1] + ended, curriculum[2] + successes,
                             limit(hp.tolerance, (k + 1) / hp.updates))
        stats["steps_per_s"] = hp.num_envs * hp.rollout_steps / (time.perf_counter() - clock)
        shown = "-" if math.isnan(success) else f"{success:.1%}"  # not measured again yet
        progress.set_postfix_str(f"success {shown}, tolerance {curriculum[0]:.2f}x, {stats['steps_per_s']:,.0f} steps/s",
                                 refresh=False)
        progress.update()


def outcome(run):
    """What config.json keeps of a finished training: steps played, and held-out success at the end."""
    last = run.rows()[-1]
    return {"steps": int(last["steps"]), "success": last["success"]}
