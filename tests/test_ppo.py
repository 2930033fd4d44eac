from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from torch import nn

from common import networks, ppo, speed, task

HP = ppo.Hyperparameters(minibatch=10**6, epochs=1)
bfloat16 = pytest.mark.skipif(not torch.cpu._is_avx512_bf16_supported(), reason="this machine does not compute in bfloat16")


class ToyEnv(gym.vector.VectorEnv):
    """Worlds whose episodes end by themselves, in PushVectorEnv's form: SAME_STEP autoreset, final_obs of all worlds."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
    size = 3

    def __init__(self, num_envs, seed=0):
        self.num_envs, self.rng = num_envs, np.random.default_rng(seed)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (self.size,), np.float32)
        self.single_action_space = gym.spaces.MultiDiscrete([task.BINS, task.BINS])
        self.steps = np.zeros(num_envs, int)

    def reset(self, *, seed=None, options=None):
        self.steps[:] = 0
        return self.begin(np.arange(self.num_envs)), {}

    def step(self, action):
        self.steps += 1
        obs, reward, terminated, truncated = self.advance(action)
        infos, ended = {"success": self.success, "aided": np.zeros(self.num_envs, bool)}, terminated | truncated
        if ended.any():
            infos |= {"final_obs": obs, "_final_obs": ended}
            self.steps[ended] = 0
            obs = obs.copy()
            obs[ended] = self.begin(np.flatnonzero(ended))
        return obs, reward, terminated, truncated, infos


class Noise(ToyEnv):
    """Random observations and rewards; a step terminates with probability 0.1 and truncates with 0.1."""

    def begin(self, worlds):
        return self.rng.standard_normal((len(worlds), self.size), np.float32)

    def advance(self, action):
        terminated, truncated = self.rng.random((2, self.num_envs)) < 0.1
        self.success = terminated
        return self.begin(np.arange(self.num_envs)), self.rng.normal(size=self.num_envs), terminated, truncated & ~terminated


class Told(Noise):
    """Keeps what it was told and said."""

    def step(self, action):
        out = super().step(action)
        self.told = getattr(self, "told", []) + [(action, *out)]
        return out


class Recall(ToyEnv):
    """A bit at step 0, then blanks; after `blanks` of them the first velocity's sign must repeat it."""

    size = 2

    def __init__(self, num_envs, blanks=20):
        super().__init__(num_envs)
        self.blanks = blanks

    def begin(self, worlds):
        self.bit = getattr(self, "bit", np.zeros(self.num_envs))
        self.bit[worlds] = self.rng.choice([-1, 1], len(worlds))
        return np.stack([self.bit[worlds], np.zeros(len(worlds))], 1).astype(np.float32)

    def advance(self, action):
        last = self.steps > self.blanks
        obs = np.zeros((self.num_envs, 2), np.float32)
        obs[:, 1] = self.steps == self.blanks  # now
        self.success = np.sign(action[:, 0] - 5) == self.bit
        return obs, last * np.where(self.success, 1.0, -1.0), last, np.zeros(self.num_envs, bool)


class FeedForward(nn.Module):
    """A net without memory, to be called as networks.Recurrent."""

    def __init__(self, inputs, outputs, width=32):
        super().__init__()
        self.inputs = inputs
        self.layers = nn.Sequential(nn.Linear(inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(),
                                    nn.Linear(width, outputs))

    def initial(self, batch, device=None):
        return (torch.zeros(1, batch, 1, device=device),)

    def forward(self, x, hidden):
        return self.layers(x).float(), hidden


def nets(inputs=3, sizes=(8, 6, 5)):
    actor, critic = networks.policy(inputs, sizes), networks.value(inputs, sizes)
    with torch.no_grad():
        actor.head[-1].weight *= 100  # away from the uniform distribution
    return actor, critic


def second_rollout(actor, critic, steps=25, num=7):
    """A rollout that begins amid episodes, with their hidden states, and what was seen last of each episode (T, N, D)."""
    env = Told(num)
    carry = env.reset()[0], actor.initial(num), critic.initial(num)
    _, carry = ppo.rollout(env, actor, critic, carry, steps)
    batch = ppo.rollout(env, actor, critic, carry, steps)[0]
    return batch | {"final": torch.tensor(np.stack([infos.get("final_obs", obs) for _, obs, *_, infos in env.told[steps:]]))}


def plain_loop(net, batch, hidden):
    """Outputs (T, N, .) at the observations and at what follows them, one step at a time."""
    now, after = [], []
    for obs, final, done in zip(batch["obs"], batch["final"], batch["done"]):
        y, hidden = net(obs[None], hidden)
        now.append(y[0])
        after.append(net(final[None], hidden)[0][0])
        hidden = networks.forget(hidden, done)
    following = torch.stack([*now[1:], after[-1]])
    return torch.stack(now), torch.where(batch["done"][..., None], torch.stack(after), following)


def columns(seq):
    return torch.arange(seq["mask"].shape[1])


def optimizers(actor, critic, lr=1e-3):
    return [ppo.optimizer(net, lr) for net in (actor, critic)]


# Rollout


def test_a_rollout_keeps_what_the_env_said():
    env, (actor, critic) = Told(5), nets()
    first = env.reset()[0]
    batch, (obs, *_) = ppo.rollout(env, actor, critic, (first, actor.initial(5), critic.initial(5)), 30)
    actions, observations, reward, terminated, truncated, infos = zip(*env.told)
    assert (batch["obs"].numpy() == np.stack([first, *observations[:-1]])).all() and (obs == observations[-1]).all()
    assert (batch["actions"].numpy() == np.stack(actions)).all()
    assert batch["reward"].numpy() == pytest.approx(np.stack(reward), abs=1e-6)
    assert (batch["done"].numpy() == np.stack(terminated) | np.stack(truncated)).all()
    assert (batch["terminated"].numpy() == np.stack(terminated)).all()
    for name in ("success", "aided"):
        assert (batch[name].numpy() == np.stack([told[name] for told in infos])).all()
    torch.testing.assert_close(batch["logp"].exp().sum(-1), torch.ones(30, 5, 2))


def test_rollouts_follow_one_another(float32):
    """Thirty rollouts of one step see what one of thirty steps saw, and each knows the value of what comes next."""
    actor, critic = nets()
    env = Noise(3)
    carry = env.reset()[0], actor.initial(3), critic.initial(3)
    pieces = []
    for _ in range(30):
        batch, carry = ppo.rollout(env, actor, critic, carry, 1)
        pieces.append(batch)
        going_on = ~batch["done"][0]
        after = critic(torch.as_tensor(carry[0])[None], carry[2])[0][0, :, 0]
        torch.testing.assert_close(batch["next_value"][0][going_on], after[going_on], check_stride=False)
    assert not all(batch["done"].any() for batch in pieces)
    for net, name in ((actor, "hidden_pi"), (critic, "hidden_v")):
        hidden = net.initial(3)
        for batch in pieces:
            torch.testing.assert_close(batch[name], hidden)
            hidden = networks.forget(net(batch["obs"], hidden)[1], batch["done"][0])


def test_whole_sequences_begin_after_episode_ends():
    done = torch.tensor([[0, 0, 1, 0, 0], [0, 0, 0, 0, 0], [0, 0, 0, 0, 1]]).bool().T
    position, sequence, world, start = ppo.split(done)
    assert position.T.tolist() == [[0, 1, 2, 0, 1], [0, 1, 2, 3, 4], [0, 1, 2, 3, 4]]
    assert sequence.T.tolist() == [[0, 0, 0, 1, 1], [2] * 5, [3] * 5]
    assert world.tolist() == [0, 0, 1, 2] and start.tolist() == [0, 3, 0, 0]
    padded = ppo.pad(torch.arange(1, 16).view(3, 5).T, position, sequence)
    assert padded.T[:4].tolist() == [[1, 2, 3, 0, 0], [4, 5, 0, 0, 0], [6, 7, 8, 9, 10], [11, 12, 13, 14, 15]]
    assert not padded[:, 4:].any() and padded.shape[1] == speed.WIDTH
    full = torch.arange(speed.WIDTH)[None]
    assert ppo.pad(full, 0 * full, full).shape[1] == 2 * speed.WIDTH


# Advantages


def test_gae_of_a_hand_computed_case():
    """gamma = lambda = 1/2. World 0 terminates at step 1 and goes on; world 1 is truncated there."""
    reward = torch.tensor([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [4.0, 4.0]])
    value = torch.tensor([[4.0, 4.0], [8.0, 8.0], [2.0, 2.0], [6.0, 6.0]])
    next_value = torch.tensor([[8.0, 8.0], [100.0, 20.0], [6.0, 6.0], [10.0, 10.0]])
    terminated = torch.tensor([[0, 0], [1, 0], [0, 0], [0, 0]]).bool()
    done = torch.tensor([[0, 0], [1, 1], [0, 0], [0, 0]]).bool()
    # deltas: 1 + 4 - 4 = 1; 2 - 8 = -6, or 2 + 10 - 8 = 4; 3 + 3 - 2 = 4; 4 + 5 - 6 = 3
    wanted = torch.tensor([[1 - 6 / 4, 1 + 4 / 4], [-6.0, 4.0], [4 + 3 / 4, 4 + 3 / 4], [3.0, 3.0]])
    torch.testing.assert_close(ppo.gae(reward, value, next_value, terminated, done, 0.5, 0.5), wanted)


def test_values_and_advantages_are_those_of_a_plain_loop(float32):
    actor, critic = nets()
    batch = second_rollout(actor, critic)
    assert batch["terminated"].sum() > 3 and (batch["done"] & ~batch["terminated"]).sum() > 3
    with torch.no_grad():
        value, next_value = (v.squeeze(-1) for v in plain_loop(critic, batch, batch["hidden_v"]))
    torch.testing.assert_close(batch["value"], value)
    torch.testing.assert_close(batch["next_value"][~batch["terminated"]], next_value[~batch["terminated"]])
    advantage, last = torch.zeros_like(value), torch.zeros(value.shape[1])
    for t in reversed(range(len(value))):
        delta = batch["reward"][t] + 0.993 * next_value[t] * (~batch["terminated"][t]) - value[t]
        last = torch.where(batch["done"][t], delta, delta + 0.993 * 0.95 * last)
        advantage[t] = last
    seq = ppo.sequences(batch, 0.993, 0.95)
    position, sequence, _, _ = ppo.split(batch["done"])
    torch.testing.assert_close(seq["returns"][position, sequence], advantage + value)
    torch.testing.assert_close(seq["advantage"][position, sequence], (advantage - advantage.mean()) / advantage.std())
    assert seq["mask"].sum() == value.numel() and seq["obs"][position, sequence].equal(batch["obs"])
    assert seq["explained"] == pytest.approx(1 - (advantage.var() / (advantage + value).var()).item(), abs=1e-4)


# Update


@pytest.mark.parametrize("tolerance", [pytest.param(1e-4, id="float32"), pytest.param(2e-2, id="bfloat16", marks=bfloat16)])
def test_the_ratio_is_one_at_the_first_minibatch(tolerance, request):
    if tolerance < 1e-3:
        request.getfixturevalue("float32")
    actor, critic = nets()
    seq = ppo.sequences(second_rollout(actor, critic), 0.99, 0.95)

    def clipped(clip):
        return ppo.policy_loss(actor, seq, columns(seq), replace(HP, clip=clip))[1][3]

    with torch.no_grad():
        assert clipped(tolerance) == 0
    stats = ppo.update(actor, critic, optimizers(actor, critic, 1e-2), seq, replace(HP, clip=tolerance))
    assert stats["clip_fraction"] == 0  # the only mini-batch comes before any step
    with torch.no_grad():
        assert clipped(2e-2) > 0


def test_log_probs_and_gradients_are_those_of_a_plain_loop(float32):
    actor, critic = nets()
    batch = second_rollout(actor, critic)
    seq = ppo.sequences(batch, HP.gamma, HP.lam)
    with torch.no_grad():  # so that some ratios are clipped
        for p in actor.parameters():
            p += 0.1 * torch.randn_like(p)
    hp = replace(HP, value_coef=0.7)
    policy_loss, (told, entropy, kl, clipped) = ppo.policy_loss(actor, seq, columns(seq), hp)
    value_loss, (squared,) = ppo.value_loss(critic, seq, columns(seq), hp)
    parameters = [*actor.parameters(), *critic.parameters()]
    fused = torch.autograd.grad(policy_loss + value_loss, parameters)

    position, sequence, _, _ = ppo.split(batch["done"])
    advantage, returns = seq["advantage"][position, sequence], seq["returns"][position, sequence]
    logits = plain_loop(actor, batch, batch["hidden_pi"])[0].unflatten(-1, (2, 11))
    now = torch.distributions.Independent(torch.distributions.Categorical(logits=logits), 1)
    old = torch.distributions.Independent(torch.distributions.Categorical(logits=batch["logp"]), 1)
    ratio = (now.log_prob(batch["actions"]) - old.log_prob(batch["actions"])).exp()
    assert told == policy_loss and 0 < clipped == ((ratio - 1).abs() > HP.clip).float().mean()
    surrogate = torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    plain_squared = (plain_loop(critic, batch, batch["hidden_v"])[0].squeeze(-1) - returns).square().mean()
    torch.testing.assert_close((squared, entropy), (plain_squared.detach(), now.entropy().mean().detach()))
    torch.testing.assert_close(kl, torch.distributions.kl_divergence(old, now).mean().detach())
    torch.testing.assert_close(policy_loss, -surrogate - hp.entropy_coef * now.entropy().mean())
    plain = torch.autograd.grad(-surrogate - hp.entropy_coef * now.entropy().mean() + 0.7 * plain_squared, parameters)
    for a, b in zip(fused, plain):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5)


def test_minibatches_take_every_sequence_once_an_epoch(monkeypatch):
    actor, critic = nets()
    seq, taken, real = ppo.sequences(second_rollout(actor, critic), 0.99, 0.95), [], ppo.policy_loss
    monkeypatch.setattr(ppo, "policy_loss", lambda net, s, cols, hp: taken.append(cols) or real(net, s, cols, hp))
    ppo.update(actor, critic, optimizers(actor, critic), seq, replace(HP, minibatch=60, epochs=2))
    assert len(taken) == 6  # 175 steps in mini-batches of about 60
    whole = seq["mask"].any(0)
    for epoch in (taken[:3], taken[3:]):
        assert all(len(cols) % speed.WIDTH == 0 for cols in epoch)
        order = torch.cat(epoch)
        assert order[whole[order]].sort()[0].equal(whole.nonzero()[:, 0])
        assert max(whole[cols].sum() for cols in epoch) - min(whole[cols].sum() for cols in epoch) <= speed.WIDTH


def test_no_minibatch_is_empty_where_there_are_fewer_sequences():
    actor, critic = nets()
    batch = second_rollout(actor, critic, num=2)
    seq = ppo.sequences(batch, 0.99, 0.95)
    stats = ppo.update(actor, critic, optimizers(actor, critic), seq, replace(HP, minibatch=1))
    assert np.isfinite(list(stats.values())).all() and stats["explained"] == seq["explained"]
    assert set(stats) == {"policy_loss", "entropy", "kl", "clip_fraction", "value_loss", "explained", "lr"}


def test_the_learning_rate_follows_the_kl_within_its_limits():
    actor, critic = nets()
    seq = ppo.sequences(second_rollout(actor, critic), 0.99, 0.95)
    both = optimizers(actor, critic)

    def rates(target, count):
        hp = replace(HP, epochs=2, kl_target=target, lr_min=5e-4, lr_max=3e-3)
        return [ppo.update(actor, critic, both, seq, hp)["lr"] for _ in range(count)]

    assert rates(1e-12, 3) == pytest.approx([1e-3 / 1.5, 5e-4, 5e-4])
    assert rates(1e12, 6) == pytest.approx([7.5e-4, 1.125e-3, 1.6875e-3, 2.53125e-3, 3e-3, 3e-3])
    kl = ppo.update(actor, critic, both, seq, replace(HP, epochs=2, kl_target=1e12, lr_max=1e-3, lr_min=1e-3))["kl"]
    assert rates(kl, 1) == [1e-3]
    assert all(optimizer.param_groups[0]["lr"] == 1e-3 for optimizer in both)


def test_gradients_are_clipped_apart():
    moved = []
    for coefficient in (1.0, 1e6):
        torch.manual_seed(1)
        both = nets()
        seq = ppo.sequences(second_rollout(*both), 0.99, 0.95)
        before = [[p.detach().clone() for p in net.parameters()] for net in both]
        steepest = [torch.optim.SGD(net.parameters(), lr=1.0) for net in both]
        ppo.update(*both, steepest, seq, replace(HP, value_coef=coefficient, grad_norm=0.01, lr_min=1, lr_max=1))
        moved.append([torch.cat([(p.detach() - q).flatten() for p, q in zip(net.parameters(), old)])
                      for net, old in zip(both, before)])
    torch.testing.assert_close(moved[0][0], moved[1][0])
    assert [step.norm().item() for pair in moved for step in pair] == pytest.approx([0.01] * 4, rel=1e-3)


# Learning


def remembers(actor, critic, updates, blanks=20):
    """Share of bits that a policy repeats at the end of its training."""
    env = Recall(64, blanks)
    hp = replace(HP, epochs=8, minibatch=704, kl_target=0.02, lr_min=1e-3, entropy_coef=0.03)
    both = optimizers(actor, critic, 3e-3)
    carry, share = (env.reset()[0], actor.initial(64), critic.initial(64)), []
    while len(share) < updates and np.mean(share[-5:] or 0) < 0.95:
        batch, carry = ppo.rollout(env, actor, critic, carry, blanks + 1)
        share.append(batch["success"][batch["done"]].float().mean())
        ppo.update(actor, critic, both, ppo.sequences(batch, hp.gamma, hp.lam), hp)
    return np.mean(share[-5:])


def test_recurrent_ppo_remembers_over_twenty_blank_steps(float32):
    assert remembers(*nets(2, (32, 32, 32)), updates=250) >= 0.95


def test_a_feed_forward_policy_cannot(float32):
    assert remembers(FeedForward(2, 22), FeedForward(2, 1), updates=60) < 0.7
    assert remembers(FeedForward(2, 22), FeedForward(2, 1), updates=60, blanks=0) >= 0.95  # it learns what needs no memory
