"""Threads share certificates, filters, planners and graphs of histories: each gets what it would get alone."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from threading import Barrier
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, Estimator, Packet, batch_reactor, truck_trailer
from ncs_gym.estimation.arrival_histories import MAX_GRAPHS, arrival_histories, histories_of
from ncs_gym.estimation.error_bound import certified_error_set
from shields import SafeLoop, SafetyFilter, SafetyShield, VectorSafetyShield
from shields.packaged_certificates import certificate_for
from shields.runtime.backup_plans import PlanTest, Prediction
from shields.runtime.backup_plans.plan_search import PlanProgram
from shields.runtime.set_test import ellipsoid_test
from tests.certificates import certificate_of

THREADS = 8


@pytest.fixture(autouse=True)
def _threads_change_often() -> Iterator[None]:
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


def change(frame: Any, *_: Any) -> Any:
    """A trace function of which nothing is asked: threads may change where it is called, at every line of ours."""
    return change if frame.f_globals.get("__name__", "").startswith(("ncs_gym.", "shields.")) else None


def at_once(work: Callable[[int], Any]) -> list[Any]:
    """What the function returns for 0..7, called by a thread each that begins with the others."""
    barrier = Barrier(THREADS)

    def begin(number: int) -> Any:
        barrier.wait()
        sys.settrace(change)
        try:
            return work(number)
        finally:
            sys.settrace(None)

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(begin, range(THREADS)))


def assert_same(one: Any, other: Any) -> None:
    for each, expected in zip(one, other, strict=True):
        np.testing.assert_array_equal(each, expected)


def reactor() -> tuple[Any, Any]:
    plant = batch_reactor()
    return certificate_of(plant, ChannelContract(2)), plant


def shapes_of(certificate: Any, seed: int, count: int) -> np.ndarray:
    factors = np.random.default_rng(seed).uniform(0.01, 1.0, count)
    return factors[:, None, None] * certificate.error_shapes[0]


def test_what_is_remembered_of_error_shapes_is_what_a_fresh_filter_says():
    shared, fresh = (SafetyFilter(*reactor(), mode="lookahead", horizon=3) for _ in range(2))
    # As many as all threads together may not remember, and some that all of them ask for.
    own = [np.concatenate([shapes_of(shared.certificate, seed, 520), common]) for seed in range(THREADS)
           for common in [shapes_of(shared.certificate, THREADS, 40)]]  # fmt: skip

    def ask(number: int) -> list[Any]:
        parts = [*np.split(own[number], 10), *own[number][::20, None]]
        found = [shared.lookahead.planner.test.tightenings_of(part) for part in parts]
        known = [shared.errors_of(shape) for shape in own[number][::20]]
        return [np.concatenate(each) for each in zip(*found, strict=True)], known

    answers = at_once(ask)
    for number, (found, known) in zip((*range(THREADS), 0, 7), (*answers, ask(0), ask(7)), strict=True):
        shapes = own[number]
        expected = fresh.lookahead.planner.test.tightenings_of(np.concatenate([shapes, shapes[::20]]))
        assert_same(found, expected)
        for shape, each in zip(shapes[::20], known, strict=True):
            assert_same(each, fresh.errors_of(shape))


def test_what_is_remembered_cannot_be_written_into():
    shield = SafetyFilter(*reactor())
    for array in shield.errors_of(shield.certificate.error_shapes[0]):
        if isinstance(array, np.ndarray):
            assert not array.flags.writeable


def test_solutions_of_a_program_are_those_of_a_fresh_one():
    certificate, plant = reactor()
    prediction = Prediction(ellipsoid_test(certificate.L, plant), 3)
    test, shared, fresh = PlanTest(prediction, 1e-9), PlanProgram(prediction), PlanProgram(prediction)
    rng, count = np.random.default_rng(0), 40
    problems = []
    for number in range(THREADS):
        estimates = 0.7 * plant.half_widths * rng.uniform(-1.0, 1.0, (count, plant.n))
        tightening = test.tightenings_of(shapes_of(certificate, number, count))
        row_limits, radius = test.limits_at(estimates, tightening)
        proposed = plant.u_max * rng.uniform(-1.0, 1.0, (count, plant.m))
        last = tightening.weighting[:, -1], radius[:, -1], tightening.between
        problems.append(list(zip(estimates, row_limits, *last, proposed, strict=True)))
    answers = at_once(lambda number: [shared.solve(*each) for each in problems[number]])
    for number, answer in enumerate(answers):
        alone = [fresh.solve(*each) for each in problems[number]]
        assert [each is None for each in answer] == [each is None for each in alone]
        assert_same(*([each for each in some if each is not None] for some in (answer, alone)))
        assert sum(each is not None for each in alone) > 10


@pytest.mark.slow
def test_plans_of_the_solver_are_those_of_a_fresh_filter():
    shared, fresh = (SafetyFilter(*reactor(), mode="lookahead", horizon=3) for _ in range(2))
    certificate, plant = shared.certificate, shared.plant
    rng = np.random.default_rng(0)
    estimates = plant.half_widths * rng.uniform(-1.0, 1.0, (THREADS, 60, plant.n))
    proposed = plant.u_max * rng.uniform(-1.0, 1.0, (THREADS, 60, plant.m))
    shapes = np.array([shapes_of(certificate, seed, 60) for seed in range(THREADS)])

    def decide(shield: SafetyFilter, number: int) -> list[np.ndarray]:
        rows = zip(estimates[number], shapes[number], proposed[number], strict=True)
        return [array for row in rows for array in shield.decide(*row)[:2]]

    answers = at_once(lambda number: decide(shared, number))
    planned = 0
    for number, answer in enumerate(answers):
        assert_same(answer, decide(fresh, number))
        planned += sum(
            fresh.decide(*row).reason == "planned"
            for row in zip(estimates[number], shapes[number], proposed[number], strict=True)
        )
    assert planned > 20


def followed(loop: SafeLoop, seed: int, steps: int = 60) -> list[Any]:
    """What a loop decides and says about a plant of its own with a lossy channel."""
    plant, rng = loop.filter.plant, np.random.default_rng(seed)
    x, said = np.zeros(plant.n), []
    loop.start(x)
    for step in range(steps):
        arrives = step and rng.random() > 0.3
        loop.receive([Packet(step, plant.H @ x, loop.episode)] if arrives else [])
        u = loop.decide(plant.u_max * rng.choice([-1.0, 1.0], plant.m)).input
        said += [loop.estimate, loop.error_shape, u, loop.guaranteed, loop.plan_length]
        x = plant.A @ x + plant.B @ u
    return said


@pytest.mark.cases(1)
@pytest.mark.parametrize("mode", ["project", "lookahead"])
def test_deep_copied_loops_in_threads_decide_as_alone(mode):
    certificate, plant = certificate_for(truck_trailer(mass=4000.0)), truck_trailer(mass=4000.0)
    loop = SafeLoop(certificate, plant, Channel(delay=1), mode, on_unproved="ignore")
    loops = [deepcopy(loop) for _ in range(THREADS)]
    answers = at_once(lambda number: followed(loops[number], number))
    forget_graphs(plant)
    for number, answer in enumerate(answers):
        alone = SafeLoop(certificate, plant, Channel(delay=1), mode, on_unproved="ignore")
        assert_same(answer, followed(alone, number))


def forget_graphs(plant: Any) -> None:
    """Lets this process forget what it worked out of histories, but for what is in use."""
    for delay in range(10, 10 + MAX_GRAPHS):
        arrival_histories(plant, Channel(delay=delay), None)


def test_estimators_in_threads_say_what_they_say_alone_and_fill_one_graph_as_alone():
    plant, channel, rounds = truck_trailer(mass=4000.0), Channel(delay=2, jitter=1), 40
    error_set = certified_error_set(plant, None)

    def run(histories: Any, number: int) -> list[np.ndarray]:
        estimator, rng, said = Estimator(plant, channel, histories=histories), np.random.default_rng(number), []
        for _ in range(4):
            estimator.reset(np.zeros(plant.n))
            for _ in range(rounds):
                stamps = estimator.step + 1 - np.flatnonzero(rng.random(4) < 0.4)
                packets = [Packet(int(s), rng.uniform(-0.01, 0.01, plant.p), estimator.episode) for s in stamps]
                estimator.advance(rng.uniform(-0.01, 0.01, plant.m), packets)
                said += [estimator.mean, *estimator.predicted([np.zeros(plant.m)] * 2)]
        return said

    shared, fresh = (histories_of(plant, channel, error_set) for _ in range(2))
    answers = at_once(lambda number: run(shared, number))
    for number, answer in enumerate(answers):
        assert_same(answer, run(fresh, number))
    assert len(shared) == len(fresh)
    tables = (np.unique(each.table.shapes.reshape(len(each.table), -1), axis=0) for each in (shared, fresh))
    np.testing.assert_array_equal(*tables)


def test_graphs_are_made_and_forgotten_by_threads_without_a_failure():
    plant = truck_trailer(mass=4000.0)

    def ask(number: int) -> list[int]:
        asked = np.random.default_rng(number).integers(0, 2 * MAX_GRAPHS, 40)
        return [arrival_histories(plant, Channel(delay=int(d)), None).buffer - int(d) for d in asked]

    assert not np.any(at_once(ask))


def episodes(env: Any, seed: int) -> list[np.ndarray]:
    """What a shielded environment, or a vector of them, says of itself in two episodes."""
    rng, said = np.random.default_rng(seed), []
    for episode in range(2):
        observation, info = env.reset(seed=seed + episode)
        for _ in range(30):
            said += [observation, info["state"], info["estimate"], info["input_proposed"], info["shield_guaranteed"]]
            observation, *_, info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32))
    return said


@pytest.mark.cases(1)
@pytest.mark.parametrize("mode", ["project", "lookahead"])
def test_environments_in_threads_go_as_alone(mode):
    name = "ncs_gym/TruckTrailerCruise-v0"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        single = SafetyShield(gym.make(name), mode=mode)
        many = VectorSafetyShield(gym.make_vec(name, num_envs=5), mode=mode)
    envs = [deepcopy(single if number % 2 else many) for number in range(THREADS)]
    answers = at_once(lambda number: episodes(envs[number], number))
    forget_graphs(single.unwrapped.plant)
    filter_of_its_own = {"certificate": single.certificate, "mode": mode}
    for number, answer in enumerate(answers):
        if number % 2:
            alone = SafetyShield(gym.make(name), **filter_of_its_own)
        else:
            alone = VectorSafetyShield(gym.make_vec(name, num_envs=5), **filter_of_its_own)
        assert_same(answer, episodes(alone, number))
