"""Estimators that look up arrival histories equal one that works everything out, whatever arrives when."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ncs_gym import (
    Channel,
    ChannelContract,
    ErrorSetError,
    Estimator,
    GilbertElliott,
    Packet,
    batch_reactor,
    cart_pole,
    certified_error_set,
    truck_trailer,
)
from ncs_gym.estimation import arrival_histories
from ncs_gym.estimation.arrival_histories import histories_of
from ncs_gym.estimation.kalman_filter import ErrorRecursion
from ncs_gym.estimation.vector_estimator import VectorEstimator
from ncs_gym.network.packet_loss_and_delay import ChannelState
from tests import arrays
from tests.fuzz import channels, examples, plants
from tests.ncs_gym.estimation.plain_estimator import PlainEstimator
from tests.plants import random_plant

BURSTS = GilbertElliott(p_good_to_bad=0.15, p_bad_to_good=0.3, loss_good=0.05, loss_bad=0.9)


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
        u = rng.uniform(-1.0, 1.0, plant.m) * plant.u_max
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
    estimate = estimator.estimate
    arrays.assert_equal(estimate.mean, plain.mean, f"mean at step {step}")
    arrays.assert_equal(estimate.covariance, plain.statistics.covariance, f"covariance at step {step}")
    arrays.assert_equal(estimate.shape, plain.statistics.shape, f"shape at step {step}")
    assert (estimator.age, estimator.alarm) == (plain.age, plain.alarm), step
    assert estimate.newest == estimator.step - plain.age


def compare(plant, channel, error_set, seed, steps):
    """Runs both; returns the ages and how often the alarm was raised."""
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
            one.advance(u, [*foreign, *own])
            other.advance(u, packets)
            assert_equal(one, other, step)
            ages.append(one.age)
        alarms += one.alarm
    return ages, alarms


STABLE = plants(most_states=4, units=3.0), st.none()
UNSTABLE = plants(most_states=3, radius=(0.9, 1.3), units=1.0), st.integers(0, 6)  # contracts kept and broken


@pytest.mark.parametrize("count", [12, pytest.param(300, marks=pytest.mark.slow)])
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
    "case study": (truck_trailer(), Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2), None),
    "overtaking": (truck_trailer(mass=4000.0), Channel(loss=0.2, quantization_step=0.02, delay=1, jitter=4), None),
    "position only": (truck_trailer(H=[[1.0, 0.0]]), Channel(loss=BURSTS, jitter=3), None),
    "random outputs": (random_plant(6, 5, 3, p=2), Channel(loss=BURSTS, jitter=6), None),
    "cart-pole": (cart_pole(), Channel(loss=0.5, max_consecutive_losses=2, jitter=2), ChannelContract(4)),
    "broken": (batch_reactor(), Channel(loss=0.5, jitter=3), ChannelContract(3)),
    "one output": (cart_pole(full_state=False), Channel(loss=0.2, delay=1, jitter=1), ChannelContract(3)),
    "stable with a contract": (truck_trailer(), Channel(loss=0.4, delay=1, jitter=3), ChannelContract(5)),
}
QUICK = ("overtaking", "broken", "one output")  # the others say the same of other plants and channels
EVERY = [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in CASES]


def test_an_alarm_is_raised_where_the_plain_estimator_raises_it():
    plant, channel, _ = CASES["case study"]
    alarms = [compare(plant, channel, certified_error_set(plant), seed, 25)[1] for seed in range(12)]
    assert 0 < sum(alarms) < 24
    assert 1 in alarms


@pytest.mark.parametrize("name", EVERY)
def test_estimator_equals_the_plain_one_for_long_also_where_it_forgets_in_the_middle_of_an_episode(name, monkeypatch):
    monkeypatch.setattr(arrival_histories, "MAX_HISTORIES", 30)
    forgotten, keeping = [], arrival_histories.ArrivalHistories.keeping

    def counted(graph, histories):
        forgotten.append(len(graph))
        return keeping(graph, histories)

    monkeypatch.setattr(arrival_histories.ArrivalHistories, "keeping", counted)
    plant, channel, contract = CASES[name]
    ages, _ = compare(plant, channel, certified_error_set(plant, contract), 1, 300)
    assert min(ages) <= channel.delay  # samples are used as soon as they can be
    assert max(ages) > 10
    assert len(forgotten) >= 5
    assert max(forgotten) < 60


@pytest.mark.parametrize("name", EVERY)
def test_duplicates_and_packets_from_nowhere_change_nothing(name):
    plant, channel, contract = CASES[name]
    histories, rng = histories_of(plant, channel, certified_error_set(plant, contract)), np.random.default_rng(4)
    one, other = (Estimator(plant, channel, histories=histories) for _ in range(2))
    link, arrived, copies = ChannelState(channel, rng), [], 0
    for step in range(1, 200):
        sample = 1e-3 * rng.standard_normal(plant.p) if link.sends_at(step) else None
        packets = link.exchange(rng, step, sample)
        arrived += packets
        again = [packet for packet in arrived[-12:] if rng.random() < 0.3]
        # What was measured does not matter in a packet that is discarded, unless it comes before the true one.
        again = [packet._replace(measurement=packet.measurement + 9.0) for packet in again]
        strangers = [
            Packet(stamp, np.full(plant.p, 7.0)) for stamp in (-3, 0, step + 1, step - channel.longest_delay - 1)
        ]
        one.advance(np.zeros(plant.m), packets)
        other.advance(np.zeros(plant.m), [*packets, *again, *strangers])
        copies += len(again)
        for value, wanted in zip(other.estimate, one.estimate, strict=True):
            arrays.assert_equal(value, wanted)
        assert (other.age, other.alarm) == (one.age, one.alarm)
    assert copies > 200


@pytest.mark.parametrize("name", EVERY)
def test_a_copy_goes_on_like_the_original(name):
    plant, channel, contract = CASES[name]
    error_set, rng = certified_error_set(plant, contract), np.random.default_rng(2)
    one = Estimator(plant, channel, histories=histories_of(plant, channel, error_set))
    steps = list(traffic(plant, channel, rng, 120))
    for u, packets in steps[:60]:
        one.advance(u, packets)
    copies = [copy.deepcopy(one), pickle.loads(pickle.dumps(one)), pickle.loads(pickle.dumps(copy.deepcopy(one)))]
    for step, (u, packets) in enumerate(steps[60:]):
        for each in (one, *copies):
            each.advance(u, packets)
        for each in copies:
            for value, wanted in zip(each.estimate, one.estimate, strict=True):
                arrays.assert_equal(value, wanted, f"step {step}")
            assert (each.age, each.alarm) == (one.age, one.alarm)


def samples_of(plains, rng, plant, step, channel):
    """Random arrivals for many estimators: which samples of each age arrive, and the newest samples, (p, N)."""
    samples = np.stack([plant.H @ plain.mean for plain in plains], axis=1)
    samples += 0.5 * np.sqrt(np.diag(plant.sensor_error.shape_matrix))[:, None] * rng.uniform(-1.0, 1.0, samples.shape)
    ages = range(channel.longest_delay, channel.delay - 1, -1)
    chance = rng.choice([0.05, 0.3, 0.8])
    return samples, [(age, rng.random(len(plains)) < chance) for age in ages if step > age]


@pytest.mark.parametrize(
    ("name", "most"),
    [
        pytest.param(name, most, marks=[] if (name == "broken") == (most == 40) and name in QUICK else pytest.mark.slow)
        for name in CASES
        for most in (1 << 17, 40)
    ],
)
def test_vector_estimator_equals_the_plain_ones(name, most, monkeypatch):
    monkeypatch.setattr(arrival_histories, "MAX_HISTORIES", most)
    plant, channel, contract = CASES[name]
    error_set, rng, count = certified_error_set(plant, contract), np.random.default_rng(3), 4
    many = VectorEstimator(plant, histories_of(plant, channel, error_set), count)
    recursion = ErrorRecursion(plant, channel.quantization_step, error_set)
    plains = [PlainEstimator(plant, channel, recursion) for _ in range(count)]
    history = []
    for step in range(1, 120):
        if step % 50 == 0:  # some episodes end, others go on
            chosen = rng.random(count) < 0.5
            first = plant.initial_noise.sample(rng, int(chosen.sum())).T
            many.begin(chosen, first)
            for index, mean in zip(np.flatnonzero(chosen), first.T, strict=True):
                plains[index].reset(mean)
        u = rng.uniform(-1.0, 1.0, (plant.m, count)) * 0.1 * plant.u_max[:, None]
        samples, arrivals = samples_of(plains, rng, plant, step, channel)
        silent = step % 40 > 30
        arrivals = [] if silent else arrivals
        history.insert(0, samples)
        # A channel delivers a sample once, and none from before the episode.
        arrivals = [(age, arrives & (age < 1 + np.array([p.step for p in plains]))) for age, arrives in arrivals]
        many.advance(u.copy(), samples, arrivals)
        for index, plain in enumerate(plains):
            packets = [
                Packet(plain.step + 1 - age, history[age][:, index]) for age, arrives in arrivals if arrives[index]
            ]
            plain.advance(u[:, index], packets)
            assert_one_of_many(many, index, plain, step)
    assert (len(many.histories) < 200) or most > 40


def assert_one_of_many(many, index, plain, step):
    statistics = many.histories.table.statistics(many.statistics[index])
    arrays.assert_equal(statistics.shape, plain.statistics.shape, f"step {step}")
    arrays.assert_equal(statistics.covariance, plain.statistics.covariance)
    arrays.assert_equal(many.histories.table.shapes[many.statistics[index]], plain.statistics.shape)
    arrays.assert_close(many.mean[:, index], plain.mean, rtol=1e-10, atol=1e-10)
    assert (many.age[index], many.alarm[index]) == (plain.age, plain.alarm)
