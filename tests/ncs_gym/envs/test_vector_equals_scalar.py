"""The vector environment equals the scalar one, fed with the same draws; shared graphs and copies change nothing."""

import gc
import weakref

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, GilbertElliott, SetpointTracking, SpeedTracking, cart_pole, truck_trailer
from ncs_gym.estimation import arrival_histories
from ncs_gym.plants.library import batch_reactor
from tests.ncs_gym.envs.same_draws import compare
from tests.plants import random_plant
from tests.product import family_of, library_plant, vector_env

IDS = ("TruckTrailer", "CartPole", "BatchReactor")
BURSTS = GilbertElliott(p_good_to_bad=0.15, p_bad_to_good=0.3, loss_good=0.05, loss_bad=0.9)
CHANNELS = {
    "case study": Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2),
    "overtaking": Channel(loss=0.2, quantization_step=0.02, delay=1, jitter=4),
    "bursts": Channel(loss=BURSTS, jitter=2),
    "rare bursts": Channel(loss=BURSTS, send_period=3, delay=4, quantization_step=0.01),
    "limited losses": Channel(loss=0.6, max_consecutive_losses=2, delay=1),
}
OVERTAKING = {"plant": truck_trailer(mass=4000.0), "channel": CHANNELS["overtaking"], "task": SpeedTracking()}


def make(name, count, **settings):
    return gym.make_vec(f"ncs_gym/{name}-v0", num_envs=count, **settings)


ASKED = Channel(loss=0.6, delay=1, jitter=1, max_consecutive_losses=2, on_request=True)
LATE = Channel(loss=0.5, delay=1, max_consecutive_losses=1)
ENDLESS = {"max_episode_steps": -1, "terminate_on_violation": False}
TRUCK, SPEED = truck_trailer(mass=4000.0), SpeedTracking(change_probability=0.2)
BETWEEN = library_plant(truck_trailer, mass=4000.0, between_samples=8)
FAMILY = family_of([truck_trailer(mass=mass) for mass in (3000.0, 4000.0, 5000.0)])
SETPOINT = SetpointTracking(output=(1.0, 0.5), reach=0.8, width=0.3, change_probability=0.3)


def custom(plant, channel, **settings):
    return lambda: vector_env(2, plant=plant, channel=channel, **settings)


def ending(channel, mode, **settings):
    """Episodes that end at different times, so that some environments send while others do not."""
    settings = {"plant": TRUCK, "max_episode_steps": 13} | settings
    settings |= {"autoreset_mode": mode, "terminate_on_violation": True}
    return lambda: vector_env(3, channel=channel, task=SpeedTracking(), **settings)


def gust(rng, plant, nominal):
    return (1.5 if rng.random() < 0.05 else 0.9) * plant.disturbance.sample_boundary(rng)


ENVIRONMENTS = (
    {name: custom(TRUCK, channel, task=SPEED) for name, channel in CHANNELS.items()}
    | {name: lambda name=name: make(name, 2, **ENDLESS).unwrapped for name in IDS}
    | {
        kind: custom(truck_trailer(), CHANNELS["bursts"], task=SETPOINT, disturbance=kind)
        for kind in ("adversarial", "sinusoid", "sphere", "box")
    }
    | {
        f"family, {mode}": ending(CHANNELS["overtaking"], mode, plant=FAMILY, disturbance="adversarial")
        for mode in ("NextStep", "SameStep")
    }
    | {
        "rare bursts, NextStep": ending(CHANNELS["rare bursts"], "NextStep"),
        "between samples, SameStep": ending(CHANNELS["case study"], "SameStep", plant=BETWEEN),
        "on request, NextStep": ending(ASKED, "NextStep"),
        "on request, SameStep": ending(ASKED, "SameStep", downlink=LATE, contract=ChannelContract(9)),
        "cart-pole, some outputs": custom(
            cart_pole(full_state=False),
            Channel(loss=0.3, delay=1, quantization_step=1e-4),
            contract=ChannelContract(2, 1e-4),
        ),
        "age and error observed": custom(TRUCK, CHANNELS["case study"], observe=("age", "error"), max_episode_steps=31),
        "a broken contract": custom(batch_reactor(), Channel(loss=0.5, jitter=3), contract=ChannelContract(3)),
        "n=5 m=3 p=2": custom(random_plant(6, 5, 3, p=2), Channel(loss=BURSTS, send_period=2)),
        "alarms of Gaussian noise": custom(
            library_plant(truck_trailer, delta=0.9), CHANNELS["overtaking"], noise="gaussian"
        ),
        # A disturbance half as large again as allowed, now and then, which the simulation sees at once.
        "alarms of gusts": custom(
            truck_trailer(),
            Channel(loss=0.2, delay=1, jitter=1),
            disturbance=gust,
            allow_assumption_violation=True,
        ),
    }
)


@pytest.mark.cases(6)
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_equals_scalar_environments_with_the_same_draws(name):
    env = ENVIRONMENTS[name]()
    seen = compare(env, 64)
    assert (seen.alarms > 0) is name.startswith("alarms")
    assert seen.alarms < 2 * 64
    assert seen.broken > 0 or name not in ("cart-pole, some outputs", "a broken contract")
    assert env.episodes.min() >= 4 or not name.endswith(("NextStep", "SameStep"))


def test_a_graph_that_forgets_changes_nothing(monkeypatch):
    monkeypatch.setattr(arrival_histories, "_shared", {})
    monkeypatch.setattr(arrival_histories, "MAX_HISTORIES", 40)
    channel = Channel(loss=0.3, max_consecutive_losses=2, jitter=2)
    env = make("TruckTrailerCruise", 3, channel=channel, max_episode_steps=-1).unwrapped
    before = env._now.estimator.histories
    compare(env, 120)
    assert env._now.estimator.histories is not before
    assert len(env._now.estimator.histories) <= 60


def test_graphs_that_nobody_uses_any_more_are_freed(monkeypatch):
    # The environment for one that a vector environment holds is never stepped: it stays in the first graph.
    monkeypatch.setattr(arrival_histories, "_shared", {})
    monkeypatch.setattr(arrival_histories, "MAX_HISTORIES", 100)
    env, graphs = vector_env(3, **OVERTAKING), weakref.WeakSet()
    env.reset(seed=0)
    for _ in range(250):
        env.step(env.action_space.sample())
        graphs.add(env._now.estimator.histories)
    gc.collect()
    assert len(graphs) <= 3
    assert env.single._now.estimator.histories is not env._now.estimator.histories


def test_graphs_of_many_plants_are_not_kept_for_ever(monkeypatch):
    shared = {}
    monkeypatch.setattr(arrival_histories, "_shared", shared)
    monkeypatch.setattr(arrival_histories, "MAX_GRAPHS", 3)
    plants = [truck_trailer(mass=mass) for mass in (1000.0, 1100.0, 1200.0, 1300.0)]
    graphs = [arrival_histories.arrival_histories(plant, Channel(loss=0.1), None) for plant in plants]
    assert list(shared.values()) == graphs[1:]
    assert arrival_histories.arrival_histories(plants[1], Channel(loss=0.9), None) is graphs[1]
    assert list(shared.values()) == [*graphs[2:], graphs[1]]


def test_a_damaged_measurement_is_not_used_and_harms_no_other():
    env = vector_env(3, plant=truck_trailer(), channel=Channel(jitter=3))
    env.reset(seed=0)
    measure, count = env._now.process.measure, 0

    def damaged(rng, state):
        nonlocal count
        count += 1
        measured = measure(rng, state)
        if count % 5 == 0:
            measured[:, 1] = np.nan
        return measured

    env._now.process.measure = damaged
    for _ in range(60):
        *_, info = env.step(np.zeros((3, 1), np.float32))
        assert np.isfinite(info["estimate"]).all()
    np.testing.assert_array_equal(info["assumption_violated"], [False, True, False])
