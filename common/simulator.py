"""Physics of planar pushing: many worlds in a pymunk Space, a box and a pusher each, on a table with friction."""
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pymunk
from pymunk import batch
from pymunk._chipmunk_cffi import lib  # Chipmunk's setters, without the overhead of pymunk's properties

from common import task

SUB_STEPS = 6  # a control step; tests/test_simulator.py holds the physics that this number must meet
ITERATIONS = 5
SPACING = 10.0  # m between worlds, so that they never meet
REST = 1e-4  # m/s: a slower box is at rest
LEAST_SHARE = 1e-3  # of v or c omega in n, where a limit surface that is no ellipsoid would make their friction infinite
DYNAMICS = ("mass", "mu_static", "mu_dynamic", "mu_pusher", "restitution", "limit_surface_c", "support_x", "support_y")
_MOTION = batch.BodyFields.POSITION | batch.BodyFields.ANGLE | batch.BodyFields.VELOCITY | batch.BodyFields.ANGULAR_VELOCITY
_KICK = batch.BodyFields.VELOCITY | batch.BodyFields.ANGULAR_VELOCITY | batch.BodyFields.FORCE | batch.BodyFields.TORQUE
_CONTACT = batch.ArbiterFields.TOTAL_IMPULSE | batch.ArbiterFields.POINT_A_1


def _norm(twist, p):
    """(|(x, y)|^p + |z|^p)^(1/p) of (N, 3): (N,)."""
    if p == 2:
        x, y, z = twist.T
        return np.sqrt(x * x + y * y + z * z)  # np.linalg.norm's bits, in a quarter of its time
    return (np.hypot(twist[:, 0], twist[:, 1])**p + np.abs(twist[:, 2])**p)**(1 / p)


def _set_all(setter, handles, values):
    """Calls a setter of Chipmunk's for every pair, at the speed of C."""
    deque(map(setter, handles, values.tolist()), maxlen=0)


class Part:
    """The worlds of `rows`, a slice of all, in a pymunk Space of their own, which pymunk.batch reads and writes.

    What is read and written is (2, N, .), of all worlds' boxes and of their pushers.
    """

    def __init__(self, rows, origin, sides):
        self.rows, self.space = rows, pymunk.Space()
        self.space.iterations = ITERATIONS
        self.space.collision_slop = 1e-4  # m; the default overlap of 0.1 is as wide as the box
        self.space.collision_bias = 1e-6  # share of a deeper overlap that is left after 1 s
        self.space.collision_persistence = 1  # a contact that has ended would still report its last impulse
        self.bodies = [pymunk.Body(1.0, 1.0) for _ in origin]
        pushers = [pymunk.Body(body_type=pymunk.Body.KINEMATIC) for _ in origin]
        self.shapes = [pymunk.Poly.create_box(body, sides) for body in self.bodies]
        balls = [pymunk.Circle(pusher, task.RADIUS) for pusher in pushers]
        for box, pusher, ball, place in zip(self.bodies, pushers, balls, origin.tolist()):
            box.position = pusher.position = place  # so far apart that no broad phase sees neighbours
            ball.friction = ball.elasticity = 1.0  # Chipmunk multiplies the pair's values: the box carries the drawn ones
        self.space.add(*self.bodies, *self.shapes, *pushers, *balls)  # boxes, then pushers: the order of pymunk.batch's arrays
        self._reader, self._contacts, self._writer = batch.Buffer(), batch.Buffer(), batch.Buffer()

    def read(self, motion):
        """Reads x, y, theta, v_x, v_y, omega into (2, N, 6)."""
        self._reader.clear()
        batch.get_space_bodies(self.space, _MOTION, self._reader)
        motion[:, self.rows] = np.frombuffer(self._reader.float_buf()).reshape(2, -1, 6)

    def write(self, values, fields):
        self._writer.set_float_buf(np.ascontiguousarray(values[:, self.rows]))
        batch.set_space_bodies(self.space, fields, self._writer)

    def sub_step(self, kick, dt, motion):
        """Physics for dt s after a kick. Returns the contacts: impulse and place, (contacts, 4)."""
        self.write(kick, _KICK)
        self.space.step(dt)
        self.read(motion)
        self._contacts.clear()
        batch.get_space_arbiters(self.space, _CONTACT, self._contacts)
        return np.frombuffer(self._contacts.float_buf()).reshape(-1, 4)


class Worlds:
    """`num` worlds side by side: pushers that move as told, boxes that yield to contact and table friction.

    A step costs a few array operations, not a Python loop over worlds. A control step takes 1 / rate s, in `sub_steps` of
    physics. With `threads` the worlds are in as many Spaces, stepped side by side (Chipmunk's C calls leave the interpreter's
    lock): the same bits. `size` is the box's in m, `surface` as in _apply_friction. Attributes: box (N, 3) in m, m, rad;
    pusher (N, 2) in m; force (N, 2) in N, what the pusher feels, world frame, mean over the control step; dynamics, each
    (N,): mass (kg), mu_static, mu_dynamic, mu_pusher, restitution, limit_surface_c (m, friction torque over friction force),
    support_x and support_y (m, the centre of mass, which is that of friction, in the box's frame); motion (2, N, 6) of the
    centres of mass and of the pushers: place in the grid, angle, their velocities; parts, the Spaces. Raises ValueError: no
    thread, or more than worlds.
    """

    def __init__(self, num, sub_steps=SUB_STEPS, rate=task.RATE, threads=1, size=task.World.box, surface=2.0):
        if not 1 <= threads <= num:
            raise ValueError(f"{threads} threads for {num} worlds: say 1 to {num}")
        self.num, self.rate, self._surface = num, rate, surface
        self._gyration = float(np.square(size[:2]).sum()) / 12  # k^2 in m^2, moment of inertia / mass
        self.box, self.pusher, self.force = np.zeros((num, 3)), np.zeros((num, 2)), np.zeros((num, 2))
        self.dynamics = {name: np.zeros(num) for name in DYNAMICS}
        self._sub_steps, self._dt = sub_steps, 1 / rate / sub_steps
        self._static, self._dynamic = np.zeros(num), np.zeros(num)  # m/s, what friction can take of a speed in dt
        self._inertia = np.ones((num, 2))  # mass in kg, moment in kg m^2
        self._slowing, self._radii, self._levers = np.ones((num, 2)), np.ones((num, 3)), np.ones((num, 3))
        self._support, self._eccentric = np.zeros((num, 2)), False  # the centre of friction, and whether any is off its box's
        self._rest, self._touched, self._held = np.zeros((3, num), bool)  # at rest; pushed in the last sub-step, step
        self._side = int(np.ceil(np.sqrt(num)))  # of one grid for all parts: another place would round differently
        self._origin = SPACING * np.stack(np.divmod(np.arange(num), self._side), 1)
        self._pool = ThreadPoolExecutor(max(1, threads - 1))
        cuts = np.linspace(0, num, threads + 1).astype(int)
        self.parts = [Part(slice(a, b), self._origin[a:b], size[:2]) for a, b in pairwise(cuts)]
        self._c_boxes = np.array([body._body for part in self.parts for body in part.bodies], object)
        self._c_shapes = np.array([shape._shape for part in self.parts for shape in part.shapes], object)
        self._c_spaces = np.repeat(np.array([part.space._space for part in self.parts], object), np.diff(cuts))
        self._corners = np.array(self.parts[0].shapes[0].get_vertices())  # about the box's centre
        self.motion, self._kick = np.zeros((2, 2, num, 6))

    @property
    def state(self):
        """True states (N, 7): box, pusher, force in SI units."""
        return np.concatenate([self.box, self.pusher, self.force], 1)

    def place(self, worlds, box, pusher, dynamics, twists=np.zeros((2, 1, 3)), force=np.zeros((1, 2))):
        """Starts `worlds` (k,) anew at poses (k, 3) and (k, 2), with given dynamics ({name: (k,)}): at rest and apart, or with
        the velocities (2, k, 3) and the force (k, 2) of the last step, so that a copy of a world goes on as that would.
        """
        for name, value in dynamics.items():
            self.dynamics[name][worlds] = value
        mass, mu_static, mu_dynamic, mu_pusher, restitution, c, *support = (self.dynamics[name][worlds] for name in DYNAMICS)
        self._shift(worlds, np.stack(support, 1))
        self._inertia[worlds] = mass[:, None] * [1.0, self._gyration]
        self._static[worlds] = mu_static * task.GRAVITY * self._dt
        self._dynamic[worlds] = mu_dynamic * task.GRAVITY * self._dt
        self._slowing[worlds, 1] = c**2 / self._gyration  # (1, (c / k)^2)
        self._radii[worlds, 2], self._levers[worlds, 2] = c, self._gyration / c
        _set_all(lib.cpShapeSetFriction, self._c_shapes[worlds], mu_pusher)
        _set_all(lib.cpShapeSetElasticity, self._c_shapes[worlds], restitution)
        self._rest[worlds] = False  # so that the next sub-step sets the new mass
        self.box[worlds], self.pusher[worlds], self.force[worlds] = box, pusher, force
        self._held[worlds], self._touched[worlds] = False, force.any(1)
        for i in worlds:  # nothing of the last episode stays: contacts keep their impulses, bodies a position correction
            lib.cpSpaceRemoveShape(self._c_spaces[i], self._c_shapes[i])
            lib.cpSpaceAddShape(self._c_spaces[i], self._c_shapes[i])
            lib.cpBodyUpdatePosition(self._c_boxes[i], 0.0)
        for motion, pose, twist in zip(self.motion, (box, pusher), twists):
            motion[worlds, 2], motion[worlds, 3:] = 0.0, twist
            motion[worlds, :pose.shape[1]] = pose
            motion[worlds, :2] += self._origin[worlds]
        if self._eccentric:
            self.motion[0, worlds, :2] += self._off_centre()[worlds]
        for part in self.parts:
            part.write(self.motion, _MOTION)

    def _shift(self, worlds, support):
        """Puts the centres of mass of `worlds` at (k, 2) of their boxes' frames."""
        for i, corners in zip(worlds, self._corners - support[:, None]) if self._eccentric or support.any() else ():
            lib.cpPolyShapeSetVertsRaw(self._c_shapes[i], len(corners), [tuple(corner) for corner in corners.tolist()])
        self._support[worlds] = support
        self._eccentric = bool(self._support.any())

    def _off_centre(self):
        """Ways (N, 2) from the boxes' centres to their centres of mass, in the world's frame."""
        cos, sin, (x, y) = np.cos(self.motion[0, :, 2]), np.sin(self.motion[0, :, 2]), self._support.T
        return np.stack([cos * x - sin * y, sin * x + cos * y], 1)

    def step(self, velocity):
        """Moves the pushers with `velocity` (N, 2) in m/s for one control step."""
        held = self.force.any(1)  # only a new touch bounces: the sub-steps do not resolve the smaller bounces that follow
        new = np.flatnonzero(held != self._held)
        _set_all(lib.cpShapeSetElasticity, self._c_shapes[new], np.where(held, 0.0, self.dynamics["restitution"])[new])
        self._held = held
        motion, pusher = self.motion
        change = np.linalg.norm(velocity - pusher[:, 3:5], axis=1)
        self._kick[1, :, :2], impulse = velocity, np.zeros((self.num, 2))
        for k in range(self._sub_steps):
            self._apply_friction(motion[:, 3:], change if k == 0 else np.zeros(self.num))
            arguments = self._kick, self._dt, self.motion
            others = [self._pool.submit(part.sub_step, *arguments) for part in self.parts[1:]]
            contacts = [self.parts[0].sub_step(*arguments), *(other.result() for other in others)]
            self._add_impulses(np.concatenate(contacts), impulse)
        self.box = motion[:, :3].copy()
        self.box[:, :2] -= self._origin
        if self._eccentric:
            self.box[:, :2] -= self._off_centre()
        self.pusher = pusher[:, :2] - self._origin
        self.force = impulse * self.rate

    def _apply_friction(self, twist, change):
        """Table friction of the coming sub-step on boxes with velocities (N, 3): the ellipsoidal limit surface

            f = -mu m g v / n,  tau = -mu m g c^2 omega / n,  n = sqrt(v^2 + (c omega)^2).

        With the moment of inertia m k^2 this is d(v, k omega)/dt = -(mu g / n) (v, (c / k)^2 k omega), and with n held for dt
        a speed loses the share rate = dt mu g / n (1, (c / k)^2) of itself: what remains is 1 - rate where the box slides
        freely, at rest from rate = 1 on, and 1 / (1 + rate), linearly implicit, where it is pushed: a pushed box would stick
        and slip where friction can stop it within dt. Chipmunk gets this as velocities, forces and masses: a box that slides
        freely moves with its mean velocity of the sub-step; of a pushed one mass and moment grow by (1 + rate). Its n is the
        last one plus `change` (N,), the pusher's change of velocity in m/s, which bounds that of n. A box at rest meets the
        pusher with the growth of mu_static at MAX_SPEED, and anything else with its static limit surface.

        With another `surface` k than 2 it is |f / (mu m g)|^k + |tau / (mu m g c)|^k = 1, and the motion is along its normal:
        n is the norm of the power p = k / (k - 1), and the rates of v and omega are (|v| / n)^(p - 2) and
        (|c omega| / n)^(p - 2) times those.
        """
        k, p = self._surface, self._surface / (self._surface - 1)
        scaled = twist * self._radii
        n = _norm(scaled, p)
        slides = n > REST
        w = np.flatnonzero(slides & self._rest & ~self._touched)
        f_tau = twist[w] * self._levers[w]  # that would set these in motion, times dt / m
        slides[w] = _norm(f_tau, k) > self._static[w]
        self._kick[0] = 0.0
        w = np.flatnonzero(slides | ~self._rest)
        if w.size:
            pushed, slowing = (slides & self._touched)[w, None], self._slowing[w]
            rate = (self._dynamic[w] / np.maximum(n[w] + pushed[:, 0] * change[w], REST))[:, None] * slowing
            if k != 2:
                parts = np.stack([np.hypot(*scaled[w, :2].T), np.abs(scaled[w, 2])], 1) / np.maximum(n[w, None], REST)
                rate *= np.where(n[w, None] > REST, np.clip(parts, LEAST_SHARE, 1.0), 1.0)**(p - 2)
            loss = np.minimum(rate, 1.0)
            remains = np.where(pushed, 1.0 / (1.0 + rate), 1.0 - loss)
            mean = np.where(pushed, 1.0, 1.0 - loss + loss / np.maximum(rate, 1.0) / 2)
            self._rest[w] = rest = ~slides[w] | (remains == 0.0).all(1)
            growth = np.where(rest[:, None], self._static[w, None] / task.MAX_SPEED * slowing, pushed * rate)
            inertia = self._inertia[w] * (1.0 + growth)
            self._kick[0, w, :3] = twist[w] * mean[:, [0, 0, 1]]
            self._kick[0, w, 3:] = twist[w] * (inertia * (remains - mean) / self._dt)[:, [0, 0, 1]]
            _set_all(lib.cpBodySetMass, self._c_boxes[w], inertia[:, 0])
            _set_all(lib.cpBodySetMoment, self._c_boxes[w], inertia[:, 1])

    def _add_impulses(self, contacts, impulse):
        """Adds the last sub-step's contact impulses on the pushers, from (contacts, 4), to (N, 2)."""
        j = contacts[:, :2]
        column, row = np.rint(contacts[:, 2:] / SPACING).astype(int).T  # where it happened tells the world
        world = column * self._side + row
        impulse[world] += j  # on the first body of a contact, the pusher: Chipmunk puts circles before polygons
        self._touched[:] = False
        self._touched[world] = j.any(1)
