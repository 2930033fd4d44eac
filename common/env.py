"""Planar pushing: many worlds in one pymunk Space (PushVectorEnv), and one world for everybody else (PushEnv)."""
from collections import deque

import gymnasium as gym
import numpy as np
import pymunk
from gymnasium.vector import AutoresetMode
from pymunk import batch
from pymunk._chipmunk_cffi import lib  # a joint's max_force, without the property's overhead

from common import geometry, task

SUB_STEPS = 6  # a control step; tests/test_env.py holds the physics that this number must meet
ITERATIONS = 10
SPACING = 2.0  # m between worlds, so that they never meet
REST = 1e-3  # m/s: a slower box feels static friction
_MOTION = batch.BodyFields.POSITION | batch.BodyFields.ANGLE | batch.BodyFields.VELOCITY | batch.BodyFields.ANGULAR_VELOCITY
_CONTACT = batch.ArbiterFields.BODY_A_ID | batch.ArbiterFields.BODY_B_ID | batch.ArbiterFields.TOTAL_IMPULSE
_DRAWS = {"mass": task.MASS, "mu_static": task.MU_STATIC, "mu_dynamic": task.MU_DYNAMIC, "mu_pusher": task.MU_DYNAMIC,
          "restitution": task.RESTITUTION}


class PushVectorEnv(gym.vector.VectorEnv):
    """`num_envs` worlds in which a spherical pusher moves a box to the target at the workspace's centre.

    Action: MultiDiscrete([11, 11]) a world; bin k is a pusher velocity of (k - 5) * 0.01 m/s along x or y, held for 1/15 s.
    Observation: (N, 8) float32, the true state scaled as in appendix B (task.scale).
    Reward: sec. 4 (task.reward). Termination: success (looked at first) or the centre of box or pusher outside
    the workspace. Truncation: after 300 steps.
    Infos: `state` (N, 7) true states in SI units and `success` (N,) of this step; where an episode ended, `_final_obs` (N,)
    is set, `final_obs` (N, 8) and `final_state` (N, 7) hold its end, and observation and `state` are the next episode's first.

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
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (8,), np.float32)
        self.single_action_space = gym.spaces.MultiDiscrete([task.BINS, task.BINS])
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        self.tolerance, self.near_share = 1.0, 0.0
        self._start_box = task.HALF if whole_workspace else task.START_BOX
        self._sub_steps, self._dt = sub_steps, 1 / task.RATE / sub_steps
        self.box, self.pusher, self.force = np.zeros((num_envs, 3)), np.zeros((num_envs, 2)), np.zeros((num_envs, 2))
        self.dynamics = {name: np.zeros(num_envs) for name in _DRAWS}
        self._steps = np.zeros(num_envs, int)
        self._build()

    def _build(self):
        """One Space: all boxes, then all pushers, then the static body, which is the order of pymunk.batch's arrays."""
        n = self.num_envs
        side = int(np.ceil(np.sqrt(n)))
        index = np.arange(n)
        self._origin = SPACING * np.stack([index % side, index // side], 1).astype(float)
        self.space = pymunk.Space()
        self.space.iterations = ITERATIONS
        self.space.collision_slop = 1e-4
        self.space.collision_bias = 1e-6
        self._boxes = [pymunk.Body(1.0, 1.0) for _ in range(n)]
        pushers = [pymunk.Body(body_type=pymunk.Body.KINEMATIC) for _ in range(n)]
        self._shapes = [pymunk.Poly.create_box(b, tuple(task.BOX[:2])) for b in self._boxes]
        balls = [pymunk.Circle(p, task.RADIUS) for p in pushers]
        for ball in balls:
            ball.friction = ball.elasticity = 1.0  # Chipmunk multiplies the pair's values: the box carries the drawn ones
        static = self.space.static_body
        pivots = [pymunk.PivotJoint(static, b, tuple(o), (0.0, 0.0)) for b, o in zip(self._boxes, self._origin)]
        gears = [pymunk.GearJoint(static, b, 0.0, 1.0) for b in self._boxes]
        for joint in pivots + gears:
            joint.max_bias = 0.0  # the joints resist motion, they do not pull back
        for i in range(n):  # so far apart that no broad phase sees neighbours
            self._boxes[i].position = pushers[i].position = tuple(self._origin[i])
        self.space.add(*self._boxes, *self._shapes)
        self.space.add(*pushers, *balls)
        self.space.add(*pivots, *gears)
        self._joints = np.array([j._constraint for j in pivots + gears], object).reshape(2, n)
        self._bodies, self._contacts = batch.Buffer(), batch.Buffer()
        batch.get_space_bodies(self.space, batch.BodyFields.BODY_ID, self._bodies)
        ids = np.frombuffer(self._bodies.int_buf(), np.uintp)[:2 * n].astype(np.int64)
        self._bodies.clear()
        self._id_order = np.argsort(ids)
        self._sorted_ids = ids[self._id_order]
        self._motion = np.zeros((2 * n + 1, 6))  # x, y, theta, v_x, v_y, omega of boxes, pushers, static body
        self._writer = batch.Buffer()

    def _read(self):
        self._bodies.clear()
        batch.get_space_bodies(self.space, _MOTION, self._bodies)
        return np.frombuffer(self._bodies.float_buf()).reshape(-1, 6)

    def _write(self):
        self._writer.set_float_buf(self._motion)
        batch.set_space_bodies(self.space, _MOTION, self._writer)

    def _set_friction(self, motion, moving):
        """Ellipsoidal limit surface: f = mu m g v / n and tau = mu m g c (c omega) / n, n = sqrt(v^2 + (c omega)^2).

        At rest both joints hold with their full static value. Only boxes that move, or have just stopped, are touched.
        """
        speed = np.hypot(motion[:, 3], motion[:, 4])
        turn = np.abs(motion[:, 5]) * task.LIMIT_SURFACE_C
        n = np.sqrt(speed**2 + turn**2)
        now = n > REST
        touched = np.flatnonzero(now | moving)
        if touched.size:
            now_t, n_t = now[touched], np.maximum(n[touched], REST)
            load = np.where(now_t, self._load_dynamic[touched] / n_t, self._load_static[touched])
            limits = np.stack([load * np.where(now_t, speed[touched], 1.0),
                               load * np.where(now_t, turn[touched], 1.0) * task.LIMIT_SURFACE_C])
            deque(map(lib.cpConstraintSetMaxForce, self._joints[:, touched].ravel(), limits.ravel().tolist()), maxlen=0)
        return now

    def _add_impulses(self, impulse):
        """Adds the last sub-step's contact impulses on the pushers to (N, 2)."""
        self._contacts.clear()
        batch.get_space_arbiters(self.space, _CONTACT, self._contacts)
        ids = np.frombuffer(self._contacts.int_buf(), np.uintp).reshape(-1, 2).astype(np.int64)
        if len(ids):
            j = np.frombuffer(self._contacts.float_buf()).reshape(-1, 2)
            a, b = self._id_order[np.searchsorted(self._sorted_ids, ids)].T
            pusher_is_b = b >= self.num_envs
            impulse[np.where(pusher_is_b, b, a) - self.num_envs] += np.where(pusher_is_b, 1.0, -1.0)[:, None] * j

    def _simulate(self, velocity):
        """Moves the pushers with `velocity` (N, 2) in m/s for one control step."""
        n = self.num_envs
        self._motion[:n] = self._read()[:n]
        self._motion[n:2 * n, 3:5] = velocity
        self._motion[n:2 * n, 0:2] = self.pusher + self._origin
        self._write()
        impulse = np.zeros((n, 2))
        motion = self._motion[:n]
        for _ in range(self._sub_steps):
            self._moving = self._set_friction(motion, self._moving)
            self.space.step(self._dt)
            self._add_impulses(impulse)
            motion = self._read()[:n]
        self.box = motion[:, :3].copy()
        self.box[:, :2] -= self._origin
        self.pusher = self.pusher + velocity / task.RATE
        self.force = impulse * task.RATE

    def place(self, worlds, box, pusher, dynamics):
        """Sets `worlds` (k,) to rest at poses (k, 3) and (k, 2) with given dynamics ({name: (k,)}); force and clock to zero."""
        for name, value in dynamics.items():
            self.dynamics[name][worlds] = value
        d = {name: value[worlds] for name, value in self.dynamics.items()}
        for i, mass, mu, e in zip(worlds, d["mass"].tolist(), d["mu_pusher"].tolist(), d["restitution"].tolist()):
            self._boxes[i].mass = mass
            self._boxes[i].moment = mass * float(task.BOX[:2] @ task.BOX[:2]) / 12
            self._shapes[i].friction, self._shapes[i].elasticity = mu, e
        self._load_static[worlds] = d["mu_static"] * d["mass"] * task.GRAVITY
        self._load_dynamic[worlds] = d["mu_dynamic"] * d["mass"] * task.GRAVITY
        self._moving[worlds] = True  # so that the next sub-step sets the new limits
        self.box[worlds], self.pusher[worlds], self.force[worlds], self._steps[worlds] = box, pusher, 0.0, 0
        n = self.num_envs
        self._motion[:] = self._read()
        self._motion[worlds] = 0.0
        self._motion[worlds, :2] = box[:, :2] + self._origin[worlds]
        self._motion[worlds, 2] = box[:, 2]
        self._motion[n + worlds] = 0.0
        self._motion[n + worlds, :2] = pusher + self._origin[worlds]
        self._write()

    def _draw_start(self, count):
        """Starts of the study; the aided ones put the box nearer to the target and the pusher within 3 cm of it."""
        rng = self.np_random
        box = rng.uniform(-1, 1, (count, 3)) * [*self._start_box, np.pi]
        near = rng.random(count) < self.near_share
        box[near] *= rng.random((near.sum(), 1))
        pusher = np.empty((count, 2))
        for i in range(count):
            while True:
                pusher[i] = rng.uniform(-1, 1, 2) * task.HALF
                if task.START_GAP <= geometry.nearest(box[i], pusher[i])[0] <= (0.03 if near[i] else np.inf):
                    break
        return box, pusher

    def _start(self, worlds, given=None):
        box, pusher = self._draw_start(len(worlds))
        dynamics = {name: self.np_random.uniform(*limits, len(worlds)) for name, limits in _DRAWS.items()}
        given = {name: np.asarray(value, float) for name, value in (given or {}).items()}
        if unknown := given.keys() - dynamics.keys() - {"box", "pusher"}:
            raise ValueError(f"unknown reset options {sorted(unknown)}; known: box, pusher, {', '.join(_DRAWS)}")
        box = np.broadcast_to(given.pop("box", box), box.shape)
        pusher = np.broadcast_to(given.pop("pusher", pusher), pusher.shape)
        self.place(worlds, box, pusher, dynamics | {k: np.broadcast_to(v, len(worlds)) for k, v in given.items()})

    @property
    def state(self):
        """True states (N, 7): box, pusher, force in SI units."""
        return np.concatenate([self.box, self.pusher, self.force], 1)

    def reset(self, *, seed=None, options=None):
        """Starts every world anew; `options` gives any of box (N, 3), pusher (N, 2) and the dynamics (N,), or one for all.

        Raises:
            ValueError: an unknown option, or one of a wrong shape.
        """
        super().reset(seed=seed)
        self._load_static, self._load_dynamic = np.zeros(self.num_envs), np.zeros(self.num_envs)
        self._moving = np.zeros(self.num_envs, bool)
        self._start(np.arange(self.num_envs), options)
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
        return task.reward(self.box, velocity, success, out), terminated, ~terminated & (self._steps >= task.HORIZON), success

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
    import cv2
    image = np.full((width // 2, width, 3), 255, np.uint8)

    def pixels(points):  # m to 1/16 pixel
        points = np.atleast_2d(points) * [1, -1] * width / (task.WORKSPACE[0] * 1.1) + [width / 2, width / 4]
        return np.round(points * 16).astype(np.int32)

    def corners(pose):
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        local = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * task.BOX[:2] / 2
        return local @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]

    cv2.polylines(image, [pixels(np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * task.HALF)], True, (150, 150, 150), 2, cv2.LINE_AA, 4)
    cv2.fillPoly(image, [pixels(corners(np.zeros(3)))], (170, 205, 240), cv2.LINE_AA, 4)
    cv2.fillPoly(image, [pixels(corners(state[:3]))], (30, 60, 130), cv2.LINE_AA, 4)
    front = state[:2] + np.array([np.cos(state[2]), np.sin(state[2])]) * task.BOX[0] / 2
    cv2.line(image, pixels(state[:2])[0].tolist(), pixels(front)[0].tolist(), (255, 255, 255), 2, cv2.LINE_AA, 4)
    radius = int(task.RADIUS * width / (task.WORKSPACE[0] * 1.1) * 16)
    cv2.circle(image, pixels(state[3:5])[0].tolist(), radius, (210, 40, 40), -1, cv2.LINE_AA, 4)
    return image


gym.register("Push-v0", entry_point=PushEnv, vector_entry_point=PushVectorEnv)
