"""The closed loop of Section 5 with packets that arrive late, simulated with each reading of Definition 1's filter.

The gain is the printed one; noise, disturbance, channel and starts are the same for every filter.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from experiments.paper.paper_example import PaperExample
from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.estimation import VectorEstimator
from ncs_gym.estimation.arrival_histories import arrival_histories
from ncs_gym.network.packet_loss_and_delay import VectorChannelState
from ncs_gym.processes.plant_step import PlantSimulation
from ncs_gym.registration import CASE_STUDY_CHANNEL
from shields.paper.bounds import with_noise

# As in Section 5.
STARTS, STEPS = 100, 200


class Definition1Filter:
    """The Kalman filter of Definition 1 for N episodes at once: it predicts with G = A + BK and corrects with y_k.

    It has no equation for late packets: they are taken for y_k, or discarded. The last axis of every array is the
    episode; `mean` is x_hat, shape (n, N).
    """

    def __init__(self, example: PaperExample, plant: LinearPlant, mean: np.ndarray, *, takes_late: bool) -> None:
        self.mean, self._plant, self._takes_late = mean, plant, takes_late
        self._G = plant.A + plant.B @ example.K
        self._Q_bar = plant.process_noise.covariance + plant.gamma * np.eye(plant.n)
        self._covariance = np.repeat(plant.initial_noise.covariance[None], mean.shape[1], axis=0)
        # By age: what was measured, None where nobody sent.
        self._samples: list[np.ndarray | None] = []

    def advance(self, u: np.ndarray, samples: np.ndarray | None, arrivals: list[tuple[int, np.ndarray]]) -> None:
        """Moves one step on; Definition 1 predicts with G, so the inputs u are not used.

        Samples are those of this step, (p, N); arrivals are the ages that arrive now, each with the episodes, (N,).
        """
        self._samples.insert(0, samples)
        self.mean = self._G @ self.mean
        self._covariance = self._G @ self._covariance @ self._G.T + self._Q_bar
        for age, arrives in arrivals:
            sample = self._samples[age]
            if sample is not None and (age == 0 or self._takes_late):
                self._correct(sample, arrives)

    def _correct(self, sample: np.ndarray, arrives: np.ndarray) -> None:
        """Corrects the episodes in which a sample, shape (p, N), arrives, as if it were measured now."""
        H, P = self._plant.H, self._covariance[arrives]
        gains = P @ H.T @ np.linalg.inv(H @ P @ H.T + self._plant.sensor_noise.covariance)
        residuals = (sample - H @ self.mean)[:, arrives]
        self.mean[:, arrives] += np.einsum("eij,je->ie", gains, residuals)
        self._covariance[arrives] = (np.eye(self._plant.n) - gains @ H) @ P


MakeFilter = Callable[[PaperExample, LinearPlant, np.ndarray], Definition1Filter | VectorEstimator]


taken_as_current: MakeFilter = partial(Definition1Filter, takes_late=True)
discarded: MakeFilter = partial(Definition1Filter, takes_late=False)


def replayed(example: PaperExample, plant: LinearPlant, mean: np.ndarray) -> VectorEstimator:
    """Returns this project's filter, which goes back to the step of a late sample and replays what came after."""
    estimator = VectorEstimator(plant, arrival_histories(plant, CASE_STUDY_CHANNEL, None), mean.shape[1])
    estimator.begin(slice(None), mean)
    return estimator


def largest_error(
    example: PaperExample, make_filter: MakeFilter, *, noise_variance: float | None = None, seed: int = 0
) -> float:
    """Returns the largest e'e, e = B K e_up, over all starts and steps, with R = noise_variance I if it is given.

    The seed is that of starts, noise, disturbance and channel, which are the same for every filter.
    """
    plant, channel, rng = example.plant, CASE_STUDY_CHANNEL, np.random.default_rng(seed)
    if noise_variance is not None:
        plant = with_noise(plant, R=noise_variance * np.eye(2))
    state = Ellipsoid(example.L).sample(rng, STARTS).T
    process = PlantSimulation(plant, example.disturbance, False, STARTS)
    memory, network = process.begin(rng, STARTS), VectorChannelState(channel, rng, STARTS)
    estimator = make_filter(example, plant, state + plant.of_first_error.drawn(rng, STARTS).T)
    gain, limit, largest = plant.B @ example.K, plant.largest_input[:, None], 0.0
    for step in range(STEPS):
        largest = max(largest, float(np.square(gain @ (estimator.mean - state)).sum(axis=0).max()))
        u = np.clip(example.K @ estimator.mean, -limit, limit)
        state = process.advance(rng, state, u, np.full(STARTS, step), memory)
        sends = network.send(rng, np.full(STARTS, step + 1))
        samples = channel.quantize(process.measure(rng, state)) if sends.any() else None
        estimator.advance(u, samples, network.arrivals())
    return largest
