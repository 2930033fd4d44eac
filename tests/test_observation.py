import math

import numpy as np
import pytest

from common import task
from common.env import PushVectorEnv
from common.observation import ObservationModel, Observed
from common.task import Other, World

VISION = np.s_[..., :4]  # the box in an observation


def moving(steps, num):
    """States (T, N, 7) in which everything changes at every step."""
    rng = np.random.default_rng(1)
    s = rng.uniform(-1, 1, (steps, num, 7)) * [0.3, 0.15, np.pi, 0.3, 0.15, 5, 5]
    return s.astype(np.float32)


def errors(o, states):
    """o - s of box x, y, angle and force (..., 5), in SI units; unoccluded, unclipped."""
    pose = task.unscale_pose(o[VISION])
    force = o[..., 6:8] * World.max_force
    return np.concatenate([pose[..., :2] - states[..., :2], task.wrap(pose[..., 2:] - states[..., 2:3]),
                           force - states[..., 5:]], -1)


def runs(hidden):
    """Lengths of the stretches of True that begin and end within a sequence (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], hidden]).astype(int)))
    return np.diff(edges)[::2] if len(edges) > 1 else np.empty(0, int)


def test_bias_is_drawn_per_episode_and_noise_per_step_as_in_the_table():
    steps, num = 30, 4000
    states = moving(steps, num)
    e = errors(ObservationModel(num, 0, 0).trajectory(states), states)
    bias, noise = e.mean(0), e - e.mean(0)
    np.testing.assert_allclose(noise.std((0, 1)) * np.sqrt(steps / (steps - 1)), World.noise, rtol=0.02)
    np.testing.assert_allclose(bias.std(0), np.array(World.bias) * np.sqrt(1 + 1 / steps), rtol=0.05)
    assert (np.abs(bias.mean(0)) < World.bias * np.array(4) / np.sqrt(num)).all()
    assert np.abs(np.corrcoef(bias.T) - np.eye(5)).max() < 0.07
    assert np.abs(np.corrcoef(noise[0].T) - np.eye(5)).max() < 0.07
    assert np.abs(np.corrcoef(noise[3, :, 0], noise[4, :, 0])[0, 1]) < 0.1  # one step says nothing of the next


def test_the_pusher_is_exact_and_the_rest_is_not():
    states = moving(20, 50)
    o, s = ObservationModel(50, 0).trajectory(states), task.scale(states)
    assert o.dtype == np.float32 and o.shape == (20, 50, 9)
    assert (o[..., 4:6] == s[..., 4:6]).all()
    assert (o[..., 6:8] != s[..., 6:8]).mean() > 0.99


def test_force_is_clipped_after_the_noise():
    states = np.zeros((20, 2000, 7), np.float32)
    states[..., 5], states[..., 6] = 11, -40
    o = ObservationModel(2000, 0).trajectory(states)
    below = 0.5 * (1 + math.erf(-1 / (0.7 * math.sqrt(2)) / math.sqrt(2)))  # bias + noise below -1 N
    assert np.abs(o[..., 6]).max() == 1 and np.mean(o[..., 6] < 1) == pytest.approx(below, abs=0.03)
    assert (o[..., 7] == -1).all()


def test_an_occlusion_holds_the_last_noisy_box_bit_for_bit_and_nothing_else():
    o = ObservationModel(200, 0).trajectory(moving(300, 200))
    hidden = o[1:, :, 8] == 1
    assert 0.5 < hidden.mean() < 0.9
    assert (o[1:][VISION] == o[:-1][VISION])[hidden].all()
    assert not (o[1:][VISION] == o[:-1][VISION])[~hidden].all(-1).any()
    assert not (o[1:, :, 4:8] == o[:-1, :, 4:8])[hidden].all(-1).any()
    assert np.isin(o[..., 8], (0, 1)).all()


def test_occlusions_start_with_p_at_visible_frames_but_never_at_the_first():
    xi = ObservationModel(3000, 0).trajectory(np.zeros((300, 3000, 7), np.float32))[..., 8]
    assert not xi[0].any()
    from_visible = xi[1:][xi[:-1] == 0]
    longer_than_half_a_frame = 0.5 * (1 + math.erf((10 - 0.5 / 15) / 5 / math.sqrt(2)))
    p = longer_than_half_a_frame / 30
    assert from_visible.mean() == pytest.approx(p, abs=4 * np.sqrt(p / from_visible.size))


def test_durations_are_those_of_the_table():
    xi = ObservationModel(2000, 0).trajectory(np.zeros((640, 2000, 7), np.float32))[..., 8] > 0
    early = xi[:16].any(0)  # 40 s are left: nothing is cut
    frames = np.array([runs(world)[0] for world in xi.T[early]])
    drawn = np.round(15 * np.random.default_rng(0).normal(10, 5, 10**6))
    drawn = drawn[drawn > 0]
    assert len(frames) > 700
    assert frames.mean() == pytest.approx(drawn.mean(), rel=0.06) and frames.std() == pytest.approx(drawn.std(), rel=0.08)
    np.testing.assert_allclose(np.quantile(frames, [0.1, 0.5, 0.9]), np.quantile(drawn, [0.1, 0.5, 0.9]), atol=14)


@pytest.mark.parametrize("seconds, frames", [(0.5, 8), (2.5, 38), (5, 75), (0.02, 0), (0, 0), (-3, 0)])
def test_a_fixed_duration_with_one_seen_frame_between(seconds, frames):
    at_every_chance = World(occlusion_start=1.0)
    xi = ObservationModel(3, 0, seconds, at_every_chance).trajectory(np.zeros((200, 3, 7), np.float32))[..., 8]
    assert (xi[:, 0] == (np.arange(200) % (frames + 1) > 0)).all() and (xi == xi[:, :1]).all()


def test_negative_durations_of_the_table_hide_nothing():
    model = ObservationModel(100, world=World(occlusion=(-50.0, 5.0)))
    assert not model.trajectory(np.zeros((100, 100, 7), np.float32))[..., 8].any()


def test_noise_bias_and_force_are_the_worlds():
    steps, num = 30, 4000
    world = World(noise=(0.001, 0.002, 0.03, 0.4, 0.5), bias=(0.006, 0.007, 0.08, 0.9, 1.0), max_force=50.0)
    states = moving(steps, num)
    o = ObservationModel(num, 0, 0, world).trajectory(states)
    o[..., 6:8] *= world.max_force / World.max_force
    e = errors(o, states)
    bias, noise = e.mean(0), e - e.mean(0)
    np.testing.assert_allclose(noise.std((0, 1)) * np.sqrt(steps / (steps - 1)), world.noise, rtol=0.02)
    np.testing.assert_allclose(bias.std(0), np.hypot(world.bias, np.array(world.noise) / np.sqrt(steps)), rtol=0.05)


@pytest.mark.parametrize("late", [1, 2])
def test_a_late_camera_shows_the_box_of_before_and_the_force_of_now(late):
    states = moving(40, 30)
    now, then = (ObservationModel(30, 0, world=Other(late=k)).trajectory(states) for k in (0, late))
    behind = states.copy()
    behind[..., :3] = states[np.maximum(np.arange(40) - late, 0), :, :3]
    np.testing.assert_array_equal(then, ObservationModel(30, 0).trajectory(behind))
    np.testing.assert_array_equal(then[..., 4:], now[..., 4:])


def test_a_late_camera_forgets_the_episode_before():
    model, states = ObservationModel(4, 0, 0, Other(late=2)), moving(6, 4)
    model.trajectory(states)
    model.reset(np.array([1]), states[:1, 1] + 0.01)
    off = errors(model.step(states[1] + 0.01), states[0] + 0.01)
    assert np.abs(off[1, :2]).max() < 0.02 < np.abs(off[[0, 2, 3], :2]).max()


def test_the_force_has_a_gain():
    states = moving(20, 50)
    one, other = (ObservationModel(50, 0, world=Other(gain=gain, max_force=99.0)).trajectory(states) for gain in (1.0, 0.7))
    np.testing.assert_array_equal(one[..., :6], other[..., :6])
    np.testing.assert_allclose((one - other)[..., 6:8] * 99, 0.3 * states[..., 5:], atol=1e-4)


def test_until_the_end():
    xi = ObservationModel(3000, 0, math.inf).trajectory(np.zeros((300, 3000, 7), np.float32))[..., 8]
    assert (np.diff(xi, axis=0) >= 0).all()
    for t in (1, 10, 30, 100):
        assert xi[t].mean() == pytest.approx(1 - (29 / 30)**t, abs=0.03)


def test_the_same_seed_draws_the_same_whatever_the_states_are():
    a, b = moving(60, 40), moving(60, 40)[::-1]
    o_a, o_b = (ObservationModel(40, 7).trajectory(s) for s in (a, b))
    assert (o_a[..., 8] == o_b[..., 8]).all()
    seen = o_a[..., 8] == 0
    np.testing.assert_allclose(errors(o_a, a)[seen], errors(o_b, b)[seen], atol=1e-5)
    assert not np.allclose(errors(ObservationModel(40, 8).trajectory(a), a)[seen], errors(o_a, a)[seen], atol=1e-3)


def test_a_new_episode_in_one_world_leaves_the_others_draws():
    states = moving(50, 6)
    plain, other = ObservationModel(6, 3), ObservationModel(6, 3)
    o = plain.trajectory(states)
    assert (other.trajectory(states[:20]) == o[:20]).all()
    before = other.bias.copy()
    first = other.reset(np.array([2, 5]), states[20][[2, 5]])
    assert (first[:, 8] == 0).all()
    assert ((other.bias != before).any(1) == np.isin(np.arange(6), (2, 5))).all()
    stay = [0, 1, 3, 4]
    assert all((other.step(states[t])[stay] == o[t][stay]).all() for t in range(20, 50))


# In a running env


def straight(num):
    """Actions (N, 2) that drive every pusher out of the workspace sooner or later."""
    return np.random.default_rng(3).choice([0, 10], (num, 2)).astype(int)


def test_a_running_env_and_stored_trajectories_are_observed_alike():
    num, steps = 16, 180
    env, actions = Observed(PushVectorEnv(num)), straight(num)
    o, infos = env.reset(seed=11)
    seen, states, alive = [o], [infos["state"]], np.ones(num, bool)
    last = np.zeros(num, int)
    for t in range(1, steps):
        o, _, terminated, truncated, infos = env.step(actions)
        final = infos.get("final_obs", o)
        seen.append(final), states.append(infos.get("final_state", infos["state"]))
        last[alive] = t
        alive &= ~(terminated | truncated)
    stored = ObservationModel(num, 11).trajectory(np.stack(states).astype(np.float32))
    assert (~alive).sum() >= 10
    for world in range(num):
        assert (stored[:last[world] + 1, world] == np.stack(seen)[:last[world] + 1, world]).all()


def test_final_obs_is_of_the_ended_episode_and_the_next_observation_of_the_new_one():
    num = 24
    env, actions = Observed(PushVectorEnv(num)), straight(num)
    o, _ = env.reset(seed=0)
    env.model.bias[:12] = [0.1, -0.1, 0.3, 3, -3]  # marks the first episodes, far outside the noise
    env.model.hidden[:] = np.where(np.arange(num) < 12, 0, math.inf)
    env.model.occlusion, held = 0, o[VISION].copy()
    checked = set()
    for _ in range(200):
        o, _, _, _, infos = env.step(actions)
        for world in set(np.flatnonzero(infos.get("_final_obs", []))) - checked:
            final, state = infos["final_obs"][world], infos["final_state"][world]
            if world < 12:
                off = errors(final, state) / [0.1, -0.1, 0.3, 3, -3]
                assert (np.abs(off[[0, 1, 2]] - 1) < 0.9).all() and final[8] == 0
            else:
                assert (final[VISION] == held[world]).all() and final[8] == 1
            assert (final[4:6] == task.scale(state.astype(np.float32))[4:6]).all()
            assert o[world, 8] == 0
            assert (np.abs(errors(o[world], infos["state"][world])) < World.noise * np.array(7)).all()
            checked.add(world)
    assert len(checked & set(range(12))) > 5 and len(checked - set(range(12))) > 5


def test_reset_with_a_seed_repeats_an_observed_episode_whatever_came_before():
    env, actions = Observed(PushVectorEnv(32)), np.random.default_rng(0).integers(0, 11, (100, 32, 2))
    env.unwrapped.near_share = 1.0  # much contact
    first, again = ([env.reset(seed=5)[0], *(env.step(a)[0] for a in actions)] for _ in range(2))
    assert (np.stack(first) == np.stack(again)).all()
