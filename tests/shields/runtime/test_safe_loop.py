"""The loop without Gymnasium: the same decisions and proofs as the wrapper's."""

import copy
from contextlib import nullcontext

import numpy as np
import pytest
import torch

from ncs_gym import Channel, ChannelContract, Ellipsoid, Packet, cart_pole, truck_trailer
from ncs_gym.network.channel import UnusedPacketsWarning
from shields.runtime.guard import ALARM, NOT_FINITE, NOT_KNOWN_INSIDE, OTHER_INPUT
from tests.certificates import certificate_of
from tests.product import loop_step, safe_loop

# Plant, contract, channel.
LOOPS = {
    "truck": (truck_trailer(mass=4000.0), None, Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2)),
    "cart-pole": (cart_pole(), ChannelContract(4), Channel(loss=0.6, max_consecutive_losses=2, jitter=2)),
}


def loop_of(name, mode="project", channel=None):
    plant, contract, usual = LOOPS[name]
    return safe_loop(certificate_of(plant, contract), plant, usual if channel is None else channel, mode)


def started(channel=None):
    loop = loop_of("truck", channel=channel)
    loop.start(np.zeros(loop.filter.plant.n))
    return loop


def pushed(plant, x, u, direction):
    """The next state under the disturbance that pushes it farthest in a direction."""
    return plant.A @ x + plant.B @ u + plant.nominal_disturbance.extreme_point(direction)


@pytest.mark.parametrize("told", [False, True])
def test_another_input_than_decided_is_told_or_found_out(told):
    loop, x, reasons = started(channel=Channel()), np.zeros(2), []
    for _ in range(30):
        decision = loop.decide(0.5 * loop.filter.plant.largest_input)
        applied = -decision.input
        x = pushed(loop.filter.plant, x, applied, -np.ones(2))
        packet = Packet(loop.steps + 1, x)
        loop.receive([packet], applied=applied if told else None)
        reasons.append(loop.reason)
        if told:  # the estimate follows what was applied: its bound stays true
            e = loop.estimate - x
            assert e @ np.linalg.solve(loop.error_shape, e) <= 1.0
    assert set(reasons[-20:]) == {OTHER_INPUT if told else ALARM}
    assert (reasons[0] == OTHER_INPUT) is told


@pytest.mark.parametrize(("held", "passes"), [(0.1, True), (4.0, False)])
def test_missed_step_in_which_the_input_was_held_is_a_step(held, passes):
    loop = loop_of("truck")
    loop.start([1.5, 0.5])
    loop_step(loop, held)
    decision = loop_step(loop, held)  # for the step that the clock missed
    assert decision.intervened is not passes
    loop.receive(applied=held)
    assert (loop.steps, loop.reason) == (2, "" if passes else OTHER_INPUT)


@pytest.mark.parametrize("applied", [[np.nan], [0.0, 0.0], "left", np.inf])
def test_unusable_report_of_the_actuator_ends_the_guarantee_and_keeps_the_estimate(applied):
    loop, twin = started(), started()
    for each in (loop, twin):
        each.decide(1.0)
    np.testing.assert_array_equal(loop.receive(applied=applied), twin.receive())
    assert loop.reason == OTHER_INPUT
    assert twin.guaranteed


def test_proposals_beyond_the_limits_are_clipped():
    loop = started()
    limit = float(loop.filter.plant.largest_input[0])
    decision = loop.decide(limit * (1.0 + 1e-9))
    assert decision.reason == "safe"
    np.testing.assert_array_equal(decision.input, [limit])


def test_what_the_caller_keeps_is_its_own():
    loop, twin = started(channel=Channel()), started(channel=Channel())
    measurement = np.array([0.01, 0.01])
    for each in (loop, twin):
        for step in range(3):
            decision = each.decide(0.1)
            if each is loop:
                decision.input[:] = 99.0
            estimate = each.receive([Packet(step + 1, measurement)])
            if each is loop:
                estimate[:] = each.estimate[:] = each.error_shape[:] = 99.0
                measurement[:] = 99.0  # a buffer that the receiver fills again
                measurement = np.array([0.01, 0.01])
    np.testing.assert_array_equal(loop.estimate, twin.estimate)
    assert loop.guaranteed


@pytest.mark.parametrize("value", [0.25, np.nan])
@pytest.mark.parametrize("order", [(0, 1), (1, 0), (0, None, 1)])
def test_another_value_of_a_sample_ends_the_guarantee_whatever_comes_first(order, value):
    loop = started(channel=Channel(delay=3))
    for _ in range(3):
        loop_step(loop, np.zeros(1))
    sample = Packet(2, loop.estimate)
    both = [sample, Packet(2, sample.measurement + value)]
    loop_step(loop, np.zeros(1), [sample, Packet(2, sample.measurement.copy())])
    assert loop.guaranteed
    loop.start(np.zeros(2))
    for _ in range(3):
        loop_step(loop, np.zeros(1))
    both = [each._replace(episode=loop.episode) for each in both]
    if None in order:
        loop_step(loop, np.zeros(1), both[:1])
        assert loop.guaranteed
        loop_step(loop, np.zeros(1), both[1:])
    else:
        loop_step(loop, np.zeros(1), [both[which] for which in order])
    assert loop.reason in (ALARM, NOT_FINITE)


@pytest.mark.parametrize("has_begun", [True, False])
def test_packet_of_an_earlier_episode_is_discarded_whatever_its_stamp(has_begun):
    loop = started(channel=Channel(delay=3))
    assert loop.episode == 0
    late = Packet(1, np.array([9.0, 9.0]), loop.episode)
    loop.decide(0.0)
    if has_begun:
        loop.receive()
    loop.start([0.0, 0.0])
    assert loop.episode == 1
    loop_step(loop, 0.0)
    loop_step(loop, 0.0, [late])
    assert loop.guaranteed
    assert loop.measurement_age == 1
    loop_step(
        loop, 0.0, [Packet(1, np.array([0.0, 0.0]), loop.episode)]
    )  # its own is used, although the other came first
    assert (loop.guaranteed, loop.measurement_age) == (True, 1)
    loop_step(loop, 0.0, [late._replace(episode=loop.episode, stamp=2)])
    assert loop.reason == ALARM


def test_step_is_receive_and_then_decide():
    one, two = started(channel=Channel()), started(channel=Channel())
    for step in range(20):
        packets = [Packet(step, [0.01, -0.01])]
        decision = loop_step(one, 1.0, packets)
        two.receive(packets)
        np.testing.assert_equal(decision, two.decide(1.0))
    np.testing.assert_array_equal(one.estimate, two.estimate)


def test_start_is_in_the_safe_set_only_if_estimate_or_set_say_so():
    loop, certificate = loop_of("truck"), certificate_of(LOOPS["truck"][0])
    edge = (1.0 - 1e-12) * certificate.safe_set.extreme_point([1.0, 0.4])
    loop.start(edge)
    assert loop.reason == NOT_KNOWN_INSIDE
    for known in (edge, certificate.safe_set):
        loop.start(edge, initial_set=known)
        assert loop.guaranteed
    loop.start(edge, initial_set=Ellipsoid(1.01 * certificate.safe_set.shape_matrix))
    assert loop.reason == NOT_KNOWN_INSIDE


@pytest.mark.parametrize(("delay", "late"), [(0, 20), (1, 0)])
def test_sample_that_is_sent_after_a_decision_and_received_at_the_next_step_is_one_step_late(delay, late):
    loop = started(channel=Channel(delay=delay))
    arrived = []
    with pytest.warns(UnusedPacketsWarning, match="longest delay") if late else nullcontext():
        for step in range(21):
            loop_step(loop, 0.0, arrived)
            arrived = [Packet(step, np.zeros(2), loop.episode)]
    assert loop.discarded.too_late == late
    assert loop.measurement_age == (20 if late else 1)


@pytest.mark.filterwarnings("error")
def test_proposals_that_are_no_input_are_told_of_once_and_not_applied():
    gradient = torch.tensor([0.5], requires_grad=True)
    for proposed in (gradient, [gradient[0]], np.full((1, 1), 0.5), "full throttle", np.nan, np.array([np.inf])):
        loop = started(channel=Channel())
        assert loop_step(loop, None).reason == "invalid"  # a controller that failed is no mistake
        with pytest.warns(UserWarning, match=r"one input, finite numbers of shape \(1,\), got .*K x_hat is applied"):
            decision = loop_step(loop, proposed)
        assert decision.reason == "invalid"
        np.testing.assert_allclose(decision.input, loop.filter.certificate.K @ loop.estimate, atol=1e-6)
        loop_step(loop, proposed)


def test_copy_of_a_loop_shares_nothing_with_it():
    """A shallow copy that shared the estimator would go on with what the other was told, and be guaranteed outside."""
    loop, x = started(channel=Channel(delay=1)), np.zeros(2)
    plant = loop.filter.plant
    for k in range(30):
        loop.receive([Packet(k, x, loop.episode)] if k else [])
        x = plant.A @ x + plant.B @ loop.decide([4.0]).input
    trial, own = copy.copy(loop), copy.deepcopy(loop)
    for _ in range(50):
        trial.receive()
        trial.decide([-4.0])
        loop.receive()
        own.receive()
        np.testing.assert_array_equal(loop.decide([4.0]).input, own.decide([4.0]).input)
        assert loop.guaranteed == own.guaranteed
