"""The simulator against closed forms, the integrated quasi-static solution and itself, and its gymnasium contract."""
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from common import draw, geometry, task
from common.env import PushEnv, PushVectorEnv
from common.simulator import SUB_STEPS
from common.task import Other, World

C = [0.042, 0.060, 0.078]  # m: even pressure, between, four corners
G = task.GRAVITY
HALF_BOX = np.array(World.box[:2]) / 2
GYRATION = (0.12**2 + 0.10**2) / 12  # m^2, moment of inertia / mass
REST = 5  # the bin of zero velocity
MIDDLE = {"mass": 3.25, "mu_static": 0.4, "mu_dynamic": 0.2, "mu_pusher": 0.2, "restitution": 0.4, "limit_surface_c": 0.060}
RANGES = {"mass": (3.0, 3.5), "mu_static": (0.3, 0.5), "mu_dynamic": (0.1, 0.3), "mu_pusher": (0.1, 0.3),
          "restitution": (0.1, 0.7), "limit_surface_c": (0.04219, 0.07811)}


def start(num=1, *, sub_steps=SUB_STEPS, **options):
    """Worlds with a box at the centre, the pusher far from it and the middle of the dynamics, unless given."""
    env = PushVectorEnv(num, sub_steps=sub_steps)
    env.reset(seed=0, options={"box": [0, 0, 0], "pusher": [-1, -1]} | MIDDLE | options)
    return env


def play(env, action, steps):
    """States (T, N, 7) under one action, or under actions (T, N, 2)."""
    action = np.broadcast_to(action, (steps, env.num_envs, 2))
    states = []
    for t in range(steps):
        env.advance(action[t])
        states.append(env.state)
    return np.array(states)


def launch(env, velocity, omega=0.0):
    env.worlds.motion[0, :, 3:5], env.worlds.motion[0, :, 5] = velocity, omega


def west(offset, gap=0.0):
    """A pusher (N, 2) that touches the -x side of a box at the centre, `offset` m from the side's middle."""
    offset = np.atleast_1d(offset)
    return np.stack([np.full(len(offset), -HALF_BOX[0] - task.RADIUS - gap), offset], 1)


def random_pushes(num, rng):
    """Constant pushes against a random place of the -x or -y side, from 0.1 mm away, with drawn dynamics."""
    side, offset = rng.integers(0, 2, num), rng.uniform(-0.95, 0.95, num)
    away = -HALF_BOX[side] - task.RADIUS - 1e-4
    along = offset * HALF_BOX[1 - side]
    push = rng.integers(1, 6, num)
    slip = np.rint(push * rng.uniform(-1, 1, num)).astype(int)
    pusher = np.where(side[:, None] == 0, np.stack([away, along], 1), np.stack([along, away], 1))
    action = REST + np.where(side[:, None] == 0, np.stack([push, slip], 1), np.stack([slip, push], 1))
    return {"pusher": pusher} | {name: rng.uniform(*limits, num) for name, limits in RANGES.items()}, action


@pytest.mark.parametrize("speed", [0.05, 0.2, 0.5, 1.0])
def test_sliding_box_stops_after_its_braking_distance(speed):
    mu = np.array([0.1, 0.2, 0.3, 0.2])
    heading = np.array([0.0, 0.4, 2.0, -1.5])
    env = start(4, box=[[0, 0, 0], [0, 0, 0.3], [0, 0, -2], [0, 0, 1]], mu_dynamic=mu)
    launch(env, speed * np.stack([np.cos(heading), np.sin(heading)], 1))
    states = play(env, REST, 30)
    assert (states[-1] == states[-2]).all()
    assert np.linalg.norm(env.box[:, :2], axis=1) == pytest.approx(speed**2 / (2 * mu * G), rel=0.03)
    assert env.box[:, 2] == pytest.approx([0, 0.3, -2, 1])


@pytest.mark.parametrize("c", C)
@pytest.mark.parametrize("omega", [1.0, -5.0, 20.0])
def test_spinning_box_stops_as_its_limit_surface_says(omega, c):
    env = start(mu_dynamic=0.15, limit_surface_c=c)
    launch(env, (0, 0), omega)
    play(env, REST, 30)
    braking = 0.15 * G * c / GYRATION  # mu m g c / I
    assert env.box[0, 2] == pytest.approx(omega * abs(omega) / (2 * braking), rel=0.03)
    assert env.box[0, :2] == pytest.approx([0, 0], abs=1e-12)


@pytest.mark.parametrize("c", C)
@pytest.mark.parametrize("speed, omega", [(0.3, 3.0), (0.3, -10.0), (0.1, 5.0)])
def test_box_that_slides_and_spins_slows_as_its_limit_surface_says(speed, omega, c):
    mu, v, w, x, theta, dt = 0.2, speed, omega, 0.0, 0.0, 1e-5
    while (n := np.hypot(v, c * w)) > 2 * mu * G * dt:
        x, theta = x + v * dt, theta + w * dt
        v, w = v - mu * G * v / n * dt, w - mu * G * c**2 / GYRATION * w / n * dt
    env = start(mu_dynamic=mu, limit_surface_c=c)
    launch(env, (speed, 0), omega)
    play(env, REST, 30)
    assert env.box[0, [0, 2]] == pytest.approx([x, theta], rel=0.03 if c < 0.07 else 0.055)  # it stops within few sub-steps


@pytest.mark.parametrize("bin_", [6, 8, 10])
def test_pushed_box_feels_dynamic_friction(bin_):
    mass, mu = np.array([3.0, 3.25, 3.5]), np.array([0.1, 0.2, 0.3])
    env = start(3, pusher=west([0, 0, 0], 0.001), mass=mass, mu_dynamic=mu, mu_pusher=0.3)
    force = play(env, [bin_, REST], 30)[10:, :, 5:]
    assert force[..., 0] == pytest.approx(np.tile(-mu * mass * G, (20, 1)), rel=0.03)  # the pusher feels -x
    assert force[..., 1] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5])
def test_static_friction_holds_up_to_its_limit(angle):
    """The table tilted by tan(slope) = `pull` / g."""
    mu = np.array([0.3, 0.4, 0.5])
    for pull, moves in (0.98, False), (1.02, True):
        for i in range(3):
            env = start(box=[0, 0, 0.5], mu_static=mu[i])
            env.worlds.parts[0].space.gravity = tuple(pull * mu[i] * G * np.array([np.cos(angle), np.sin(angle)]))
            play(env, REST, 15)
            travel = env.box[0] - [0, 0, 0.5]
            assert (np.linalg.norm(travel[:2]) > 0.01) == moves
            assert moves or np.abs(travel).max() < 1e-9


def test_sliding_box_brakes_by_what_friction_leaves_of_a_slope_and_then_holds():
    env = start(mu_dynamic=0.2)
    env.worlds.parts[0].space.gravity = (0.1 * G, 0)
    launch(env, (0.5, 0))
    states = play(env, REST, 30)
    assert env.box[0, 0] == pytest.approx(0.5**2 / (2 * 0.1 * G), rel=0.03)
    assert (states[-1] == states[-5]).all()


def quasi_static(offset, mu_pusher, speed, c, seconds, dt=5e-4):
    """Box poses (N, 3) after a push along +x with the sphere from the -x side at `offset`, in the quasi-static limit.

    The box moves by the ellipsoidal limit surface, v = k f and omega = k tau / c^2, in the box frame. The force lies in the
    friction cone: the contact sticks if the force that carries the box's point along with the pusher does (Mason; Lynch,
    Maekawa and Tanie 1992), else it slides with the force on the cone's edge.
    """
    box, pusher = np.zeros((len(offset), 3)), west(offset)
    for _ in range(round(seconds / dt)):
        cos, sin = np.cos(box[:, 2]), np.sin(box[:, 2])
        u = speed[:, None] * np.stack([cos, -sin], 1)  # the pusher's velocity in the box frame
        x, y = -HALF_BOX[0], cos * (pusher[:, 1] - box[:, 1]) - sin * (pusher[:, 0] - box[:, 0])  # the contact
        nn, nt, tt = 1 + y**2 / c**2, -x * y / c**2, 1 + x**2 / c**2  # velocity of the contact = k [nn nt; nt tt] f
        normal = (tt * u[:, 0] - nt * u[:, 1]) / (nn * tt - nt**2)
        tangential = (nn * u[:, 1] - nt * u[:, 0]) / (nn * tt - nt**2)
        edge = mu_pusher * np.sign(tangential)
        slides = np.abs(tangential) > mu_pusher * normal
        normal = np.where(slides, u[:, 0] / (nn + nt * edge), normal)
        tangential = np.where(slides, edge * normal, tangential)
        omega = (x * tangential - y * normal) / c**2
        box += dt * np.stack([cos * normal - sin * tangential, sin * normal + cos * tangential, omega], 1)
        pusher[:, 0] += speed * dt
    return box


def test_a_push_through_the_centre_of_friction_turns_nothing():
    offset, tilt = np.array([[0.0, 0.02], [0.02, -0.03], [0.01, 0.0], [-0.03, 0.04]]), np.array([0, np.pi / 2, np.pi, -np.pi / 2])
    along = np.array([geometry.rotation(angle) @ d for angle, d in zip(tilt, offset)])  # in the world's frame
    half = np.where(np.arange(4) % 2 == 0, *HALF_BOX)
    pusher = np.stack([-half - task.RADIUS, along[:, 1]], 1)
    poses = np.pad(tilt[:, None], ((0, 0), (2, 0)))
    env = start(4, box=poses, pusher=pusher, mu_pusher=0, support_x=offset[:, 0], support_y=offset[:, 1])
    play(env, [10, REST], 30)
    assert env.box[:, 0] == pytest.approx(0.1, abs=0.004) and np.abs(env.box - poses)[:, 1:].max() < 1e-3
    centred = start(4, box=poses, pusher=pusher, mu_pusher=0)
    play(centred, [10, REST], 30)
    assert (np.abs(centred.box - poses)[[0, 1, 3], 2] > 0.2).all()


def test_a_box_spins_about_its_centre_of_friction():
    env = start(box=[0.1, 0, 0.3], mu_dynamic=0.15, support_x=0.02, support_y=-0.01)
    launch(env, (0, 0), 8.0)
    play(env, REST, 30)
    moved = env.box[0, :2] + geometry.rotation(env.box[0, 2]) @ [0.02, -0.01]
    assert moved == pytest.approx([0.1, 0] + geometry.rotation(0.3) @ [0.02, -0.01], abs=1e-9) and env.box[0, 2] > 0.6
    env.reset(options=MIDDLE | {"box": [0.1, 0, 0.3], "pusher": [-0.1, 0], "support_x": 0.0, "support_y": 0.0, "mu_dynamic": 0.15})
    launch(env, (0, 0), 8.0)
    play(env, REST, 30)
    assert env.box[0, :2] == pytest.approx([0.1, 0], abs=1e-9)  # nothing of it stays


@pytest.mark.parametrize("k", [1.5, 2.0, 4.0])
def test_a_frictionless_push_turns_the_box_along_the_normal_of_its_limit_surface(k):
    offset = np.array([0.005, 0.02, -0.045])
    env = PushVectorEnv(3, world=Other(surface=k))
    env.reset(options=MIDDLE | {"box": [0, 0, 0], "pusher": west(offset), "mu_pusher": 0.0, "restitution": 0.0})
    states = play(env, [8, REST], 8)
    turn, way = states[-1, :, 2] - states[3, :, 2], np.linalg.norm(states[-1, :, :2] - states[3, :, :2], axis=1)
    middle = (states[-1, :, 2] + states[3, :, 2]) / 2  # the lever of the force changes as the box turns
    lever = (np.cos(middle) * (states[[3, -1], :, 4] - states[[3, -1], :, 1]).mean(0)
             - np.sin(middle) * (states[[3, -1], :, 3] - states[[3, -1], :, 0]).mean(0))
    expected = -np.sign(offset) * (np.abs(lever) / 0.060)**(k - 1) / 0.060  # of turn by way
    assert turn / way == pytest.approx(expected, rel=0.08, abs=0.01)


@pytest.mark.parametrize("k", [1.5, 4.0])
def test_a_free_slide_and_spin_on_another_limit_surface(k):
    mu, c, p, v, w, x, theta, dt = 0.2, 0.060, k / (k - 1), 0.3, 3.0, 0.0, 0.0, 1e-5
    while (n := (v**p + (c * w)**p)**(1 / p)) > 2 * mu * G * dt:
        x, theta = x + v * dt, theta + w * dt
        v, w = max(v - mu * G * (v / n)**(p - 1) * dt, 0), max(w - mu * G * c / GYRATION * (c * w / n)**(p - 1) * dt, 0)
    env = PushVectorEnv(1, world=Other(surface=k))
    env.reset(options=MIDDLE | {"box": [0, 0, 0], "pusher": [-1, -1], "mu_dynamic": mu})
    launch(env, (0.3, 0), 3.0)
    play(env, REST, 30)
    assert env.box[0, [0, 2]] == pytest.approx([x, theta], rel=0.06)


@pytest.mark.parametrize("seconds", [1, 2])
@pytest.mark.parametrize("restitution", [0.0, 0.1, 0.4, 0.7])
def test_off_centre_push_turns_the_box_as_in_the_quasi_static_solution(seconds, restitution):
    grid = np.meshgrid([-0.04, -0.02, 0.01, 0.02, 0.03, 0.045], [0.0, 0.1, 0.2, 0.3], [0.01, 0.03, 0.05], [0.1, 0.2, 0.3], C)
    offset, mu_pusher, speed, mu_dynamic, c = (axis.ravel() for axis in grid)
    env = start(len(offset), pusher=west(offset), mu_pusher=mu_pusher, mu_dynamic=mu_dynamic, restitution=restitution,
                limit_surface_c=c)
    play(env, REST + np.stack([np.rint(speed * 100).astype(int), np.zeros(len(speed), int)], 1), seconds * 15)
    expected = quasi_static(offset, mu_pusher, speed, c, seconds)
    assert env.box[:, 2] == pytest.approx(expected[:, 2], rel=0.04)
    assert env.box[:, :2] == pytest.approx(expected[:, :2], abs=0.0015)


def test_halving_the_sub_step_moves_a_push_by_less_than_a_third_of_a_millimetre():
    options, action = random_pushes(600, np.random.default_rng(3))
    coarse, fine = (start(600, sub_steps=k * SUB_STEPS, **options) for k in (1, 2))
    play(coarse, action, 15), play(fine, action, 15)
    assert np.linalg.norm(coarse.box[:, :2] - fine.box[:, :2], axis=1).max() < 0.0003
    assert np.abs(coarse.box[:, 2]).max() > 0.2  # they turn


def test_world_moves_alone_as_among_a_thousand():
    rng = np.random.default_rng(4)
    options, action = random_pushes(1001, rng)
    actions = np.clip(action + rng.integers(-2, 3, (30, 1001, 2)), 0, 10)
    crowd = play(start(1001, **options), actions, 30)
    assert np.median(np.linalg.norm(crowd[-1, :, :2], axis=1)) > 0.01
    for i in (0, 317, 1000):
        alone = play(start(**{name: value[i:i + 1] for name, value in options.items()}), actions[:, i:i + 1], 30)
        assert alone[:, 0, :5] == pytest.approx(crowd[:, i, :5], abs=1e-6)
        assert alone[:, 0, 5:] == pytest.approx(crowd[:, i, 5:], abs=1e-4)


@pytest.mark.parametrize("mirror", [(1, -1), (-1, 1), (-1, -1)])
def test_mirrored_world_moves_as_the_mirror_image(mirror):
    rng = np.random.default_rng(5)
    options, action = random_pushes(50, rng)
    actions = np.clip(action + rng.integers(-2, 3, (30, 50, 2)), 0, 10)
    pose = np.array([*mirror, mirror[0] * mirror[1]])
    box = rng.uniform(-0.01, 0.01, (50, 3))
    mirrored = options | {"box": box * pose, "pusher": options["pusher"] * mirror}
    first = play(start(50, **(options | {"box": box})), actions, 30)
    second = play(start(50, **mirrored), REST + (actions - REST) * mirror, 30)
    assert second[..., :5] == pytest.approx(first[..., :5] * [*pose, *mirror], abs=1e-6)
    assert second[..., 5:] == pytest.approx(first[..., 5:] * mirror, abs=1e-4)


@pytest.mark.parametrize("restitution", [0.0, 0.3, 0.7])
def test_force_is_the_impulse_of_the_whole_control_step(restitution):
    """Without a table's friction one blow gives the box m (1 + e) u, wherever in the control step it falls."""
    gap = np.linspace(0.0002, 0.003, 15)
    env = start(15, pusher=west(np.zeros(15), gap), mu_static=0, mu_dynamic=0, restitution=restitution)
    force = play(env, [10, REST], 3)[..., 5]
    velocity = np.array([body.velocity.x for body in env.worlds.parts[0].bodies])
    assert velocity == pytest.approx(0.05 * (1 + restitution), rel=1e-6)
    assert force.sum(0) / task.RATE == pytest.approx(-3.25 * velocity, rel=1e-6)


def test_force_of_a_faster_push_is_inertia_and_friction():
    env = start(3, pusher=west(np.zeros(3)), mu_dynamic=[0.1, 0.2, 0.3])
    play(env, [6, REST], 10)
    force = play(env, [10, REST], 1)[0, :, 5]
    assert force == pytest.approx(-3.25 * (0.04 * task.RATE + np.array([0.1, 0.2, 0.3]) * G), rel=0.05)


def test_force_is_zero_without_contact():
    assert (play(start(), [0, 10], 5)[..., 5:] == 0).all()


def test_no_history_in_a_world_that_starts_anew():
    rng = np.random.default_rng(6)
    options, action = random_pushes(40, rng)
    options["pusher"][::2] += 1e-4 * (options["pusher"][::2] < np.array([-0.06, -0.05]))  # every second one touches at once
    used = start(40, **(options | {"box": rng.uniform(-0.002, 0.002, (40, 3))}))
    play(used, action, 12)
    assert (used.force != 0).any(1).mean() > 0.8
    used.reset(seed=0, options={"box": [0, 0, 0]} | options)
    fresh = start(40, **options)
    assert play(used, action, 15) == pytest.approx(play(fresh, action, 15), abs=1e-9)


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
    env = PushVectorEnv(4000, starts=starts)
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
        env = PushVectorEnv(2000, starts=starts)
        env.reset(seed=8)
        outside = (np.abs([draw.corners(box) for box in env.box]) > task.HALF).any((1, 2))
        assert outside.any() == (starts == "centre")


OTHER = World(box=(0.14, 0.08, 0.05), mass=(1.0, 2.0), mu_static=(0.2, 0.5), mu_dynamic=(0.3, 0.6), support=(0.5, 0.5))


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


def test_a_box_of_another_size_stops_and_is_pushed_as_its_size_says():
    env = PushVectorEnv(1, world=OTHER)
    options = MIDDLE | {"box": [0, 0, 0], "mu_dynamic": 0.15, "limit_surface_c": 0.06}
    env.reset(seed=0, options=options | {"pusher": [-0.2, -0.1]})
    launch(env, (0, 0), 5.0)
    play(env, REST, 30)
    assert env.box[0, 2] == pytest.approx(25 / (2 * 0.15 * G * 0.06 / ((0.14**2 + 0.08**2) / 12)), rel=0.03)
    env.reset(options=options | {"pusher": [-0.1, 0]})
    states = play(env, [10, REST], 15)
    touched = (states[:, 0, 5] != 0).argmax()
    gap = states[touched:, 0, 0] - states[touched:, 0, 3]
    assert gap == pytest.approx(np.full(len(gap), 0.07 + task.RADIUS), abs=2e-4)


def test_observations_clip_at_the_worlds_force():
    env = PushVectorEnv(1, world=World(max_force=2.0))
    env.reset(options=MIDDLE | {"box": [0.1, 0, 0], "pusher": [0.0269, 0]})
    obs = [env.step([[8, REST]])[0] for _ in range(10)]
    assert obs[-1][0, 6] == -1.0 and env.force[0, 0] < -2


@pytest.mark.parametrize("changes, words", [
    ({"box": (0.25, 0.2, 0.07)}, "0.32 m, the workspace leaves no room to start"), ({"box": (0.1, 0.0, 0.07)}, "no room"),
    ({"mass": (2.0, 1.0)}, "--mass 2.0 1.0"), ({"mass": (0.0, 1.0)}, "--mass"), ({"support": (0.5, 0.2)}, "--support"),
    ({"mu_dynamic": (-0.1, 0.2)}, "--mu-dynamic"), ({"support_offset": (0.1, 0.0)}, "--support-offset")])
def test_no_such_world(changes, words):
    with pytest.raises(ValueError, match=words):
        World(**changes)


def test_near_starts_are_an_aid():
    env = PushVectorEnv(400)
    env.near_share = 0.5
    env.reset(seed=9)
    near = np.array([geometry.nearest(box, pusher)[0] for box, pusher in zip(env.box, env.pusher)]) <= 0.03
    assert 0.5 < near.mean() < 0.75  # some are near by chance
    assert np.linalg.norm(env.box[near, :2], axis=1).mean() < 0.8 * np.linalg.norm(env.box[~near, :2], axis=1).mean()


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


def test_time_limit_truncates():
    env = start(2, box=[0.1, 0, 0], pusher=[-0.2, 0])
    for t in range(300):
        _, _, terminated, truncated, _ = env.step(np.full((2, 2), REST))
        assert not terminated.any() and (truncated == (t == 299)).all()
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


def test_threads_change_no_bit():
    """Pushes, ends and starts included, with another number of worlds in each Space."""
    def play(threads):
        env, rng = PushVectorEnv(50, threads=threads), np.random.default_rng(0)
        env.near_share = 1.0
        env.reset(seed=3)
        states = []
        for _ in range(task.HORIZON + 5):
            toward = np.where(env.box[:, :2] > env.pusher, 3, -3)
            states.append(env.step(np.clip(5 + toward + rng.integers(-2, 3, (50, 2)), 0, 10))[4]["state"])
        return np.stack(states)

    alone = play(1)
    assert (alone[..., 5:] != 0).any(-1).mean() > 0.5  # contact
    for threads in (2, 3):
        assert np.array_equal(play(threads), alone)


@pytest.mark.parametrize("threads", [0, 5])
def test_threads_without_a_world_are_refused(threads):
    with pytest.raises(ValueError, match="threads for 4 worlds"):
        PushVectorEnv(4, threads=threads)
