"""What a user would write instead: the truck-trailer behind a lossy channel, on filterpy, in forty lines.

One environment, the late packet applied as if it were current, no bound on the error, almost no info.
"""

import gymnasium as gym
import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.signal import cont2discrete


class PlainTruckTrailer(gym.Env):
    def __init__(self, mass=4000.0, loss=0.3, step=0.05, period=2, delay=2, u_max=4.0):
        continuous = (np.array([[0.0, 1.0], [-4500.0 / mass, -4600.0 / mass]]), np.array([[0.0], [1.0]]))
        self.A, self.B, *_ = cont2discrete((*continuous, np.eye(2), np.zeros((2, 1))), 0.5)
        self.loss, self.step_size, self.period, self.delay, self.u_max = loss, step, period, delay, u_max
        self.observation_space = gym.spaces.Box(-100.0, 100.0, (3,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps, self.in_flight = 0.2 * self.np_random.uniform(-1, 1, 2), 0, {}
        self.speed, self.target = self.np_random.uniform(0, 25, 2)
        self.filter = KalmanFilter(dim_x=2, dim_z=2, dim_u=1)
        self.filter.x, self.filter.F, self.filter.B, self.filter.H = self.x.copy(), self.A, self.B, np.eye(2)
        self.filter.P, self.filter.Q, self.filter.R = 1e-4 * np.eye(2), 6e-4 * np.eye(2), 3e-4 * np.eye(2)
        return self._observation(), {}

    def step(self, action):
        u, rng = self.u_max * np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0), self.np_random
        noise = 0.01 * rng.standard_normal(2) + rng.uniform(-1.0, 1.0, 2) * (0.02, 0.01)
        self.x = self.A @ self.x + self.B @ u + noise
        self.steps += 1
        self.speed += 0.5 * u[0]
        if rng.random() < 0.02:
            self.target = rng.uniform(0, 25)
        if self.steps % self.period == 0 and rng.random() >= self.loss:
            y = np.round((self.x + 0.01 * rng.standard_normal(2)) / self.step_size) * self.step_size
            self.in_flight[self.steps + self.delay] = y
        self.filter.predict(u)
        if self.steps in self.in_flight:
            self.filter.update(self.in_flight.pop(self.steps))
        reward = -0.2 * min(abs(self.target - self.speed) / 5.0, 5.0) - 0.002 * u[0] ** 2
        return self._observation(), float(reward), False, self.steps >= 200, {"cost": float(np.abs(self.x).max() > 2.0)}

    def _observation(self):
        return np.array([*self.filter.x, self.target - self.speed], dtype=np.float32)
