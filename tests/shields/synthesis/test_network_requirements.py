"""Which networks leave a plant certifiable: every possible one has a proof, and more room is never less."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, LinearPlant, contract_of
from ncs_gym.processes.gym_pendulum import pendulum
from shields import Infeasible, Network, requirements, synthesize, verify
from shields.synthesis.certification import carried_over, nearby_certificate
from shields.synthesis.network_requirements import kind_of_share
from shields.synthesis.requirement_search import BoundarySearch, with_radii
from tests import plants


def servo(**changes):
    """The servo at steps of 10 ms."""
    return plants.servo(1.0, **{"dt": 0.01, "disturbance_bound": [0.0, 0.5]} | changes)


@pytest.fixture(scope="module")
def found():
    return requirements(
        servo(), send_periods=[1, 2], losses=[0, 1, 4], quantization_steps=[0.0, 2e-3], noises=[1.0, 2.0]
    )


@pytest.mark.slow
def test_every_possible_network_has_a_certificate_that_verifies(found):
    assert {point.certificate is None for point in found.points} == {True, False}
    for point in found.points:
        if point.certificate is not None:
            network = point.network
            assert verify(point.certificate, with_radii(servo(), disturbance=1.0, noise=network.noise)).valid
            channel = Channel(
                0.5,
                quantization_step=network.quantization_step,
                send_period=network.send_period,
                max_consecutive_losses=network.losses,
            )
            assert point.certificate.contract is not None
            assert point.certificate.contract.is_kept_by(channel)


@pytest.mark.slow
def test_more_room_is_never_less(found):
    for tight in found.points:
        for loose in found.points:
            a, b = tight.network, loose.network
            if a.age >= b.age and a.quantization_step >= b.quantization_step and a.noise >= b.noise:
                assert loose.share >= tight.share


@pytest.mark.slow
def test_largest_age_is_followed_by_one_for_which_none_was_found(found):
    for largest in found.largest_ages:
        assert largest.certified is not None
        assert largest.none_found == largest.certified + 1
        plant = with_radii(servo(), disturbance=1.0, noise=largest.network.noise)
        contract = ChannelContract(int(largest.certified), largest.network.quantization_step)
        assert nearby_certificate(plant, contract) is not None


@pytest.mark.slow
def test_known_largest_age_of_the_pendulum():
    (largest,) = requirements(pendulum(), losses=[7]).largest_ages
    assert largest.certified is not None
    assert largest.certified >= 8


def test_age_of_a_network_is_that_of_its_channel_and_the_input_delay():
    network = Network(sampling_period=0.1, send_period=3, losses=2, delay=1, jitter=4, input_delay=5)
    promised = contract_of(Channel(0.5, send_period=3, delay=1, jitter=4, max_consecutive_losses=2))
    assert promised is not None
    assert network.age == promised.max_age + 5
    assert Network(sampling_period=0.1, losses=None).age == inf
    assert network.packets_per_second == pytest.approx(1.0 / 0.3)


def test_bits_are_enough_for_every_level_of_the_quantizer():
    plant = servo(sensor_bound=0.0)
    coarse, exact = requirements(plant, quantization_steps=[0.1, 0.0]).points
    levels = len({round(y / 0.1) for y in np.linspace(-0.2, 0.2, 1001)})
    assert coarse.bits_per_second == pytest.approx(np.ceil(np.log2(levels)) / 0.01)
    assert exact.bits_per_second == pytest.approx(64 / 0.01)


def test_cheapest_network_keeps_the_share_and_no_cheaper_one_does():
    found = requirements(servo(), send_periods=[1, 2], losses=[0, 1])
    cheapest = found.cheapest(0.9)
    assert cheapest is not None
    assert cheapest.share >= 0.9 * found.largest_share
    for point in found.points:
        if point.network.packets_per_second < cheapest.network.packets_per_second:
            assert point.share < 0.9 * found.largest_share
    demanded = Network(sampling_period=0.01, losses=1)
    bearing = found.cheapest(0.5, demanded)
    assert bearing is not None
    assert bearing.network.most_losses >= 1


@pytest.mark.slow
def test_tolerated_factor_certifies():
    (point,) = requirements(servo(), tolerance=True).points
    assert point.tolerance is not None
    assert point.tolerance > 1.0
    plant = with_radii(servo(), disturbance=point.tolerance, noise=point.tolerance)
    assert synthesize(plant, contract=ChannelContract(0)) is not None


def test_stable_plant_may_lose_everything_and_an_unstable_one_may_not():
    stable = LinearPlant(
        A=[[0.9]], B=[[1.0]], box=[1.0], u_max=1.0, dt=1.0, disturbance_bound=0.02, sensor_bound=0.0, initial_bound=0.0
    )
    limited, unlimited = requirements(stable, losses=[3, None]).points
    assert unlimited.certificate is not None
    assert unlimited.certificate.contract is None
    assert limited.share >= unlimited.share
    (unstable,) = requirements(replace(stable, A=[[1.1]]), losses=[None]).points
    assert unstable.certificate is None


def test_resampled_plant_is_the_model_sampled_at_that_period():
    direct = servo(dt=0.02)
    resampled = servo().resampled(0.02)
    assert np.array_equal(resampled.A, direct.A)
    assert np.array_equal(resampled.B, direct.B)
    # A disturbance that is constant for two short steps is that of one long step.
    step, d = servo(), np.array([0.0, 0.5])
    twice = step.A @ d + d
    assert resampled.nominal_disturbance.contains(twice * (1.0 - 1e-9))
    assert not resampled.nominal_disturbance.contains(twice * 1.001)
    assert servo().resampled(0.01) is not None
    assert servo().resampled(0.01).fingerprint == servo().fingerprint


def test_plant_without_a_continuous_model_may_be_a_function_of_the_period():
    plant = LinearPlant(A=[[0.9]], B=[[1.0]], box=[1.0], u_max=1.0, dt=1.0, disturbance_bound=0.0)
    found = requirements(lambda dt: replace(plant, dt=dt), sampling_periods=[0.5, 1.0])
    assert [point.network.sampling_period for point in found.points] == [0.5, 1.0]
    # A stable plant that is disturbed so little needs no samples.
    assert [largest.certified for largest in found.largest_ages] == [np.inf, np.inf]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(6))])
def test_certificate_of_a_tighter_problem_is_a_candidate_of_a_looser_one(seed):
    """Random pairs of input limits, boxes and bounds of a stable plant."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2, 2))
    plant = LinearPlant(
        A=0.9 * A / np.abs(np.linalg.eigvals(A)).max(),
        B=rng.normal(size=(2, 1)),
        box=rng.uniform(0.5, 2.0, 2),
        u_max=rng.uniform(0.2, 2.0),
        dt=1.0,
        disturbance_bound=rng.uniform(0.005, 0.03),
        sensor_bound=0.01,
        initial_bound=0.01,
    )
    try:
        tight = synthesize(plant, safe_set="ellipsoid")
    except Infeasible:
        pytest.skip("the tighter problem has no certificate")
    looser = replace(plant, u_max=plant.u_max * rng.uniform(1.0, 20.0), disturbance_bound=0.7 * 0.005)
    loose = synthesize(looser, safe_set="ellipsoid", candidates=[tight])
    assert np.linalg.slogdet(loose.L)[1] >= np.linalg.slogdet(tight.L)[1] - 1e-12
    assert verify(loose, looser).valid


def test_certificate_of_a_looser_problem_is_no_candidate_of_a_tighter_one():
    plant = servo()
    loose = nearby_certificate(plant, ChannelContract(0))
    assert loose is not None
    assert carried_over(loose, plant, ChannelContract(1)) is None
    assert carried_over(loose, plant, None) is None
    assert carried_over(loose, with_radii(plant, disturbance=50.0, noise=1.0), ChannelContract(0)) is None


@pytest.mark.slow
def test_infeasible_names_the_limits_that_would_be_enough():
    plant = servo(u_max=0.5, disturbance_bound=[0.0, 0.3])
    with pytest.raises(Infeasible, match=r"times the limit of u1 or more") as caught:
        synthesize(plant, contract=ChannelContract(0))
    factor = caught.value.details["u_max_1_factor"]
    assert synthesize(replace(plant, u_max=1.05 * factor * plant.u_max), contract=ChannelContract(0)) is not None
    with pytest.raises(Infeasible):
        synthesize(replace(plant, u_max=0.9 * factor * plant.u_max), contract=ChannelContract(0))


def test_infeasible_names_a_pair_where_no_change_alone_is_enough(monkeypatch):
    from shields.synthesis import diagnosis

    plant = servo()

    def certifies(changed, contract, *, polytope):
        """Feasible once the input limit and the box are both at least three times as wide."""
        return bool(changed.u_max[0] >= 3.0 * plant.u_max[0] and changed.half_widths[1] >= 3.0 * plant.half_widths[1])

    monkeypatch.setattr(diagnosis, "is_feasible", certifies)
    told = diagnosis.with_feasible_bounds(Infeasible("none", "I", 0.5), plant, None)
    assert told.details.keys() == {"pair_factor"}
    assert told.details["pair_factor"] == pytest.approx(3.0, rel=0.03)
    assert "the limit of u1 and the safe box" in str(told)


def test_search_for_the_largest_age_asks_before_every_age_whether_it_should_end():
    plant = servo()
    search = BoundarySearch(
        title="",
        plant=plant,
        quantization_step=0.0,
        ages=(0, 4),
        start=nearby_certificate(plant, ChannelContract(0)),
    )
    reported = []
    answers = search(reported.append)
    assert reported == [0, *[1] * len(answers), search.count - len(answers)]
    assert len(answers) == search.count == 2


@pytest.mark.parametrize(
    ("ages", "up_to", "asked"),
    [
        ((13,), 1000, [27, 55, 56]),
        ((13,), 30, [27, 55, 41, 34, 30, 32, 31]),
        ((0, 40), 37, [20, 30, 35, 37, 38]),  # between ages of which the older one has none
        ((1000,), 1000, []),
    ],
)
def test_largest_age_is_bisected_and_sought_up_to_four_times_the_oldest_asked(monkeypatch, ages, up_to, asked):
    plant = servo()
    start = nearby_certificate(plant, ChannelContract(0))

    def nearby(plant, contract, best):
        return start if contract is not None and contract.max_age <= up_to else None

    monkeypatch.setattr("shields.synthesis.requirement_search.nearby_certificate", nearby)
    search = BoundarySearch(title="", plant=plant, quantization_step=0.0, ages=ages, start=start)
    reported = []
    answers = search(reported.append)
    assert list(answers) == asked
    certified = [age for age, answer in answers.items() if answer.certificate is not None]
    assert max(certified, default=ages[0]) == min(up_to, 56 if ages == (13,) else up_to)
    assert sum(reported) == search.count
    assert min(reported) >= 0


def test_limits_with_two_ends_have_shares_of_polytopes_and_open_boxes_none():
    model = {"A": [[1.0, 0.1], [0.0, 0.8]], "B": [[0.0], [0.1]], "dt": 0.1, "input_limits": (-1.0, 2.0)}
    model |= {"disturbance_bound": [0.02, 0.04], "sensor_bound": 0.01, "initial_bound": 0.01}
    closed = LinearPlant(state_limits=([-1.0, -1.0], [2.0, 1.5]), **model)
    free = LinearPlant(state_limits=([-1.0, -np.inf], [2.0, np.inf]), **model)
    for plant, kind in ((closed, "polytope"), (free, "certificate")):
        found = requirements(plant, send_periods=[1, 2], losses=[0], sampling_periods=[0.1])
        certified = [point for point in found.points if point.certificate is not None]
        assert certified
        for point in certified:
            assert kind_of_share(point.certificate) == kind
            share = point.certificate.provenance.get("polytope_share_of_box", 1.0)
            assert point.share == share
            assert 0.5 < share <= 1.0


def test_shares_for_limits_with_two_ends_are_nearly_those_that_synthesis_keeps():
    plant = plants.servo(1.0, box=None, state_limits=([-0.1, -4.0], [0.3, 4.0]))
    points = requirements(plant, losses=[0, 2, 4]).points
    for point in points:
        kept = synthesize(plant, contract=point.network.contract).provenance["polytope_share_of_box"]
        assert point.share == pytest.approx(kept, abs=0.02)
    assert [point.share for point in points] == sorted((point.share for point in points), reverse=True)


def test_factor_on_radii_is_found_for_limits_with_two_ends():
    plant = LinearPlant(
        A=[[0.9]], B=[[0.4]], dt=1.0, operating_state=[1.0], operating_input=0.25, state_limits=(0.2, 2.0),
        input_limits=(0.0, 1.0), disturbance_bound=0.02, sensor_bound=0.01, initial_bound=0.02,
    )  # fmt: skip
    (point,) = requirements(plant, tolerance=True).points
    assert point.tolerance > 1.0
    scaled = with_radii(plant, disturbance=point.tolerance, noise=point.tolerance)
    assert verify(synthesize(scaled, contract=ChannelContract(0)), scaled).valid
