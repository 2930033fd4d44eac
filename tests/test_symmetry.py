import gymnasium as gym
import numpy as np

from common import task
from common.env import PushVectorEnv
from common.observation import Observed
from common.symmetry import Mirrored, mirror, signs

CORNERS = np.array([[1, 1], [-1, 1], [1, -1], [-1, -1]])


class Spy(gym.vector.VectorWrapper):
    """Keeps what passes between an env and the wrapper above it."""

    def step(self, action):
        obs, *rest, infos = self.env.step(action)
        self.action, self.obs, self.final = action, obs.copy(), infos.get("final_obs", obs).copy()
        return obs, *rest, infos


def test_mirroring_twice_is_nothing_and_signs_lead_to_the_first_quarter():
    obs = np.random.default_rng(0).uniform(-1, 1, (50, 12)).astype(np.float32)
    sign = signs(obs)
    assert (mirror(mirror(obs, sign), sign) == obs).all()
    assert (mirror(obs, sign)[:, :2] >= 0).all() and (mirror(obs, sign)[:, 8:] == obs[:, 8:]).all()
    assert (np.unique(sign, axis=0).shape, mirror(obs, sign).dtype) == ((4, 2), np.float32)


def test_the_simulator_has_the_symmetries():
    """Four mirror images of each episode run side by side."""
    rng, count, steps = np.random.default_rng(0), 20, 100
    env = PushVectorEnv(4 * count)
    env.near_share = 1.0
    env.reset(seed=1)
    sign = np.repeat(CORNERS, count, 0)
    turn = sign.prod(1, keepdims=True)
    box = np.tile(env.box[:count], (4, 1)) * np.hstack([sign, turn])
    pusher = np.tile(env.pusher[:count], (4, 1)) * sign
    dynamics = {name: np.tile(value[:count], 4) for name, value in env.dynamics.items()}
    dynamics |= {name: dynamics[name] * side for name, side in zip(("support_x", "support_y"), sign.T)}
    env.reset(options={"box": box, "pusher": pusher, **dynamics})
    touched = np.zeros(count, bool)
    toward = np.where(env.box[:count, :2] > env.pusher[:count], 3, -3)
    for _ in range(steps):
        action = np.clip(5 + toward + rng.integers(-4, 5, (count, 2)), 0, 10)
        env.advance(np.where(sign < 0, 10 - np.tile(action, (4, 1)), np.tile(action, (4, 1))))
        touched |= env.force[:count].any(1)
        s = mirror(task.scale(env.state), sign).reshape(4, count, 8)
        np.testing.assert_allclose(s, np.tile(s[0], (4, 1, 1)), atol=1e-6)
    assert touched.mean() > 0.5


def test_a_mirrored_env_sees_every_episode_from_its_own_quarter():
    num = 24
    spy = Spy(Observed(PushVectorEnv(num)))
    env, rng = Mirrored(spy), np.random.default_rng(0)
    first = env.reset(seed=0)[0]
    sign, ends, drift = env.sign, 0, rng.choice([-3, 3], (num, 2))
    assert (first[:, :2] >= 0).all() and len(np.unique(sign, axis=0)) == 4
    for _ in range(220):
        action = np.clip(5 + drift + rng.integers(-2, 3, (num, 2)), 0, 10)
        obs, _, _, _, infos = env.step(action)
        assert (spy.action - 5 == (action - 5) * sign).all()
        assert (infos.get("final_obs", obs) == mirror(spy.final, sign)).all()
        if "final_obs" in infos:
            ended = infos["_final_obs"]
            sign = np.where(ended[:, None], signs(spy.obs), sign)
            assert (obs[ended, :2] >= 0).all()
            ends += ended.sum()
        assert (obs == mirror(spy.obs, sign)).all()
    assert ends > num
