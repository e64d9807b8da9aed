"""Badly scaled and nearly unstable plants: a verified certificate or `Infeasible`, nothing else."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.random_plants import badly_scaled_plant
from ncs_gym import Channel, ChannelContract
from ncs_gym.estimation.error_bound import certified_error_set
from shields import Infeasible
from tests.fuzz import examples, plants
from tests.product import loop_env, safety_shield, synthesize
from tests.verdicts import verified


def test_the_disturbance_bound_does_not_depend_on_units():
    """A bound around gamma's ball and the process noise once was a thousand times too large in some coordinates."""
    for seed in range(5):
        plant = badly_scaled_plant(seed, 4, 1, 6.0, 0.99)
        widths = plant.half_widths
        parts = np.sqrt(plant.gamma) + np.sqrt(np.diag(plant.process_noise.bound.shape_matrix))
        assert (np.sqrt(np.diag(plant.disturbance.shape_matrix)) <= 2.0 * np.maximum(parts, 1e-5 * widths)).all()


def judged(plant, contract=None):
    """A verified certificate of a plant, or None with a reason."""
    try:
        certificate = synthesize(plant, contract=contract)
    except Infeasible as infeasible:
        reason, binding = str(infeasible), infeasible.binding
    else:
        assert verified(certificate, plant).valid
        return certificate
    assert binding
    assert "\n" not in reason
    return None


@pytest.mark.slow
@given(plant=plants(radius=(0.5, 0.9999)))
@examples(150, same=False)
def test_many_random_plants_get_a_certificate_or_a_reason(plant):
    judged(plant)


@pytest.mark.slow
@given(plant=plants(most_states=3, most_inputs=2, radius=(0.5, 1.1)), age=st.integers(0, 3))
@examples(60, same=False)
def test_many_random_plants_under_contracts_get_a_certificate_or_a_reason(plant, age):
    judged(plant, ChannelContract(age, 1e-6))


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (0, 2))])
def test_a_shield_holds_in_whatever_units(seed):
    plant = badly_scaled_plant(seed, 3, 2, 6.0, 0.99)
    certificate = judged(plant)
    env = safety_shield(loop_env(plant, Channel(0.5), disturbance="adversarial"), certificate)
    env.reset(seed=seed)
    rng, interventions = np.random.default_rng(seed), 0
    for _ in range(60):
        *_, info = env.step(np.sign(rng.uniform(-1.0, 1.5, 2)).astype(np.float32))
        interventions += info["shield_intervened"]
        assert info["shield_guaranteed"]
        assert certificate.safe_set.gauge(info["state"]) <= 1.0
    assert interventions > 0


def test_an_error_set_in_other_units_is_the_same_set():
    one, other = (badly_scaled_plant(7, 3, 1, decades, 0.999) for decades in (0, 6))
    sizes = [np.sqrt(np.diag(certified_error_set(plant).Sigma)) / plant.half_widths for plant in (one, other)]
    np.testing.assert_array_less(sizes[1], 1.5 * sizes[0])
