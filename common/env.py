"""Planar pushing as gymnasium sees it: many worlds (PushVectorEnv), and one world for everybody else (PushEnv).

Importing this module registers both as "Push-v0"; gymnasium.make("common.env:Push-v0") imports it by itself.
"""
from operator import attrgetter

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from common import geometry, task
from common.simulator import DYNAMICS, SUB_STEPS, Worlds
from common.task import World


class PushVectorEnv(gym.vector.VectorEnv):
    """`num_envs` worlds in which a spherical pusher moves a box to the target at the workspace's centre.

    Action: MultiDiscrete([11, 11]) a world; bin k is a pusher velocity of (k - 5) * 0.01 m/s along x or y, held for 1/15 s.
    Observation: (N, 8) float32, the true state scaled as in appendix B (task.scale).
    Reward: sec. 4 (task.reward). Termination: success (looked at first) or the centre of box or pusher outside
    the workspace. Truncation: at the world's time limit.
    Infos: `state` (N, 7) true states in SI units and `success` (N,) of this step, and whether its episode was `aided` (N,) at
    its start. Where an episode ended, `_final_obs` (N,) is set, `final_obs` (N, 8) and `final_state` (N, 7) hold its end, and
    observation and `state` start the next episode.

    Args: world: task.World, what is drawn for an episode; sub_steps: physics steps a control step; threads: as in
    simulator.Worlds; they change no bit.

    Attributes:
        watched: the worlds whose observations are still read. episodes.play leaves out what is done, a reset makes it all again;
        a wrapper need not work for the others.
        worlds: simulator.Worlds, the physics; its box, pusher, force, dynamics (here the drawn ones) and state are here too.
        tolerance, near_share: a curriculum's (training.py; 1 and 0 are none): the factor on the success tolerance, and the
        share of episodes that are aided: they start with the box at a random fraction of its way from the target and the pusher
        beside it.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    def __init__(self, num_envs=1, *, world=World(), sub_steps=SUB_STEPS, threads=1):
        self.num_envs, self.world = num_envs, world
        self.single_observation_space = gym.spaces.Box(-2.0, 2.0, (8,), np.float32)  # positions leave [-1, 1] at the end
        self.single_action_space = gym.spaces.MultiDiscrete([task.BINS, task.BINS])
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        self.tolerance, self.near_share, self._aided = 1.0, 0.0, np.zeros(num_envs, bool)
        self.worlds = Worlds(num_envs, sub_steps, threads=threads, size=self.world.box, surface=self.world.surface)
        self._steps = np.zeros(num_envs, int)

    box, pusher = property(attrgetter("worlds.box")), property(attrgetter("worlds.pusher"))
    force, dynamics = property(attrgetter("worlds.force")), property(attrgetter("worlds.dynamics"))
    state = property(attrgetter("worlds.state"))

    def scaled(self, state):
        """Observations (..., 8) of states (..., 7)."""
        return task.scale(state, self.world.max_force)

    def _draw_boxes(self, count):
        """Poses (count, 3): the angle uniform, then the centre in the rectangle that the world leaves it."""
        boxes = self.np_random.uniform(-1, 1, (count, 3)) * [1, 1, np.pi]
        boxes[:, :2] *= self.world.centre_range(boxes[:, 2])
        return boxes

    def _draw_start(self, count, box=None, pusher=None):
        """Starts of the world around what is given, and whether they are aided: box nearer to the target, pusher within 3 cm."""
        rng = self.np_random
        near = rng.random(count) < self.near_share
        boxes = self._draw_boxes(count) * np.where(near, rng.random(count), 1.0)[:, None] if box is None else box
        pushers = rng.uniform(-1, 1, (count, 2)) * task.HALF if pusher is None else pusher
        farthest = np.where(near & (pusher is None), 0.03, np.inf)
        for i in range(count if box is None or pusher is None else 0):
            while not task.START_GAP <= geometry.nearest(boxes[i], pushers[i], self.world.box)[0] <= farthest[i]:
                if pusher is None:
                    pushers[i] = rng.uniform(-1, 1, 2) * task.HALF
                else:
                    boxes[i] = self._draw_boxes(1)[0]
        return boxes, pushers, near

    def _start(self, worlds, **given):
        box, pusher, self._aided[worlds] = self._draw_start(len(worlds), given.pop("box", None), given.pop("pusher", None))
        self.worlds.place(worlds, box, pusher, self.world.draw(self.np_random, len(worlds), given))
        self._steps[worlds] = 0

    def _given(self, options):
        """Reset options as arrays (N, ...), checked: Chipmunk would end the process at a negative coefficient."""
        given, shapes = {}, {"box": (3,), "pusher": (2,)} | dict.fromkeys(DYNAMICS, ())
        for name, value in (options or {}).items():
            if name not in shapes:
                raise ValueError(f"unknown reset option {name!r}; known: {', '.join(shapes)}")
            one, value = shapes[name], np.asarray(value, float)
            if value.shape not in (one, (self.num_envs, *one)):
                raise ValueError(f"reset option {name!r} has shape {value.shape}, not {(self.num_envs, *one)} or {one}")
            if not np.isfinite(value).all() or name in self.world.dynamics and value.min() < 0 or (
                    name in ("mass", "limit_surface_c") and value.min() == 0):
                raise ValueError(f"reset option {name!r} is {value}: not finite, or out of its physical range")
            given[name] = np.array(np.broadcast_to(value, (self.num_envs, *one)))
        return given

    def reset(self, *, seed=None, options=None):
        """Starts every world anew; `options` gives any of box (N, 3), pusher (N, 2) and the dynamics (N,), or one for all.

        Raises ValueError: an unknown option, or one of a wrong shape or value.
        """
        super().reset(seed=seed)
        self.watched = np.arange(self.num_envs)
        self._start(self.watched, **self._given(options))
        state = self.state
        return self.scaled(state), {"state": state}

    def advance(self, action):
        """One control step without autoreset: reward, terminated, truncated, success, each (N,)."""
        action = np.asarray(action)
        velocity = task.SPEEDS[action]
        self.worlds.step(velocity)
        self._steps += 1
        success = task.reached(self.box, self.tolerance)
        out = task.outside(self.box, self.pusher)
        terminated = success | out
        truncated = ~terminated & (self._steps >= self.world.horizon)
        return task.reward(self.box, velocity, success, out), terminated, truncated, success

    def step(self, action):
        reward, terminated, truncated, success = self.advance(action)
        state = self.state
        obs = self.scaled(state)
        infos = {"state": state, "success": success, "aided": self._aided.copy()}
        ended = np.flatnonzero(terminated | truncated)
        if ended.size:
            infos |= {"final_obs": obs, "final_state": state, "_final_obs": terminated | truncated}
            self._start(ended)
            infos["state"] = self.state
            obs = obs.copy()
            obs[ended] = self.scaled(infos["state"][ended])
        return obs, reward, terminated, truncated, infos


class PushEnv(gym.Env):
    """One world of PushVectorEnv (same action, observation, reward and ends) in gymnasium's plain form.

    Info: `state` (7,) in SI units, `success`, and `distance` (m) between pusher and box from Coal. Rendering: "rgb_array",
    a top view of the workspace, 400 x 800 x 3.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": task.RATE}

    def __init__(self, render_mode=None, world=World()):
        self.render_mode = render_mode
        self.vector = PushVectorEnv(1, world=world)
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def _info(self, success):
        state, size = self.vector.state[0], self.vector.world.box
        return {"state": state, "success": bool(success), "distance": geometry.nearest(state[:3], state[3:5], size)[0]}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        obs, _ = self.vector.reset(seed=seed, options=options)
        return obs[0], self._info(False)

    def step(self, action):
        reward, terminated, truncated, success = self.vector.advance(np.asarray(action)[None])
        obs = self.vector.scaled(self.vector.state)[0]
        return obs, float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._info(success[0])

    def render(self):
        from common import draw  # only pictures need OpenCV
        return draw.top_view(self.vector.state[0], size=self.vector.world.box)


gym.register("Push-v0", entry_point="common.env:PushEnv", vector_entry_point="common.env:PushVectorEnv")
