"""The simulator against closed forms, the integrated quasi-static solution and itself."""
import numpy as np
import pytest

from common import geometry, task
from common.env import PushVectorEnv
from common.simulator import SUB_STEPS
from common.task import Other, World

C = [0.042, 0.060, 0.078]  # m: even pressure, between, four corners
G = task.GRAVITY
HALF_BOX = np.array(World.box[:2]) / 2
GYRATION = (0.12**2 + 0.10**2) / 12  # m^2, moment of inertia / mass
REST = 5  # the bin of zero velocity
MIDDLE = {"mass": 3.25, "mu_static": 0.4, "mu_dynamic": 0.2, "mu_pusher": 0.2, "restitution": 0.4, "limit_surface_c": 0.060,
          "support_x": 0.0, "support_y": 0.0}
RANGES = {"mass": (3.0, 3.5), "mu_static": (0.3, 0.5), "mu_dynamic": (0.1, 0.3), "mu_pusher": (0.1, 0.3),
          "restitution": (0.1, 0.7), "limit_surface_c": (0.04219, 0.07811)}
OTHER = World(box=(0.14, 0.08, 0.05), mass=(1.0, 2.0), mu_static=(0.2, 0.5), mu_dynamic=(0.3, 0.6), support=(0.5, 0.5))


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
    env.reset(options=MIDDLE | {"box": [0.1, 0, 0.3], "pusher": [-0.1, 0], "mu_dynamic": 0.15})
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
    used.reset(seed=0, options={"box": [0, 0, 0]} | MIDDLE | options)
    fresh = start(40, **options)
    assert play(used, action, 15) == pytest.approx(play(fresh, action, 15), abs=1e-9)


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


def test_threads_change_no_bit():
    """Pushes, ends and starts included, with another number of worlds in each Space."""
    def play(threads):
        env, rng = PushVectorEnv(50, threads=threads), np.random.default_rng(0)
        env.near_share = 1.0
        env.reset(seed=3)
        states = []
        for _ in range(World().horizon + 5):
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
