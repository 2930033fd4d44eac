"""Planar pushing as gymnasium sees it: many worlds (PushVectorEnv), and one world for everybody else (PushEnv).

Importing this module registers both as "Push-v0"; gymnasium.make("common.env:Push-v0") imports it by itself.
"""
import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from common import geometry, task
from common.simulator import SUB_STEPS, Worlds

_DRAWS = {"mass": task.MASS, "mu_static": task.MU_STATIC, "mu_dynamic": task.MU_DYNAMIC, "mu_pusher": task.MU_DYNAMIC,
          "restitution": task.RESTITUTION}


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
        worlds: simulator.Worlds, the physics; its box, pusher, force, dynamics (here the drawn ones) and state are here too.
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
        self.worlds = Worlds(num_envs, sub_steps)
        self._steps = np.zeros(num_envs, int)

    @property
    def box(self):
        return self.worlds.box

    @property
    def pusher(self):
        return self.worlds.pusher

    @property
    def force(self):
        return self.worlds.force

    @property
    def dynamics(self):
        return self.worlds.dynamics

    @property
    def state(self):
        return self.worlds.state

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
        self.worlds.place(worlds, box, pusher, drawn | given)
        self._steps[worlds] = 0

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
        self.worlds.step(velocity)
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
        self.vector = PushVectorEnv(1, whole_workspace=whole_workspace)
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def _info(self, success):
        state = self.vector.state[0]
        return {"state": state, "success": bool(success), "distance": geometry.nearest(state[:3], state[3:5])[0]}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        obs, _ = self.vector.reset(seed=seed, options=options)
        return obs[0], self._info(False)

    def step(self, action):
        reward, terminated, truncated, success = self.vector.advance(np.asarray(action)[None])
        obs = task.scale(self.vector.state)[0]
        return obs, float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._info(success[0])

    def render(self):
        return draw(self.vector.state[0])


VIEW = 1.1 * task.WORKSPACE[0]  # m, the width of draw's picture
SQUARE = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])


def corners(pose):
    """Corners (4, 2) of the box at a pose (3,), m."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return SQUARE * task.BOX[:2] / 2 @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]


def draw(state, width=800):
    """Top view (width / 2, width, 3) uint8 of a state (7,): target light blue, box dark blue, pusher red (fig. sim)."""
    import cv2  # only pictures need it
    image = np.full((width // 2, width, 3), 255, np.uint8)

    def pixels(points):  # m to 1/16 pixel
        points = np.atleast_2d(points) * [1, -1] * width / VIEW + [width / 2, width / 4]
        return np.round(points * 16).astype(np.int32)

    cv2.polylines(image, [pixels(SQUARE * task.HALF)], True, (150, 150, 150), 2, cv2.LINE_AA, 4)
    cv2.fillPoly(image, [pixels(corners(np.zeros(3)))], (170, 205, 240), cv2.LINE_AA, 4)
    cv2.fillPoly(image, [pixels(corners(state[:3]))], (30, 60, 130), cv2.LINE_AA, 4)
    front = state[:2] + np.array([np.cos(state[2]), np.sin(state[2])]) * task.BOX[0] / 2
    cv2.line(image, pixels(state[:2])[0].tolist(), pixels(front)[0].tolist(), (255, 255, 255), 2, cv2.LINE_AA, 4)
    radius = int(task.RADIUS * width / VIEW * 16)
    cv2.circle(image, pixels(state[3:5])[0].tolist(), radius, (210, 40, 40), -1, cv2.LINE_AA, 4)
    return image


gym.register("Push-v0", entry_point="common.env:PushEnv", vector_entry_point="common.env:PushVectorEnv")
