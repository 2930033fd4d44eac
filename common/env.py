"""Planar pushing: many worlds in one pymunk Space (PushVectorEnv), and one world for everybody else (PushEnv).

Importing this module registers both as "Push-v0"; gymnasium.make("common.env:Push-v0") imports it by itself.
"""
from collections import deque

import gymnasium as gym
import numpy as np
import pymunk
from gymnasium.vector import AutoresetMode
from pymunk import batch
from pymunk._chipmunk_cffi import lib  # Chipmunk's setters, without the overhead of pymunk's properties

from common import geometry, task

SUB_STEPS = 6  # a control step; tests/test_env.py holds the physics that this number must meet
ITERATIONS = 5
SPACING = 10.0  # m between worlds, so that they never meet
REST = 1e-4  # m/s: a slower box is at rest
GYRATION = float(task.BOX[:2] @ task.BOX[:2]) / 12  # m^2, moment of inertia / mass
_SLOWING = np.array([1.0, task.LIMIT_SURFACE_C**2 / GYRATION])  # the share that friction takes of v and of omega
_MOTION = batch.BodyFields.POSITION | batch.BodyFields.ANGLE | batch.BodyFields.VELOCITY | batch.BodyFields.ANGULAR_VELOCITY
_KICK = batch.BodyFields.VELOCITY | batch.BodyFields.ANGULAR_VELOCITY | batch.BodyFields.FORCE | batch.BodyFields.TORQUE
_CONTACT = batch.ArbiterFields.TOTAL_IMPULSE | batch.ArbiterFields.POINT_A_1
_DRAWS = {"mass": task.MASS, "mu_static": task.MU_STATIC, "mu_dynamic": task.MU_DYNAMIC, "mu_pusher": task.MU_DYNAMIC,
          "restitution": task.RESTITUTION}


def _set_all(setter, handles, values):
    """Calls a setter of Chipmunk's for every pair, at the speed of C."""
    deque(map(setter, handles, values.tolist()), maxlen=0)


class PushVectorEnv(gym.vector.VectorEnv):
    """`num_envs` worlds in which a spherical pusher moves a box to the target at the workspace's centre.

    Action: MultiDiscrete([11, 11]) a world; bin k is a pusher velocity of (k - 5) * 0.01 m/s along x or y, held for 1/15 s.
    Observation: (N, 8) float32, the true state scaled as in appendix B (task.scale).
    Reward: sec. 4 (task.reward). Termination: success (looked at first) or the centre of box or pusher outside
    the workspace. Truncation: after 300 steps.
    Infos: `state` (N, 7) true states in SI units and `success` (N,) of this step. Where an episode ended, `_final_obs` (N,)
    is set, `final_obs` (N, 8) and `final_state` (N, 7) hold its end, and observation and `state` start the next episode.

    Args:
        num_envs: number of worlds.
        whole_workspace: draw the starts over the whole workspace instead of the study's region.
        sub_steps: physics steps a control step.

    Attributes:
        box (N, 3) in m, m, rad; pusher (N, 2) in m; force (N, 2) in N: what the pusher feels, world frame, mean over the
        control step. dynamics: the drawn mass (kg), mu_static, mu_dynamic, mu_pusher, restitution, each (N,).
        tolerance, near_share: aids to training (1 and 0 are none): the factor on the success tolerance, and the share of
        episodes that start with the box at a random fraction of its way from the target and the pusher beside it.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    def __init__(self, num_envs=1, *, whole_workspace=False, sub_steps=SUB_STEPS):
        self.num_envs = num_envs
        self.single_observation_space = gym.spaces.Box(-2.0, 2.0, (8,), np.float32)  # positions leave [-1, 1] at the end
        self.single_action_space = gym.spaces.MultiDiscrete([task.BINS, task.BINS])
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        self.tolerance, self.near_share = 1.0, 0.0
        self._start_box = task.HALF if whole_workspace else task.START_BOX
        self._sub_steps, self._dt = sub_steps, 1 / task.RATE / sub_steps
        self.box, self.pusher, self.force = np.zeros((num_envs, 3)), np.zeros((num_envs, 2)), np.zeros((num_envs, 2))
        self.dynamics = {name: np.zeros(num_envs) for name in _DRAWS}
        self._steps = np.zeros(num_envs, int)
        self._static, self._dynamic = np.zeros(num_envs), np.zeros(num_envs)  # m/s, what friction can take of a speed in dt
        self._inertia = np.ones((num_envs, 2))  # mass in kg, moment in kg m^2
        self._rest, self._touched, self._held = np.zeros((3, num_envs), bool)  # at rest; pushed in the last sub-step, step
        self._build()

    def _build(self):
        """One Space with all boxes, then all pushers, which is the order of pymunk.batch's arrays."""
        n = self.num_envs
        self._side = int(np.ceil(np.sqrt(n)))
        self._origin = SPACING * np.stack(np.divmod(np.arange(n), self._side), 1)
        self.space = pymunk.Space()
        self.space.iterations = ITERATIONS
        self.space.collision_slop = 1e-4
        self.space.collision_bias = 1e-6
        self.space.collision_persistence = 1  # a contact that has ended would still report its last impulse
        self._boxes = [pymunk.Body(1.0, 1.0) for _ in range(n)]
        pushers = [pymunk.Body(body_type=pymunk.Body.KINEMATIC) for _ in range(n)]
        self._shapes = [pymunk.Poly.create_box(b, tuple(task.BOX[:2])) for b in self._boxes]
        balls = [pymunk.Circle(p, task.RADIUS) for p in pushers]
        for ball in balls:
            ball.friction = ball.elasticity = 1.0  # Chipmunk multiplies the pair's values: the box carries the drawn ones
        for box, pusher, origin in zip(self._boxes, pushers, self._origin.tolist()):
            box.position = pusher.position = origin  # so far apart that no broad phase sees neighbours
        self.space.add(*self._boxes, *self._shapes)
        self.space.add(*pushers, *balls)
        self._c_boxes = np.array([b._body for b in self._boxes], object)
        self._c_shapes = np.array([s._shape for s in self._shapes], object)
        self._motion = np.zeros((2 * n, 6))  # x, y, theta, v_x, v_y, omega of boxes, then pushers
        self._kick = np.zeros((2 * n, 6))  # v_x, v_y, omega, f_x, f_y, tau
        self._bodies, self._contacts, self._writer = batch.Buffer(), batch.Buffer(), batch.Buffer()

    def _read(self):
        self._bodies.clear()
        batch.get_space_bodies(self.space, _MOTION, self._bodies)
        return np.frombuffer(self._bodies.float_buf()).reshape(-1, 6)

    def _write(self, values, fields):
        self._writer.set_float_buf(values)
        batch.set_space_bodies(self.space, fields, self._writer)

    def _apply_friction(self, twist, change):
        """Table friction of the coming sub-step on boxes with velocities (N, 3): the ellipsoidal limit surface

            f = -mu m g v / n,  tau = -mu m g c^2 omega / n,  n = sqrt(v^2 + (c omega)^2).

        Chipmunk gets it as velocities, forces and masses. A box that slides freely moves with its mean velocity of the
        sub-step. A pushed one would stick and slip where friction can stop it within dt, so for it the law is linearly
        implicit: mass and moment grow by -dt f / v and -dt tau / omega. Its n is the last one plus `change` (N,), the
        pusher's change of velocity in m/s, which bounds that of n. A box at rest meets the pusher with the growth of
        mu_static at MAX_SPEED, and anything else with its static limit surface.
        """
        n = np.linalg.norm(twist * [1.0, 1.0, task.LIMIT_SURFACE_C], axis=1)
        slides = n > REST
        w = np.flatnonzero(slides & self._rest & ~self._touched)
        f_tau = twist[w] * [1.0, 1.0, GYRATION / task.LIMIT_SURFACE_C]  # that would set these in motion, times dt / m
        slides[w] = np.linalg.norm(f_tau, axis=1) > self._static[w]
        self._kick[:self.num_envs] = 0.0
        w = np.flatnonzero(slides | ~self._rest)
        if w.size:
            pushed = (slides & self._touched)[w, None]
            rate = (self._dynamic[w] / np.maximum(n[w] + pushed[:, 0] * change[w], REST))[:, None] * _SLOWING
            loss = np.minimum(rate, 1.0)
            left = np.where(pushed, 1.0 / (1.0 + rate), 1.0 - loss)
            mean = np.where(pushed, 1.0, 1.0 - loss + loss / np.maximum(rate, 1.0) / 2)
            self._rest[w] = rest = ~slides[w] | (left == 0.0).all(1)
            growth = np.where(rest[:, None], self._static[w, None] / task.MAX_SPEED * _SLOWING, pushed * rate)
            inertia = self._inertia[w] * (1.0 + growth)
            self._kick[w, :3] = twist[w] * mean[:, [0, 0, 1]]
            self._kick[w, 3:] = twist[w] * (inertia * (left - mean) / self._dt)[:, [0, 0, 1]]
            _set_all(lib.cpBodySetMass, self._c_boxes[w], inertia[:, 0])
            _set_all(lib.cpBodySetMoment, self._c_boxes[w], inertia[:, 1])

    def _add_impulses(self, impulse):
        """Adds the last sub-step's contact impulses on the pushers to (N, 2)."""
        self._contacts.clear()
        batch.get_space_arbiters(self.space, _CONTACT, self._contacts)
        j, point = np.split(np.frombuffer(self._contacts.float_buf()).reshape(-1, 4), 2, 1)
        column, row = np.rint(point / SPACING).astype(int).T  # where it happened tells the world
        world = column * self._side + row
        impulse[world] += j  # on the first body of a contact, the pusher: Chipmunk puts circles before polygons
        self._touched[:] = False
        self._touched[world] = j.any(1)

    def _simulate(self, velocity):
        """Moves the pushers with `velocity` (N, 2) in m/s for one control step."""
        n = self.num_envs
        held = self.force.any(1)  # only a new touch bounces: the sub-steps do not resolve the smaller bounces that follow
        new = np.flatnonzero(held != self._held)
        _set_all(lib.cpShapeSetElasticity, self._c_shapes[new], np.where(held, 0.0, self.dynamics["restitution"])[new])
        self._held = held
        motion = self._read()
        change = np.linalg.norm(velocity - motion[n:, 3:5], axis=1)
        self._kick[n:, :2] = velocity
        impulse = np.zeros((n, 2))
        for k in range(self._sub_steps):
            self._apply_friction(motion[:n, 3:], change if k == 0 else np.zeros(n))
            self._write(self._kick, _KICK)
            self.space.step(self._dt)
            self._add_impulses(impulse)
            motion = self._read()
        self.box = motion[:n, :3].copy()
        self.box[:, :2] -= self._origin
        self.pusher = motion[n:, :2] - self._origin
        self.force = impulse * task.RATE

    def place(self, worlds, box, pusher, dynamics):
        """Starts `worlds` (k,) anew at poses (k, 3) and (k, 2), at rest, with given dynamics ({name: (k,)})."""
        for name, value in dynamics.items():
            self.dynamics[name][worlds] = value
        d = {name: value[worlds] for name, value in self.dynamics.items()}
        self._inertia[worlds] = d["mass"][:, None] * [1.0, GYRATION]
        self._static[worlds] = d["mu_static"] * task.GRAVITY * self._dt
        self._dynamic[worlds] = d["mu_dynamic"] * task.GRAVITY * self._dt
        _set_all(lib.cpShapeSetFriction, self._c_shapes[worlds], d["mu_pusher"])
        _set_all(lib.cpShapeSetElasticity, self._c_shapes[worlds], d["restitution"])
        self._rest[worlds] = False  # so that the next sub-step sets the new mass
        self.box[worlds], self.pusher[worlds], self.force[worlds], self._steps[worlds] = box, pusher, 0.0, 0
        for i in worlds:  # Chipmunk keeps a contact's impulses and position correction: nothing of the last episode stays
            lib.cpSpaceRemoveShape(self.space._space, self._c_shapes[i])
            lib.cpSpaceAddShape(self.space._space, self._c_shapes[i])
            lib.cpBodyUpdatePosition(self._c_boxes[i], 0.0)
        self._motion[:] = self._read()
        for rows, pose in (worlds, box), (self.num_envs + worlds, pusher):
            self._motion[rows] = 0.0
            self._motion[rows, :pose.shape[1]] = pose
            self._motion[rows, :2] += self._origin[worlds]
        self._write(self._motion, _MOTION)

    def _draw_start(self, count, box=None, pusher=None):
        """Starts of the study around what is given; the aided ones: box nearer to the target, pusher within 3 cm of it."""
        rng = self.np_random

        def draw_box(k):
            return rng.uniform(-1, 1, (k, 3)) * [*self._start_box, np.pi]

        def draw_pusher(k):
            return rng.uniform(-1, 1, (k, 2)) * task.HALF

        near = rng.random(count) < self.near_share
        boxes = draw_box(count) * np.where(near, rng.random(count), 1.0)[:, None] if box is None else box
        pushers = draw_pusher(count) if pusher is None else pusher
        farthest = np.where(near & (pusher is None), 0.03, np.inf)
        for i in range(count if box is None or pusher is None else 0):
            while not task.START_GAP <= geometry.nearest(boxes[i], pushers[i])[0] <= farthest[i]:
                if pusher is None:
                    pushers[i] = draw_pusher(1)
                else:
                    boxes[i] = draw_box(1)
        return boxes, pushers

    def _start(self, worlds, **given):
        box, pusher = self._draw_start(len(worlds), given.pop("box", None), given.pop("pusher", None))
        drawn = {name: self.np_random.uniform(*limits, len(worlds)) for name, limits in _DRAWS.items()}
        self.place(worlds, box, pusher, drawn | given)

    def _given(self, options):
        """Reset options as arrays (N, ...), checked: Chipmunk would end the process at a negative coefficient."""
        given = {}
        for name, value in (options or {}).items():
            if name not in ("box", "pusher", *_DRAWS):
                raise ValueError(f"unknown reset option {name!r}; known: box, pusher, {', '.join(_DRAWS)}")
            one = {"box": (3,), "pusher": (2,)}.get(name, ())
            value = np.asarray(value, float)
            if value.shape not in (one, (self.num_envs, *one)):
                raise ValueError(f"reset option {name!r} has shape {value.shape}, not {(self.num_envs, *one)} or {one}")
            if not np.isfinite(value).all() or name in _DRAWS and value.min() < 0 or name == "mass" and value.min() == 0:
                raise ValueError(f"reset option {name!r} is {value}: not finite, or out of its physical range")
            given[name] = np.array(np.broadcast_to(value, (self.num_envs, *one)))
        return given

    @property
    def state(self):
        """True states (N, 7): box, pusher, force in SI units."""
        return np.concatenate([self.box, self.pusher, self.force], 1)

    def reset(self, *, seed=None, options=None):
        """Starts every world anew; `options` gives any of box (N, 3), pusher (N, 2) and the dynamics (N,), or one for all.

        Raises:
            ValueError: an unknown option, or one of a wrong shape or value.
        """
        super().reset(seed=seed)
        self._start(np.arange(self.num_envs), **self._given(options))
        state = self.state
        return task.scale(state), {"state": state}

    def advance(self, action):
        """One control step without autoreset: reward, terminated, truncated, success, each (N,)."""
        action = np.asarray(action)
        velocity = task.SPEEDS[action]
        self._simulate(velocity)
        self._steps += 1
        success = task.reached(self.box, self.tolerance)
        out = task.outside(self.box, self.pusher)
        terminated = success | out
        truncated = ~terminated & (self._steps >= task.HORIZON)
        return task.reward(self.box, velocity, success, out), terminated, truncated, success

    def step(self, action):
        reward, terminated, truncated, success = self.advance(action)
        state = self.state
        obs = task.scale(state)
        infos = {"state": state, "success": success}
        ended = np.flatnonzero(terminated | truncated)
        if ended.size:
            infos |= {"final_obs": obs, "final_state": state, "_final_obs": terminated | truncated}
            self._start(ended)
            infos["state"] = self.state
            obs = obs.copy()
            obs[ended] = task.scale(infos["state"][ended])
        return obs, reward, terminated, truncated, infos


class PushEnv(gym.Env):
    """One world of PushVectorEnv (same action, observation, reward and ends) in gymnasium's plain form.

    Info: `state` (7,) in SI units, `success`, and `distance` (m) between pusher and box from Coal. Rendering: "rgb_array",
    a top view of the workspace, 400 x 800 x 3.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": task.RATE}

    def __init__(self, render_mode=None, whole_workspace=False):
        self.render_mode = render_mode
        self.worlds = PushVectorEnv(1, whole_workspace=whole_workspace)
        self.observation_space = self.worlds.single_observation_space
        self.action_space = self.worlds.single_action_space

    def _info(self, success):
        state = self.worlds.state[0]
        return {"state": state, "success": bool(success), "distance": geometry.nearest(state[:3], state[3:5])[0]}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        obs, _ = self.worlds.reset(seed=seed, options=options)
        return obs[0], self._info(False)

    def step(self, action):
        reward, terminated, truncated, success = self.worlds.advance(np.asarray(action)[None])
        obs = task.scale(self.worlds.state)[0]
        return obs, float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._info(success[0])

    def render(self):
        return draw(self.worlds.state[0])


def draw(state, width=800):
    """Top view (width / 2, width, 3) uint8 of a state (7,): target light blue, box dark blue, pusher red (fig. sim)."""
    import cv2  # only pictures need it
    image = np.full((width // 2, width, 3), 255, np.uint8)

    def pixels(points):  # m to 1/16 pixel
        points = np.atleast_2d(points) * [1, -1] * width / (task.WORKSPACE[0] * 1.1) + [width / 2, width / 4]
        return np.round(points * 16).astype(np.int32)

    def corners(pose):
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        local = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * task.BOX[:2] / 2
        return local @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]

    frame = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * task.HALF
    cv2.polylines(image, [pixels(frame)], True, (150, 150, 150), 2, cv2.LINE_AA, 4)
    cv2.fillPoly(image, [pixels(corners(np.zeros(3)))], (170, 205, 240), cv2.LINE_AA, 4)
    cv2.fillPoly(image, [pixels(corners(state[:3]))], (30, 60, 130), cv2.LINE_AA, 4)
    front = state[:2] + np.array([np.cos(state[2]), np.sin(state[2])]) * task.BOX[0] / 2
    cv2.line(image, pixels(state[:2])[0].tolist(), pixels(front)[0].tolist(), (255, 255, 255), 2, cv2.LINE_AA, 4)
    radius = int(task.RADIUS * width / (task.WORKSPACE[0] * 1.1) * 16)
    cv2.circle(image, pixels(state[3:5])[0].tolist(), radius, (210, 40, 40), -1, cv2.LINE_AA, 4)
    return image


gym.register("Push-v0", entry_point="common.env:PushEnv", vector_entry_point="common.env:PushVectorEnv")
