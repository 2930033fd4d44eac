"""The protocol of wrappers.EpisodeWrapper, over a vector env whose every number is known."""
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from common.wrappers import EpisodeWrapper, declare_observations, state_of

LENGTHS = np.array([2, 3, 3, 7])  # steps of every episode of a world


class Clockwork(gym.vector.VectorEnv):
    """SAME_STEP autoreset; observations (N, 2) are the number of the episode and the step in it."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self):
        self.num_envs, self.seeds = len(LENGTHS), []
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.single_action_space = gym.spaces.Discrete(5)
        self.now = np.zeros((self.num_envs, 2), np.float32)

    def reset(self, *, seed=None, options=None):
        self.seeds.append((seed, options))
        self.now[:] = 0
        return self.now.copy(), {"state": self.now.copy()}

    def step(self, action):
        self.action = action
        self.now[:, 1] += 1
        ended, infos = self.now[:, 1] == LENGTHS, {}
        if ended.any():
            infos = {"final_obs": self.now.copy(), "final_state": self.now.copy(), "_final_obs": ended}
            self.now[ended] = np.stack([self.now[ended, 0] + 1, np.zeros(ended.sum())], 1)
        return self.now.copy(), np.ones(self.num_envs), ended, ~ended & False, infos | {"state": self.now.copy()}


class Counting(EpisodeWrapper):
    """Tells what it was asked; adds 100 to observations of a start, 1000 to those of a step, 1 to actions."""

    def __init__(self, env):
        super().__init__(env)
        self.calls = []

    def seed(self, seed):
        self.calls.append(("seed", seed))

    def begin(self, worlds, obs, infos):
        self.calls.append(("begin", worlds.tolist(), obs.copy(), infos["state"].copy()))
        return obs + 100

    def observe(self, obs, infos):
        self.calls.append(("observe", obs.copy(), state_of(infos).copy()))
        self.returned = obs + 1000
        return self.returned

    def act(self, action):
        return action + 1


@pytest.fixture
def env():
    env = Counting(Clockwork())
    env.reset()
    env.calls.clear()
    return env


def expected(steps):
    """Of the worlds after so many steps: which have just ended, what was seen last, and what they start or go on with."""
    number, step = np.divmod(steps, LENGTHS)
    ended = step == 0
    final = np.where(ended[:, None], np.stack([number - 1, LENGTHS], 1), np.stack([number, step], 1))
    return ended, final, np.stack([number, step], 1)


def test_a_step_is_observed_whole_and_then_the_ended_worlds_begin(env):
    begun = 0
    for steps in range(1, 30):
        obs, reward, terminated, truncated, infos = env.step(np.arange(4))
        ended, final, now = expected(steps)
        names = [call[0] for call in env.calls]
        assert names == ["observe", "begin"][:1 + ended.any()]
        _, seen, state = env.calls[0]
        assert (seen == final).all() and (state == final).all()  # an end where one ended, not the next one's start
        assert (obs[~ended] == final[~ended] + 1000).all() and (obs[ended] == now[ended] + 100).all()
        assert ("final_obs" in infos) == ended.any()
        if ended.any():
            _, worlds, starts, states = env.calls[1]
            assert worlds == np.flatnonzero(ended).tolist() and (starts == now[ended]).all() and (states == now).all()
            assert infos["final_obs"] is env.returned and (infos["final_obs"] == final + 1000).all()
            assert (infos["_final_obs"] == ended).all()
        assert (terminated == ended).all() and not truncated.any() and (reward == 1).all()
        assert (env.unwrapped.action == np.arange(4) + 1).all()
        begun += ended.sum()
        env.calls.clear()
    assert begun == (29 // LENGTHS).sum()


def test_a_reset_begins_every_world_and_seeds_first_when_a_seed_is_given():
    env = Counting(Clockwork())
    obs, infos = env.reset()
    (name, worlds, starts, _), = env.calls
    assert name == "begin" and worlds == [0, 1, 2, 3] and not starts.any() and (obs == 100).all() and "state" in infos
    env.reset(seed=0, options={"a": 1})
    assert [call[0] for call in env.calls[1:]] == ["seed", "begin"] and env.calls[1][1] == 0
    for _ in range(10):
        env.step(np.zeros(4))
    env.reset()
    assert [call[0] for call in env.calls].count("seed") == 1
    assert env.unwrapped.seeds == [(None, None), (0, {"a": 1}), (None, None)]


def test_a_stack_of_two_observes_ends_and_starts_from_bottom_to_top():
    env = Counting(lower := Counting(Clockwork()))
    assert (env.reset()[0] == 200).all()
    for steps in range(1, 30):
        obs, _, _, _, infos = env.step(np.zeros(4))
        ended, final, now = expected(steps)
        assert (obs[~ended] == final[~ended] + 2000).all() and (obs[ended] == now[ended] + 200).all()
        assert not ended.any() or (infos["final_obs"] == final + 2000).all()
        assert (env.unwrapped.action == 2).all()
    assert [call[0] for call in env.calls] == [call[0] for call in lower.calls]


def test_a_wrapper_that_says_nothing_changes_nothing():
    plain, wrapped = Clockwork(), EpisodeWrapper(Clockwork())
    assert (plain.reset(seed=1)[0] == wrapped.reset(seed=1)[0]).all()
    for _ in range(30):
        (a, *_, told), (b, *_, infos) = plain.step(np.zeros(4)), wrapped.step(np.zeros(4))
        assert (a == b).all() and told.keys() == infos.keys() and all((told[key] == infos[key]).all() for key in told)


def test_declared_observations_are_unbounded():
    env = Counting(Clockwork())
    declare_observations(env, 7)
    assert env.single_observation_space == gym.spaces.Box(-np.inf, np.inf, (7,), np.float32)
    assert env.observation_space.shape == (4, 7) and env.observation_space.dtype == np.float32
