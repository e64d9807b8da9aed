"""The row about late packets: the closed loop of Section 5, simulated with each reading of Definition 1's filter.

The gain is the printed one; noise, disturbance, channel and starts are the same for every filter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from experiments.paper.audit.claim import Claim, Verdict
from experiments.paper.kalman_filter import DefinitionThreeFilter
from experiments.paper.paper_example import PaperExample
from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.estimation import VectorEstimator
from ncs_gym.estimation.arrival_patterns import arrival_patterns
from ncs_gym.network.packet_transmission import VectorChannelState
from ncs_gym.processes.simulation import PlantSimulation
from ncs_gym.registration import CASE_STUDY_CHANNEL

# As in Section 5, with several seeds.
_STARTS, _STEPS, _SEEDS = 100, 200, 4

MakeFilter = Callable[[PaperExample, LinearPlant, np.ndarray], DefinitionThreeFilter | VectorEstimator]


def taken_as_current(example: PaperExample, plant: LinearPlant, mean: np.ndarray) -> DefinitionThreeFilter:
    """Returns Definition 1's filter that takes a late sample for y_k."""
    return DefinitionThreeFilter(example, plant, mean, takes_late=True)


def discarded(example: PaperExample, plant: LinearPlant, mean: np.ndarray) -> DefinitionThreeFilter:
    """Returns Definition 1's filter that discards late samples."""
    return DefinitionThreeFilter(example, plant, mean, takes_late=False)


def replayed(example: PaperExample, plant: LinearPlant, mean: np.ndarray) -> VectorEstimator:
    """Returns this project's filter, which goes back to the step of a late sample and replays what came after."""
    estimator = VectorEstimator(plant, arrival_patterns(plant, CASE_STUDY_CHANNEL, None), mean.shape[1])
    estimator.begin(slice(None), mean)
    return estimator


def late_packet_claim(example: PaperExample) -> Claim:
    """Returns the row about the error bound under delay."""
    current, skipped, again = (
        [largest_error(example, make, seed=seed) for seed in range(_SEEDS)]
        for make in (taken_as_current, discarded, replayed)
    )
    holds = max(current + skipped + again) <= example.epsilon
    times = min(current) / example.epsilon
    return Claim(
        "the error stays within epsilon with packets that arrive two steps late",
        f"e'e < epsilon = {example.epsilon}, with the filter of Definition 1, which has no late packets",
        f"simulated with the printed K ({_SEEDS} times {_STARTS} starts, {_STEPS} steps): if the filter takes late "
        f"packets as current, max e'e = {min(current):.3f} to {max(current):.3f}, at least {times:.1f} times epsilon; "
        f"if it discards them, at most {max(skipped):.5f}; a filter that goes back to the step of the sample and "
        f"replays reaches at most {max(again):.5f}",
        Verdict.HOLDS if holds else Verdict.UNDECIDED,
        "" if holds else "the paper does not say what its filter does with a late packet",
    )


def largest_error(
    example: PaperExample, make_filter: MakeFilter, *, noise_variance: float | None = None, seed: int = 0
) -> float:
    """Returns the largest e'e, e = B K e_up, over all starts and steps.

    Args:
        example: The printed numbers.
        make_filter: Returns the filter, given the first estimates, shape (2, N).
        noise_variance: R = noise_variance I in place of the plant's own.
        seed: Seed of starts, noise, disturbance and channel, which are the same for every filter.
    """
    plant, channel, rng = example.plant, CASE_STUDY_CHANNEL, np.random.default_rng(seed)
    if noise_variance is not None:
        plant = replace(plant, measurement_noise_cov=noise_variance * np.eye(2))
    state = Ellipsoid(example.L).sample(rng, _STARTS).T
    process = PlantSimulation(plant, example.disturbance, False, _STARTS)
    memory, network = process.begin(rng, _STARTS), VectorChannelState(channel, rng, _STARTS)
    estimator = make_filter(example, plant, state + plant.sample_initial_error(rng, _STARTS).T)
    gain, limit, largest = plant.B @ example.K, plant.u_max[:, None], 0.0
    for step in range(_STEPS):
        largest = max(largest, float(np.square(gain @ (estimator.mean - state)).sum(axis=0).max()))
        u = np.clip(example.K @ estimator.mean, -limit, limit)
        state = process.advance(rng, state, u, np.full(_STARTS, step), memory)
        sends = network.send(rng, np.full(_STARTS, step + 1))
        samples = channel.quantize(process.measure(rng, state)) if sends.any() else None
        estimator.advance(u, samples, network.arrivals())
    return largest
