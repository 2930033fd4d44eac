"""What was learned, in another simulator: est_uncertainty and pi_priv in MuJoCo, on a box on its corners and on an even face.

    python tests/second_simulator.py [pretrained|quick|laptop|paper] [--weights DIR] [--episodes n] [--seed k]

MuJoCo is not in requirements.txt: pip install mujoco. Starts and dynamics are drawn as in the nets' world, but that MuJoCo
knows no static friction, restitution or eccentric support; noise, occlusions, estimator and policy are the project's. Prints
first how fast the finger slips in a push in which theory says that it sticks, then success and the errors in the loop, and
last the c at which the project's world, stepped from MuJoCo's states in contact, turns the box as far, and how far off it is.
"""
import copy
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent.parent))
from common import command, episodes, film, geometry, networks, runs, simulator, stacks, statistics, tables, task, trajectories
from common import weights

try:
    import mujoco
except ImportError:
    sys.exit("error: no MuJoCo here: pip install mujoco")

SUPPORTS = {"corners": 2, "even face": 5}  # feet along each side of the bottom
FOOT = 0.001  # m, radius
SUB_STEPS = 67  # of 1 ms
CONTACT = "0.004 1"  # time constant in s, share of critical damping: with MuJoCo's own 0.02 friction creeps
WINDOW = 5  # control steps from each of MuJoCo's states, a third of a second
# The ball gives way upwards: held in height, its friction there would use up what holds it along the face, and it would slip
MODEL = """
<mujoco>
  <option timestep="{dt}" cone="elliptic" impratio="100" noslip_iterations="3"/>
  <default><geom contype="0" conaffinity="0"/><pair condim="3" solref="{contact}"/></default>
  <worldbody>
    <geom name="table" type="plane" size="1 1 1"/>
    <body name="box"><freejoint/><geom name="box" type="box" size="{x} {y} {z}" mass="1"/>{feet}</body>
    <body name="pusher" pos="0 0 {height}">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="1000" diaginertia="1 1 1"/>
      <body gravcomp="1"><joint type="slide" axis="0 0 1"/><geom name="ball" type="sphere" size="{radius}" mass="0.01"/></body>
    </body>
  </worldbody>
  <contact><pair geom1="box" geom2="ball"/>{pairs}</contact>
</mujoco>"""


@dataclass
class Config(command.Reader):
    episodes: int = 100  # for each policy on each support
    passes: int = 10  # M, stochastic passes of the estimator in the loop


PRESETS = {"pretrained": dict(weights=Path(__file__).parent.parent / "pretrained"), "quick": {}, "laptop": {}, "paper": {}}


def model(world, feet):
    """MuJoCo's model of a box on feet x feet points, evenly spaced from corner to corner, and a pusher."""
    half = np.array(world.box) / 2
    points = [(x, y) for x in np.linspace(-half[0], half[0], feet) for y in np.linspace(-half[1], half[1], feet)]
    name = "foot{}".format
    return mujoco.MjModel.from_xml_string(MODEL.format(
        dt=1 / task.RATE / SUB_STEPS, contact=CONTACT, x=half[0], y=half[1], z=half[2],
        height=world.pusher_height, radius=task.RADIUS,
        feet="".join(f'<geom name="{name(i)}" type="sphere" size="{FOOT}" mass="0" pos="{x} {y} {FOOT - half[2]}"/>'
                     for i, (x, y) in enumerate(points)),
        pairs="".join(f'<pair geom1="table" geom2="{name(i)}"/>' for i in range(len(points)))))


class Second:
    """simulator.Worlds in MuJoCo, a model a world, for one episode: a world that is placed again stands still."""

    def __init__(self, num, world, feet):
        self.num, self.world, self.base = num, world, model(world, feet)
        self.ball = self.base.geom("ball").id
        self.models, self.data = [copy.copy(self.base) for _ in range(num)], [None] * num
        self.box, self.pusher, self.force = np.zeros((num, 3)), np.zeros((num, 2)), np.zeros((num, 2))
        self.dynamics = {name: np.zeros(num) for name in simulator.DYNAMICS}
        self.over, self.pool = np.zeros(num, bool), ThreadPoolExecutor(2)

    state = simulator.Worlds.state

    def place(self, worlds, box, pusher, dynamics):
        self.over[worlds] = [self.data[i] is not None for i in worlds]
        for k, i in enumerate(worlds):
            if self.over[i]:
                continue
            for name, value in dynamics.items():
                self.dynamics[name][i] = value[k]
            one, of = self.models[i], {name: self.dynamics[name][i] for name in self.dynamics}
            one.body_mass[1], one.body_inertia[1] = of["mass"], of["mass"] * self.base.body_inertia[1]
            pushes = (one.pair_geom1 == self.ball) | (one.pair_geom2 == self.ball)
            one.pair_friction[:, :2] = np.where(pushes, of["mu_pusher"], of["mu_dynamic"])[:, None]
            data = self.data[i] = mujoco.MjData(one)
            data.qpos[:9] = [*box[k, :2], self.world.box[2] / 2, np.cos(box[k, 2] / 2), 0, 0, np.sin(box[k, 2] / 2), *pusher[k]]
        self.box[worlds], self.pusher[worlds], self.force[worlds] = box, pusher, 0.0

    def step(self, velocity):
        running = np.flatnonzero(~self.over)
        list(self.pool.map(self.step_one, running, velocity[running]))

    def step_one(self, i, velocity):
        one, data, force, wrench = self.models[i], self.data[i], np.zeros(3), np.zeros(6)
        for _ in range(SUB_STEPS):
            data.qvel[6:8] = velocity
            mujoco.mj_step(one, data)
            for k in np.flatnonzero((data.contact.geom == self.ball).any(1)):
                mujoco.mj_contactForce(one, data, k, wrench)
                on_ball = 1 if data.contact.geom[k, 1] == self.ball else -1  # a contact's force is that on its second geom
                force += on_ball * wrench[:3] @ data.contact.frame[k].reshape(3, 3)
        w, _, _, z = data.qpos[3:7]
        self.box[i] = *data.qpos[:2], task.wrap(2 * np.arctan2(z, w))
        self.pusher[i], self.force[i] = data.qpos[7:9], force[:2] / SUB_STEPS


def slip(world):
    """Speed in m/s at which the finger slips along the face in an off-centre push that theory says sticks.

    Of the normal force 0.12 goes along the face at most, of the 0.3 that friction allows.
    """
    second = Second(1, world, 2)
    start, dynamics = np.array([[-world.box[0] / 2 - task.RADIUS, 0.02]]), dict(mass=[3.25], mu_dynamic=[0.2], mu_pusher=[0.3])
    second.place([0], np.zeros((1, 3)), start, dynamics)
    along, angle = [], []
    for _ in range(30):
        second.step(np.array([[0.03, 0.0]]))
        along.append((geometry.rotation(second.box[0, 2]).T @ (second.pusher[0] - second.box[0, :2]))[1])
        angle.append(second.box[0, 2])
    rolled = task.RADIUS * (angle[-1] - angle[4])  # the ball does not turn with the face
    return abs(along[-1] - along[4] - rolled) / (len(along) - 5) * task.RATE


def play(method, num, cfg, paths, world, feet):
    """Success (N,), length (N,), film.Recorded and dynamics of one episode a world in MuJoCo."""
    estimator = weights.load(networks.Estimator, paths["estimator"]) if method.estimator else None
    policy = weights.load(networks.Recurrent, paths["policy" if method.estimator else "pi_priv"])
    env = film.Recorded(stacks.make(method, num, estimator, cfg.passes, world=world))
    env.unwrapped.worlds = second = Second(num, world, feet)
    torch.manual_seed(cfg.seed)
    return *episodes.play(env, policy, 2**48 + cfg.seed), env, second.dynamics


def compare(rows, length, dynamics, world):
    """How the project's world, stepped for WINDOW steps from MuJoCo's states in contact, differs from MuJoCo.

    Returns the c at which it turns the box as far, its error in m there, the way that MuJoCo moves the box in m, and the
    number of windows.
    """
    states = np.stack([row["state"] for row in rows]).astype(float)
    t, i = np.array([(t, i) for i, n in enumerate(length) for t in range(1, n - WINDOW, WINDOW)
                     if states[t:t + WINDOW + 1, i, 5:].any(-1).all()]).T
    start, end = states[t, i], states[t + WINDOW, i]
    worlds = simulator.Worlds(len(i), size=world.box)

    def stepped(c):
        given = {name: value[i] for name, value in dynamics.items()}
        given |= {"limit_surface_c": np.full(len(i), c), "mu_static": given["mu_dynamic"]}
        given |= dict.fromkeys(("restitution", "support_x", "support_y"), np.zeros(len(i)))
        worlds.place(np.arange(len(i)), start[:, :3], start[:, 3:5], given)
        for k in range(WINDOW):
            worlds.step(task.RATE * (states[t + k + 1, i, 3:5] - states[t + k, i, 3:5]))
        return worlds.box

    grid = np.linspace(0.03, 0.09, 25)
    turn = task.wrap(end[:, 2] - start[:, 2])
    shares = [task.wrap(stepped(c)[:, 2] - start[:, 2]) @ turn / (turn @ turn) for c in grid]  # falls with c
    c = np.interp(-1.0, np.negative(shares), grid)
    off, way = (np.linalg.norm(pose[:, :2] - end[:, :2], axis=1).mean() for pose in (stepped(c), start))
    return c, off, way, len(i)


def main(cfg):
    paths = {"pi_priv": runs.find(cfg, "01_train_privileged", "policy.safetensors"),
             "estimator": runs.find(cfg, "03_train_estimator", "estimator.safetensors", "ours"),
             "policy": runs.find(cfg, "04_train_policy", "policy.safetensors", "est_uncertainty")}
    world = runs.world_of(cfg, paths.values())
    print(f"the finger slips {1e3 * slip(world):.2f} mm/s in a push in which it should stick\n")
    rows, compared = [], []
    for support, feet in SUPPORTS.items():
        for name in ("est_uncertainty", "priv_on_state"):
            success, length, env, dynamics = play(stacks.METHODS[name], cfg.episodes, cfg, paths, world, feet)
            errors = ["", ""]
            if name == "est_uncertainty":
                told = statistics.in_the_loop(trajectories.in_the_loop(env, length, success))
                errors = [f"{told[key]:.1f}" for key in ("trans_mean_l2_mm", "rot_mean_abs_deg")]
            rows.append([support, name, tables.percent(statistics.wilson(success)), *errors])
        c, off, way, count = compare(env.rows, length, dynamics, world)
        compared.append([support, f"{c:.3f}", f"{1e3 * off:.2f}", f"{1e3 * way:.1f}", f"{count:,}"])
    print(f"{cfg.episodes} episodes each, in MuJoCo {mujoco.__version__}\n")
    print(tables.aligned(["support", "policy", "success [95 %]", "error, mean L2 (mm)", "mean abs. (deg)"], rows))
    print(f"\nThe project's world from MuJoCo's states in contact, {WINDOW} steps on\n")
    print(tables.aligned(["support", "c of the same turn (m)", "then off (mm)", "of a way (mm)", "windows"], compared))


if __name__ == "__main__":
    command.main(Config, PRESETS, main, __doc__)
