"""The environment: its starts, rewards and ends, and its gymnasium contract."""
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from test_simulator import HALF_BOX, MIDDLE, OTHER, RANGES, REST, play, start

from common import draw, geometry, task
from common.env import PushEnv, PushVectorEnv
from common.task import World


def test_episode_after_an_autoreset_is_that_of_a_fresh_world():
    env = start(box=[0.29, 0, 0], pusher=[0.29 - 0.06 - 0.0131, 0.01])
    while not env.step([[10, REST]])[2]:
        pass
    fresh = start(**{"box": env.box, "pusher": env.pusher} | env.dynamics)
    toward = REST + np.rint(5 * np.sign(env.box[:, :2] - env.pusher)).astype(int)
    assert play(env, toward, 60) == pytest.approx(play(fresh, toward, 60), abs=1e-9)


def test_same_seed_same_episodes():
    actions = np.random.default_rng(7).integers(0, 11, (320, 20, 2))

    def episodes(env, seed):
        return [env.reset(seed=seed)[0], *(env.step(a)[0] for a in actions)]

    env = PushVectorEnv(20)
    first = episodes(env, 1)
    assert np.array_equal(episodes(PushVectorEnv(20), 1), first)
    assert np.allclose(episodes(env, 1), first, atol=1e-6)
    assert not np.allclose(episodes(env, 2), first)


def test_action_bins_are_centimetres_a_second():
    env = start(11)
    before = env.pusher
    bins = np.arange(11)
    env.advance(np.stack([bins, 10 - bins], 1))
    velocity = (env.pusher - before) * 15
    assert velocity == pytest.approx(np.stack([bins - 5, 5 - bins], 1) * 0.01, abs=1e-9)


def start_shares(env, starts):
    """Starts (N, 3) as shares of their range, which is what is left for the centre at the box's angle where `starts` is box."""
    x, y = np.abs(draw.SQUARE * HALF_BOX @ geometry.rotation(env.box[:, 2]).transpose(2, 1, 0)).max(1).T
    half = {"box": np.stack([0.30 - x, 0.15 - y], 1), "centre": [0.30, 0.15], "inner": [0.20, 0.059]}[starts]
    return env.box / np.pad(np.broadcast_to(half, (len(env.box), 2)), ((0, 0), (0, 1)), constant_values=np.pi)


@pytest.mark.parametrize("starts", ["box", "centre", "inner"])
def test_starts_fill_their_region(starts):
    env = PushVectorEnv(4000, world=World(starts))
    env.reset(seed=8)
    shares = start_shares(env, starts)
    assert (np.abs(shares) <= 1 + 1e-9).all() and (np.abs(env.pusher) <= [0.30, 0.15]).all()
    assert np.quantile(shares, [0.25, 0.5, 0.75], axis=0) == pytest.approx(np.outer([-0.5, 0, 0.5], np.ones(3)), abs=0.05)
    assert (np.abs(shares).max(0) > 0.98).all()
    assert np.abs(np.corrcoef(np.abs(shares).T) - np.eye(3)).max() < 0.06  # as wide at every angle
    distance = [geometry.nearest(box, pusher)[0] for box, pusher in zip(env.box, env.pusher)]
    assert 0.001 <= min(distance) < 0.003
    assert (env.force == 0).all()


def test_a_box_starts_whole_within_the_workspace():
    env = PushVectorEnv(2000)
    env.reset(seed=8)
    corners = np.abs([draw.corners(box) for box in env.box])
    assert (corners <= task.HALF + 1e-9).all() and (corners.max((0, 1)) > task.HALF - 0.002).all()
    for starts in ("centre", "inner"):
        env = PushVectorEnv(2000, world=World(starts))
        env.reset(seed=8)
        outside = (np.abs([draw.corners(box) for box in env.box]) > task.HALF).any((1, 2))
        assert outside.any() == (starts == "centre")


def test_a_world_of_ones_own():
    env = PushVectorEnv(1000, world=OTHER)
    env.reset(seed=8)
    corners = np.abs([draw.corners(box, OTHER.box) for box in env.box])
    assert (corners <= task.HALF + 1e-9).all() and (corners.max((0, 1)) > task.HALF - 0.004).all()
    distance = [geometry.nearest(box, pusher, OTHER.box)[0] for box, pusher in zip(env.box, env.pusher)]
    assert 0.001 <= min(distance) < 0.004
    mass, c = env.dynamics["mass"], env.dynamics["limit_surface_c"]
    assert 1.0 <= mass.min() < 1.02 and 1.98 < mass.max() <= 2.0
    x, y = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 10**6)) * [[0.14], [0.08]]
    assert c == pytest.approx(np.full(1000, (np.hypot(x, y).mean() + np.hypot(0.07, 0.04)) / 2), abs=1e-4)
    assert (env.dynamics["mu_static"] >= env.dynamics["mu_dynamic"]).all() and env.dynamics["mu_dynamic"].max() > 0.59


def test_observations_clip_at_the_worlds_force():
    env = PushVectorEnv(1, world=World(max_force=2.0))
    env.reset(options=MIDDLE | {"box": [0.1, 0, 0], "pusher": [0.0269, 0]})
    obs = [env.step([[8, REST]])[0] for _ in range(10)]
    assert obs[-1][0, 6] == -1.0 and env.force[0, 0] < -2


@pytest.mark.parametrize("changes, words", [
    ({"box": (0.25, 0.2, 0.07)}, "0.32 m, the workspace leaves no room to start"), ({"box": (0.1, 0.0, 0.07)}, "no room"),
    ({"mass": (2.0, 1.0)}, "--mass 2.0 1.0"), ({"mass": (0.0, 1.0)}, "--mass"), ({"support": (0.5, 0.2)}, "--support"),
    ({"mu_dynamic": (-0.1, 0.2)}, "--mu-dynamic"), ({"support_offset": (0.1, 0.0)}, "--support-offset"),
    ({"support": (0.0, 2.0)}, "up to 1"), ({"support_offset": (0.0, 0.06)}, "up to 0.05"),
    ({"box": (0.12, np.nan, 0.07)}, "--box"), ({"noise": (np.inf, 0, 0, 0, 0)}, "--noise"),
    ({"pusher_height": 0.08}, "--pusher-height"), ({"pusher_height": 0.01}, "--pusher-"),
    ({"restitution": (0.0, 2.0)}, "up to 1"), ({"occlusion_start": 2.0}, "at most 1"),
    ({"time_limit": 0.5}, "--time-limit 0.5: in s, 1 to 3600"), ({"time_limit": np.nan}, "--time-limit nan")])
def test_no_such_world(changes, words):
    with pytest.raises(ValueError, match=words):
        World(**changes)


def test_near_starts_are_an_aid():
    env = PushVectorEnv(400)
    env.near_share = 0.5
    env.reset(seed=9)
    box, pusher = env.box.copy(), env.pusher.copy()
    aided = env.step(np.full((400, 2), 5))[4]["aided"]
    near = np.array([geometry.nearest(*start)[0] for start in zip(box, pusher)]) <= 0.03
    assert 0.4 < aided.mean() < 0.6 and near[aided].all()
    assert 0.5 < near.mean() < 0.75  # some are near by chance
    assert np.linalg.norm(box[near, :2], axis=1).mean() < 0.8 * np.linalg.norm(box[~near, :2], axis=1).mean()


@pytest.mark.parametrize("name", RANGES)
def test_dynamics_are_drawn_anew_from_the_table(name):
    env = PushVectorEnv(2000)
    env.reset(seed=10)
    first = env.dynamics[name].copy()
    low, high = RANGES[name]
    assert low <= first.min() < low + 0.01 * (high - low) and high - 0.01 * (high - low) < first.max() <= high
    assert first.mean() == pytest.approx((low + high) / 2, abs=0.03 * (high - low))
    env.reset()
    assert not (env.dynamics[name] == first).any()
    assert np.abs(np.corrcoef([env.dynamics[other] for other in RANGES]) - np.eye(len(RANGES))).max() < 0.1


def test_reset_takes_any_subset_of_the_options():
    env = PushVectorEnv(3)
    boxes = np.array([[0.1, 0, 1], [0, 0.02, 2], [-0.1, 0, 3]])
    obs, infos = env.reset(seed=11, options={"box": boxes, "mass": 3.3})
    assert (env.box == boxes).all() and (env.dynamics["mass"] == 3.3).all()
    assert len(set(env.dynamics["mu_static"])) == 3
    assert (infos["state"] == env.state).all() and (obs == task.scale(env.state)).all()
    env.reset(options={"pusher": [0.2, 0.1], "restitution": [0.2, 0.3, 0.4]})
    assert (env.pusher == [0.2, 0.1]).all() and (env.dynamics["restitution"] == [0.2, 0.3, 0.4]).all()
    assert not (env.box == boxes).any()


@pytest.mark.parametrize("given", [{"box": [0.02, 0, 0.3]}, {"pusher": [0.02, 0.01]}])
def test_what_is_not_given_keeps_clear_of_what_is(given):
    env = PushVectorEnv(300)
    env.reset(seed=12, options=given)
    assert min(geometry.nearest(box, pusher)[0] for box, pusher in zip(env.box, env.pusher)) >= 0.001


@pytest.mark.parametrize("options", [
    {"masss": 3.0}, {"box": [0, 0]}, {"box": 0.1}, {"box": np.zeros((2, 3))}, {"pusher": np.zeros((3, 1))}, {"mass": [3, 3]},
    {"mass": np.full((3, 1), 3)}, {"mass": 0}, {"limit_surface_c": 0}, {"mu_pusher": -0.1}, {"restitution": np.nan},
    {"box": [np.inf, 0, 0]},
    {"mass": "heavy"},
])
def test_wrong_options_are_refused(options):
    with pytest.raises(ValueError):
        PushVectorEnv(3).reset(options=options)


def test_reward_is_the_papers():
    env = start(box=[0.1, -0.05, np.pi / 2], pusher=[-0.2, 0])
    _, reward, *_ = env.step([[8, 0]])  # (0.03, -0.05) m/s
    d_trans = 0.1118034 / 0.6708204  # |(0.1, -0.05)| of the workspace's diagonal
    v_p = 0.0583095 / 0.0707107
    assert reward[0] == pytest.approx(0.1 * (1 - d_trans) + 0.02 * (1 - 0.5) + 0.004 * (1 - v_p), abs=1e-6)


@pytest.mark.parametrize("box, success", [([0.0099, 0, 0], True), ([0.0101, 0, 0], False), ([0.0072, 0.0072, 0], False),
                                          ([0, 0, np.deg2rad(14.9)], True), ([0, 0, np.deg2rad(-15.1)], False),
                                          ([0, 0, 2 * np.pi], True)])
def test_success_ends_the_episode(box, success):
    _, reward, terminated, truncated, infos = start(box=box, pusher=[-0.2, 0]).step([[REST, REST]])
    assert terminated[0] == infos["success"][0] == success and not truncated[0]
    assert (reward[0] > 49) == success


@pytest.mark.parametrize("options", [{"pusher": [0.299, 0.1]}, {"pusher": [0.1, 0.149]}, {"box": [0.301, 0, 0]},
                                     {"box": [0.1, -0.151, 0]}])
def test_leaving_the_workspace_ends_the_episode(options):
    _, reward, terminated, truncated, infos = start(**{"box": [0.1, 0, 0], "pusher": [-0.2, 0]} | options).step([[10, 10]])
    assert terminated[0] and not infos["success"][0] and not truncated[0]
    assert -10 < reward[0] < -9.8


def test_success_is_looked_at_before_out_of_bounds():
    _, reward, terminated, _, infos = start(pusher=[0.299, 0]).step([[10, REST]])
    assert abs(infos["final_state"][0, 3]) > 0.3
    assert terminated[0] and infos["success"][0] and reward[0] > 50


def test_tolerance_is_an_aid():
    env = start(box=[0.02, 0, np.deg2rad(40)], pusher=[-0.2, 0])
    env.tolerance = 4.0
    assert env.step([[REST, REST]])[4]["success"][0]


@pytest.mark.parametrize("seconds", [20.0, 3.0])
def test_time_limit_truncates(seconds):
    env = PushVectorEnv(2, world=World(time_limit=seconds))
    env.reset(options=MIDDLE | {"box": [0.1, 0, 0], "pusher": [-0.2, 0]})
    for t in range(int(15 * seconds)):
        _, _, terminated, truncated, _ = env.step(np.full((2, 2), REST))
        assert not terminated.any() and (truncated == (t == 15 * seconds - 1)).all()
    assert not env.step(np.full((2, 2), REST))[3].any()  # the clock starts anew


def test_autoreset_happens_in_the_same_step():
    assert PushVectorEnv.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env = start(3, box=[0.1, 0, 0], pusher=[[-0.2, 0], [0.299, 0.1], [-0.1, 0]])
    obs, _, terminated, truncated, infos = env.step([[10, REST]] * 3)
    assert (terminated == [False, True, False]).all() and not truncated.any()
    assert (infos["_final_obs"] == terminated).all()
    assert infos["final_state"][1, 3] == pytest.approx(0.299 + 0.05 / 15)
    assert (infos["final_obs"] == task.scale(infos["final_state"])).all()
    assert (infos["state"] == env.state).all() and (obs == task.scale(env.state)).all()
    assert (obs[[0, 2]] == infos["final_obs"][[0, 2]]).all() and not (obs[1, :6] == infos["final_obs"][1, :6]).any()
    assert env.dynamics["mass"][0] == 3.25 != env.dynamics["mass"][1]
    assert geometry.nearest(env.box[1], env.pusher[1])[0] >= 0.001 and (env.force[1] == 0).all()
    assert "final_obs" not in env.step(np.full((3, 2), REST))[4]


def test_observation_is_the_scaled_state():
    env = start(box=[0.15, -0.03, 0.5], pusher=[-0.09, 0.06])
    obs = env.step([[REST, REST]])[0]
    assert obs[0] == pytest.approx([0.5, -0.2, np.sin(0.5), np.cos(0.5), -0.3, 0.4, 0, 0], abs=1e-6)
    assert obs in env.observation_space and obs.dtype == np.float32


def test_gymnasium_accepts_the_environment():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make("Push-v0", render_mode="rgb_array").unwrapped)
    assert gym.make("common.env:Push-v0").spec.id == "Push-v0"
    for kind, mode in (PushVectorEnv, "vector_entry_point"), (gym.vector.SyncVectorEnv, "sync"):
        env = gym.make_vec("Push-v0", num_envs=8, vectorization_mode=mode)
        assert isinstance(env, kind)
        obs, _ = env.reset(seed=0)
        assert obs in env.observation_space
        assert env.step(env.action_space.sample())[0].shape == (8, 8)


def test_push_env_is_one_world_of_the_vector_env():
    one, many = PushEnv(), PushVectorEnv(1)
    options = {"box": [0.1, 0, 0.2], "pusher": [0.0, 0.01]} | MIDDLE
    assert (one.reset(seed=3, options=options)[0] == many.reset(seed=3, options=options)[0][0]).all()
    for _ in range(30):
        obs, reward, terminated, truncated, info = one.step([9, REST])
        expected = many.step([[9, REST]])
        assert (obs == expected[0][0]).all() and reward == expected[1][0] and (terminated, truncated) == (False, False)
        assert (info["state"] == many.state[0]).all()
        assert info["distance"] == geometry.nearest(info["state"][:3], info["state"][3:5])[0]
    assert abs(info["distance"]) < 2e-4 and info["state"][5] < -1  # it pushes


def test_push_env_ends_without_a_new_start():
    env = PushEnv()
    env.reset(options={"box": [0.1, 0, 0], "pusher": [0.299, 0.1]})
    obs, reward, terminated, truncated, info = env.step([10, REST])
    assert terminated and not truncated and reward < -9 and obs[4] > 1


@pytest.mark.parametrize("box, pusher", [([0.12, -0.06, 0.0], [-0.21, 0.09]), ([-0.18, 0.05, np.pi / 2], [0.15, -0.1])])
def test_picture_shows_box_and_pusher_where_they_are(box, pusher):
    env = PushEnv("rgb_array")
    env.reset(options={"box": box, "pusher": pusher})
    image = env.render()
    assert image.shape == (400, 800, 3) and image.dtype == np.uint8

    def centre(mask):  # m
        rows, columns = np.nonzero(mask)
        return np.array([columns.mean() - 399.5, 199.5 - rows.mean()]) * 0.66 / 800

    red, green, blue = image.astype(int).transpose(2, 0, 1)
    is_pusher, is_box = (red > 180) & (green < 90) & (blue < 90), (red < 60) & (blue < 160)
    assert centre(is_pusher) == pytest.approx(pusher, abs=0.001)
    assert is_pusher.sum() * (0.66 / 800)**2 == pytest.approx(np.pi * 0.013**2, rel=0.1)
    assert is_box.sum() * (0.66 / 800)**2 == pytest.approx(0.12 * 0.10, rel=0.05)
    height, width = (np.ptp(axis) * 0.66 / 800 for axis in np.nonzero(is_box))
    assert (height < width) == (box[2] == 0)
    assert centre(is_box) == pytest.approx(box[:2], abs=0.002)  # the white line to its front takes a little
    assert (image[200, 400] < 255).any()  # the target
