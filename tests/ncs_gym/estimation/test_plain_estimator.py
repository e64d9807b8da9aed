"""Estimators that look up arrival histories equal one that works everything out, whatever arrives when."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ncs_gym import Channel, ChannelContract, ErrorSetError, Packet, cart_pole, truck_trailer
from ncs_gym.estimation import arrival_histories
from ncs_gym.estimation.arrival_histories import histories_of
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.estimation.kalman_filter import ErrorRecursion
from ncs_gym.network.packet_loss_and_delay import ChannelState
from ncs_gym.plants.library import batch_reactor
from tests import arrays
from tests.fuzz import channels, examples, plants
from tests.ncs_gym.estimation.plain_estimator import PlainEstimator


def attacked(rng, packets, sent, step, plant):
    """The packets of a channel, disturbed: duplicates, strangers and damaged ones among them, in any order."""
    packets = [*packets]
    kind = rng.integers(12)
    if kind < 3 and sent:  # copies of what was sent, in time, too late or lost before
        packets += [sent[int(index)] for index in rng.integers(max(len(sent) - 8, 0), len(sent), 1 + kind)]
    elif kind == 3:  # from before the first step, the far past and the future
        packets += [Packet(stamp, rng.standard_normal(plant.p)) for stamp in (0, -1, step - 50, step + 1, step + 7)]
    elif kind == 4:
        packets.append(Packet(int(step - rng.integers(3)), np.full(plant.p, rng.choice([np.nan, np.inf]))))
    elif kind == 5 and packets:  # noise beyond its bound
        size = np.sqrt(np.diag(plant.sensor_error.shape_matrix)) + np.abs(packets[0].measurement)
        packets[0] = packets[0]._replace(measurement=packets[0].measurement + 3.0 * size)
    return [packets[index] for index in rng.permutation(len(packets))]


def traffic(plant, channel, rng, steps):
    """Inputs, and the packets that arrive, of a plant that nobody controls; now and then nothing comes for long."""
    state, link, sent = np.zeros(plant.n), ChannelState(channel, rng), []
    silent = 0
    for step in range(1, steps + 1):
        u = rng.uniform(-1.0, 1.0, plant.m) * plant.largest_input
        state = plant.A @ state + plant.B @ u + plant.nominal_disturbance.sample(rng)
        packets = []
        if link.sends_at(step):
            measurement = plant.H @ state + plant.sensor_noise.sample(rng)
            sent.append(Packet(step, channel.quantize(measurement)))
            packets = link.exchange(rng, step, measurement)
        else:
            packets = link.exchange(rng, step, None)
        silent = int(rng.integers(5, 40)) if silent == 0 and rng.random() < 0.02 else max(silent - 1, 0)
        yield u, [] if silent else attacked(rng, packets, sent, step, plant)


def assert_equal(estimator, plain, step):
    arrays.assert_equal(estimator.mean, plain.mean, f"mean at step {step}")
    arrays.assert_equal(estimator.covariance, plain.statistics.covariance, f"covariance at step {step}")
    arrays.assert_equal(estimator.shape, plain.statistics.shape, f"shape at step {step}")
    assert (estimator.age, estimator.alarm) == (plain.age, plain.alarm), step


def compare(plant, channel, error_set, seed, steps):
    """Runs both, the first one twice as a copy of itself; returns the ages and how often the alarm was raised."""
    rng = np.random.default_rng(seed)
    histories = histories_of(plant, channel, error_set)
    one = Estimator(plant, channel, histories=histories)
    other = PlainEstimator(plant, channel, ErrorRecursion(plant, channel.quantization_step, error_set))
    alarms, ages = 0, []
    for episode in range(2):  # the second one finds what the first one left, and packets of the first
        mean = plant.initial_noise.sample(rng)
        one.reset(mean)
        other.reset(mean)
        for step, (u, packets) in enumerate(traffic(plant, channel, rng, steps // (episode + 1)), 1):
            own = [packet._replace(episode=episode) for packet in packets]
            foreign = [each._replace(episode=1 - episode, measurement=each.measurement + 1e-3) for each in own]
            one = copy.deepcopy(one) if step == 17 else pickle.loads(pickle.dumps(one)) if step == 34 else one
            one.advance(u, [*foreign, *own])
            other.advance(u, packets)
            assert_equal(one, other, step)
            ages.append(one.age)
        alarms += one.alarm
    return ages, alarms


STABLE = plants(most_states=4, units=3.0), st.none()
UNSTABLE = plants(most_states=3, radius=(0.9, 1.3), units=1.0), st.integers(0, 6)  # contracts kept and broken


@pytest.mark.cases(1)
@pytest.mark.parametrize("count", [4, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("of", "age"), [STABLE, UNSTABLE], ids=["stable", "unstable"])
def test_estimator_equals_the_plain_one_bit_for_bit(of, age, count):
    @given(plant=of, channel=channels(), age=age, seed=st.integers(0, 2**32 - 1))
    @examples(count, same=count < 100)
    def check(plant, channel, age, seed):
        if age is not None:
            channel = replace(channel, quantization_step=min(channel.quantization_step, 0.05))
        contract = None if age is None else ChannelContract(age, channel.quantization_step)
        try:
            error_set = certified_error_set(plant, contract)
        except ErrorSetError:
            return
        compare(plant, channel, error_set, seed, 60)

    check()


CASES = {
    "overtaking": (truck_trailer(mass=4000.0), Channel(loss=0.2, quantization_step=0.02, delay=1, jitter=4), None),
    "broken": (batch_reactor(), Channel(loss=0.5, jitter=3), ChannelContract(3)),
    "one output": (cart_pole(full_state=False), Channel(loss=0.2, delay=1, jitter=1), ChannelContract(3)),
}


@pytest.mark.cases(1)
@pytest.mark.parametrize("name", CASES)
def test_estimator_equals_the_plain_one_for_long_also_where_it_forgets_in_the_middle_of_an_episode(name, monkeypatch):
    monkeypatch.setattr(arrival_histories, "MAX_HISTORIES", 30)
    forgotten, keeping = [], arrival_histories.ArrivalHistories.keeping

    def counted(graph, histories):
        forgotten.append(len(graph))
        return keeping(graph, histories)

    monkeypatch.setattr(arrival_histories.ArrivalHistories, "keeping", counted)
    plant, channel, contract = CASES[name]
    ages, alarms = compare(plant, channel, certified_error_set(plant, contract), 1, 300)
    assert min(ages) <= channel.delay  # samples are used as soon as they can be
    assert max(ages) > 10
    assert alarms > 0
    assert len(forgotten) >= 5
    assert max(forgotten) < 60
