"""The filter of simulated worlds, and the copies of worlds that it lives on."""
import numpy as np
import pytest
import torch
from test_simulator import play, random_pushes, start

from common import particles, task
from common.env import PushVectorEnv
from common.observation import ObservationModel


def pushed(seed=0, steps=60):
    """States (T, 7) of a box that is pushed off its centre, with drawn dynamics."""
    env = PushVectorEnv(1)
    env.reset(seed=seed, options={"box": [-0.1, 0, 0.2], "pusher": [-0.185, 0.0]})
    states = [env.state]
    for t in range(steps):
        env.advance([[9, 5 + t % 2]])
        states.append(env.state)
    return np.concatenate(states)


def followed(observations, num=300, seed=0, world=task.World()):
    """The filter, and its means and variances (T, 4)."""
    f = particles.Filter(num, world, seed)
    told = [(f.step if t else f.begin)(o) for t, o in enumerate(observations)]
    return f, *map(np.array, zip(*told))


def observed(states, occlusion, seed=1):
    return ObservationModel(1, seed, occlusion).trajectory(states[:, None])[:, 0]


def off(mean, states):
    """Errors (T,) in m."""
    return np.linalg.norm(mean[:, :2] * task.HALF - states[:, :2], axis=1)


def test_a_copy_of_a_world_goes_on_as_the_world():
    rng = np.random.default_rng(2)
    options, action = random_pushes(20, rng)
    original, copy = start(20, **options), start(20)
    play(original, action, 10)
    held = original.force.any(1)
    assert 0 < held.sum() < 20 or held.all()
    order = rng.permutation(20)
    dynamics = {name: value[order] for name, value in original.dynamics.items()}
    worlds = original.worlds
    moving = worlds.motion[:, order, 3:], worlds.force[order]
    copy.worlds.place(np.arange(20), worlds.box[order], worlds.pusher[order], dynamics, *moving)
    gone, other = play(original, action, 10)[:, order], play(copy, action[order], 10)
    assert other[..., :3] == pytest.approx(gone[..., :3], abs=1e-3)
    assert np.median(np.abs(other - gone)[..., :2]) < 1e-5  # Chipmunk's last impulses are not copied


def test_the_filter_follows_a_box_that_is_not_seen():
    errors, sights = [], []
    for seed in range(4):
        states = pushed(seed)
        o = observed(states, 0.0, seed)
        o[1:, :4], o[1:, 8] = o[0, :4], 1  # never seen again
        mean = followed(o, seed=seed)[1]
        errors.append(off(mean, states)[-15:].mean())
        sights.append(off(o, states)[-15:].mean())
    assert np.mean(sights) > 0.05 and np.mean(errors) < 0.2 * np.mean(sights)


def test_its_spread_grows_while_the_box_is_pushed_unseen_and_covers_the_truth():
    states = pushed()
    o = observed(states, 0.0)
    o[1:, :4], o[1:, 8] = o[0, :4], 1
    f, mean, variance = followed(o)
    q = task.scale(states)[:, :4]
    assert ((mean - q)**2 < 16 * variance + 1e-6).mean() > 0.9
    assert f.worlds.pusher == pytest.approx(np.tile(states[-1, 3:5], (f.num, 1)), abs=1e-6)


def test_seen_all_the_time_it_is_better_than_the_sight():
    errors, sights = [], []
    for seed in range(6):  # the sensor's bias, which no single episode tells from the pose, is another one in each
        states = pushed(seed)
        o = observed(states, 0.0, seed)
        errors.append(off(followed(o, seed=seed)[1], states)[10:].mean())
        sights.append(off(o, states)[10:].mean())
    assert np.mean(errors) < 0.8 * np.mean(sights)


def test_it_finds_the_box_again():
    states = pushed(2)
    o = observed(states, 0.0)
    o[20:, 0] += 0.3  # moved 9 cm by another hand
    mean = followed(o)[1]
    assert np.abs(mean[25:, 0] - o[25:, 0]).mean() < 0.05


def test_a_seed_fixes_what_it_tells():
    o = observed(pushed(steps=20), 0.0)
    first, second, other = (followed(o, 50, seed)[1] for seed in (0, 0, 1))
    assert np.array_equal(first, second) and not np.array_equal(first, other)


def test_drawn_again_the_dynamics_stay_in_their_ranges():
    world = task.World()
    f = followed(observed(pushed(), 0.0))[0]
    for name, (low, high) in world.dynamics.items():
        assert low <= f.worlds.dynamics[name].min() and f.worlds.dynamics[name].max() <= high, name
    assert (f.worlds.dynamics["mu_static"] >= f.worlds.dynamics["mu_dynamic"]).all()
    assert len(set(f.worlds.dynamics["mass"])) > f.num / 2


def test_sensors_without_noise_are_no_division_by_zero():
    sure = task.World(noise=(0.0025, 0.0025, 0.05, 0, 0), bias=(0.0025, 0.0025, 0.05, 0, 0))
    states = pushed(steps=30)
    o = ObservationModel(1, 1, 0.0, sure).trajectory(states[:, None])[:, 0]
    assert np.isfinite(np.concatenate(followed(o, 100, world=sure)[1:])).all()


def test_each_trajectory_has_draws_of_its_own():
    o = torch.as_tensor(np.repeat(observed(pushed(steps=5), 0.0)[:, None], 2, 1))
    mean = particles.Filters(50).predict(o)[0]
    torch.manual_seed(0)
    again = particles.Filters(50).predict(o)[0]
    assert not mean[:, 0].equal(mean[:, 1]) and mean.equal(again)  # conftest has seeded torch with 0
