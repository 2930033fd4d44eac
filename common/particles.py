"""A particle filter whose particles are worlds of the study's simulator: an estimator that knows the physics, for reference."""
import numpy as np
import torch

from common import task
from common.simulator import Worlds

JITTER = np.array([6e-4, 6e-4, 8e-3])  # of a pose that is drawn again, m, m, rad
SPREAD = 0.03  # of its dynamics, as a share of their ranges
MODEL = 0.15  # error of the simulated force, as a share of it
LOST = 30.0  # squared error of the best particle's sight, in its variances: no particle is near, and all begin anew
LEAST = 10  # particles


class Filter:
    """Pose of the box in one episode, from the pusher's exact motion, the seen poses and the force.

    A particle is a pose, dynamics drawn from `world`, and the sensors' bias, which is integrated in closed form: a Kalman
    filter for each particle (Rao-Blackwellised: Doucet et al. 2000). Takes observations as the estimators do, and tells as
    they do.

    Args: num: particles; world: task.World, whose ranges and noise are known; seed: of its draws.
    """

    def __init__(self, num, world=task.World(), seed=0):
        self.num, self.world, self.rng = num, world, np.random.default_rng(seed)
        self.worlds = Worlds(num, size=world.box)
        # variances of x, y, theta, force x, y; a sensor without noise has next to none
        self.noise, self.prior = (np.maximum(np.square(x), 1e-12) for x in (world.noise, world.bias))
        self.log_weight = np.zeros(num)

    def begin(self, o, parts=slice(None)):
        """Mean and variance (4,) at an episode's first observation (9,), of which only `parts` tell of the bias."""
        seen, pusher = self._measured(o)
        spread = np.sqrt(self.noise + self.prior)[:3]
        box = seen[:3] + spread * self.rng.standard_normal((self.num, 3))
        self._place(box, pusher, self.world.draw(self.rng, self.num))
        self.bias, self.variance = np.zeros((self.num, 5)), np.tile(self.prior, (self.num, 1))
        self._weigh(seen - np.concatenate([box, np.zeros((self.num, 2))], 1), self.noise[parts], parts)
        self.log_weight = np.zeros(self.num)  # the poses were drawn by this very likelihood
        return self._told()

    def step(self, o):
        """Mean and variance (4,) at the next observation (9,)."""
        seen, pusher = self._measured(o)
        worlds = self.worlds
        worlds.step(np.tile((pusher - worlds.pusher[0]) * task.RATE, (self.num, 1)))
        error = seen - np.concatenate([worlds.box, np.clip(worlds.force, -self.world.max_force, self.world.max_force)], 1)
        error[:, 2] = task.wrap(error[:, 2])
        if not o[8]:
            off = error[:, :3] - self.bias[:, :3]
            if (off**2 / (self.noise + self.variance)[:, :3]).sum(1).min() > LOST:
                return self.begin(o, slice(0, 3))  # the force is that of a box in contact
            self._weigh(error, self.noise[:3], slice(0, 3))
        self._weigh(error, self.noise[3:] + (MODEL * worlds.force)**2, slice(3, 5))
        if 1 / np.square(self._weights()).sum() < self.num / 2:
            self._resample(pusher)
        return self._told()

    def _measured(self, o):
        """Pose and force (5,), and the pusher (2,), in SI units."""
        o = o.astype(float)
        return np.concatenate([task.unscale_pose(o[:4]), o[6:8] * self.world.max_force]), o[4:6] * task.HALF

    def _weigh(self, error, noise, parts):
        """Weighs the particles by errors (N, 5) of their `parts`, and corrects their biases."""
        off, total = (error - self.bias)[:, parts], self.variance[:, parts] + noise
        self.log_weight -= (off**2 / total + np.log(total)).sum(1) / 2
        gain = self.variance[:, parts] / total
        self.bias[:, parts] += gain * off
        self.variance[:, parts] *= 1 - gain

    def _weights(self):
        weights = np.exp(self.log_weight - self.log_weight.max())
        return weights / weights.sum()

    def _resample(self, pusher):
        """Systematic resampling; what is drawn again moves a little, its dynamics within their ranges (a square: the support)."""
        points = (self.rng.random() + np.arange(self.num)) / self.num
        chosen = np.searchsorted(self._weights().cumsum(), points).clip(max=self.num - 1)
        worlds, far, dynamics = self.worlds, self.world.support_offset[1], {}
        for name, (low, high) in (self.world.dynamics | dict.fromkeys(("support_x", "support_y"), (-far, far))).items():
            moved = worlds.dynamics[name][chosen] + SPREAD * (high - low) * self.rng.standard_normal(self.num)
            dynamics[name] = moved.clip(low, high)
        dynamics["mu_static"] = np.maximum(dynamics["mu_static"], dynamics["mu_dynamic"])
        box = worlds.box[chosen] + JITTER * self.rng.standard_normal((self.num, 3))
        self._place(box, pusher, dynamics, worlds.motion[:, chosen, 3:], worlds.force[chosen])
        self.bias, self.variance, self.log_weight = self.bias[chosen], self.variance[chosen], np.zeros(self.num)

    def _place(self, box, pusher, dynamics, *moving):
        self.worlds.place(np.arange(self.num), box, np.tile(pusher, (self.num, 1)), dynamics, *moving)

    def _told(self):
        """Mean and variance (4,) of x, y, sin and cos, scaled."""
        q, weights = task.scale(self.worlds.state)[:, :4], self._weights()
        mean = weights @ q
        return mean, weights @ np.square(q - mean)


class Filters(torch.nn.Module):
    """A Filter a trajectory, in the place of an estimator; in a loop one world at a time. Seeded by torch's draws."""

    def __init__(self, num, world=task.World()):
        super().__init__()
        self.num, self.world = num, world

    def predict(self, o, hidden=None, passes=None):
        """As networks.Estimator.predict; the hidden state is the filters."""
        filters = hidden or [Filter(self.num, self.world, seed) for seed in torch.randint(2**62, (o.shape[1],)).tolist()]
        told = [[f.step(x) if hidden or t else f.begin(x) for f, x in zip(filters, row)]
                for t, row in enumerate(o.cpu().numpy())]
        return *torch.as_tensor(np.array(told), dtype=torch.float32).unbind(2), filters
