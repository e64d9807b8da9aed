"""What is refused, each in one sentence of a ValueError or TypeError: one row each.

Values of a wrong type or range are refused by the name of their setting (tests/hardening/test_invalid_settings.py).
"""

import json
import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded

from ncs_gym import (
    Actuator,
    AdversarialDisturbance,
    Bounds,
    Box,
    BoxDisturbance,
    Channel,
    ChannelContract,
    Ellipsoid,
    ErrorSetError,
    FunctionProcess,
    Gaussian,
    GymProcess,
    Limits,
    LinearPlant,
    Model,
    NCSEnv,
    NCSVectorEnv,
    RandomChannel,
    RequestActions,
    SetpointTracking,
    TraceChannel,
    UnstablePlantError,
    VectorRandomChannel,
    VectorRequestActions,
    cart_pole,
    exact,
    linear_model,
    register_plant,
    truck_trailer,
)
from ncs_gym.bounds import as_set
from ncs_gym.disturbances import as_disturbance, checked
from ncs_gym.envs.env import RenderModeError, ncs_env
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.model import zero_order_hold
from ncs_gym.network.downlink import Command
from ncs_gym.network.gaussian_bound import bound_violation_probability
from ncs_gym.plants.family import Remainder
from ncs_gym.plants.library import batch_reactor
from ncs_gym.processes.cart_pole_process import CartPoleProcess
from ncs_gym.processes.gym_pendulum import PendulumProcess, pendulum
from ncs_gym.processes.mujoco_pendulum import InvertedPendulumProcess
from ncs_gym.processes.process import LinearProcess
from tests.product import altered, linear_plant

TRUCK, POLE, LINEAR = "ncs_gym/TruckTrailer-v0", "ncs_gym/CartPole-v0", "ncs_gym/LinearNCS-v0"
PLANT, HEAVY, UNSTABLE = truck_trailer(), truck_trailer(mass=4000.0), cart_pole()
GRID = replace(HEAVY, limits=replace(HEAVY.limits, between_samples=8))
QUIET = {"disturbance_bound": 0.01, "sensor_bound": 0.01, "initial_bound": 0.01}
GOOD = {"A": np.eye(2) * 0.5, "B": np.ones((2, 1)), "box": np.eye(2), "u_max": 1.0, "dt": 0.1} | QUIET
ROOM_MODEL = Model([[0.9]], [[0.2]], None, 60.0, ([20.0], [10.0]))
ROOM_LIMITS = Limits(state=(18.0, 25.0), input=(0.0, 12.0))
SETS = "disturbance", "sensor", "first_error"
BOUNDS, PLAIN = Bounds(0.01, 0.01, 0.01), Model(0.5 * np.eye(2), np.ones((2, 1)), None, 0.1)
A, B, C, D = np.array([[0.0, 1.0], [-2.0, -3.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), np.zeros((1, 1))
MODEL, SAMPLED = (A, B, C, D), Model.sampled(A, B, C, 0.1)
ON_REQUEST = Channel(0.5, delay=1, jitter=1, max_consecutive_losses=2, quantization_step=1e-4, on_request=True)
ASKED = {"channel": ON_REQUEST, "contract": ChannelContract(9, 1e-4), "terminate_on_violation": False}
STEP, TORQUE = 0.05, 2.0
SLOPES = (
    [[1.0 + STEP**2 * 15.0 * np.cos(0.25), STEP, 0.0075], [STEP * 15.0 * np.cos(0.25), 1.0, 0.15]],
    [[1.0 + STEP**2 * 15.0, STEP, 0.0075], [STEP * 15.0, 1.0, 0.15]],
)
COMMAND = Command(stamp=0, inputs=np.array([[1.0], [2.0], [3.0]]))


def changed(make, *rows, **settings):
    """Calls with arguments that replace good ones."""
    return [partial(make, **(settings | change)) for change in rows]


def wrong(make, values, **settings):
    """Calls with one wrong value each, by the name of the setting."""
    return [partial(make, **(settings | {name: value})) for name, given in values.items() for value in given]


def called(make, *arguments):
    """Calls with a single argument."""
    return [partial(make, argument) for argument in arguments]


def swing(state, u):
    """One step of `Pendulum-v1`."""
    rate = state[1] + STEP * (15.0 * np.sin(state[0]) + 3.0 * u[0])
    return np.array([state[0] + STEP * rate, rate])


def noisy(state, u, rng=np.random.default_rng(0)):  # noqa: B008
    return swing(state, u) + 1e-4 * rng.uniform(-1.0, 1.0, np.shape(state))


def kinked_late():
    """A process with a kink that the first samples miss."""
    calls = []

    def step(state, u):
        calls.append(0)
        return swing(state, u) + (1e-3 if len(calls) > 500 else 0.0)

    return step


def modeled(process=swing, state=(0.25, 1.5), **settings):
    limits, nothing = Limits(list(state), TORQUE), Bounds(0.0, 0.0, 0.0)
    return linear_model(process, limits, nothing, STEP, **{"samples": 500} | settings)


class Inner(gym.Env):
    """A Gymnasium environment with two states."""

    observation_space, action_space = spaces.Box(-np.inf, np.inf, (2,)), spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        self.state = np.zeros(2)
        return self.state, {}


ONE = Inner()


class Counted(Inner):
    action_space = spaces.Discrete(2)


class Wide(Inner):
    action_space = spaces.Box(-1.0, 1.0, (3,))


def write(env, state):
    env.state = state


def nonlinear_pole():
    return gym.make("ncs_gym/CartPoleNonlinear-v0").unwrapped.plant


def inner(read=lambda env: env.state, kind=Inner, **settings):
    return GymProcess(kind, read_state=read, write_state=write, **settings)


def reset(env, **settings):
    env.reset(seed=0, **settings)
    return env


def moved(process):
    return reset(NCSEnv(linear_plant(**GOOD), process=process)).step(np.zeros(1))


def plant_in(text):
    """Loads a plant from a file with a text; from one that is missing for None."""

    def load(folder):
        path = folder / "plant.json"
        if text is not None:
            path.write_bytes(text if isinstance(text, bytes) else text.encode())
        LinearPlant.load(path)

    return load


def plant_with(change):
    """Loads a plant from its file, changed."""

    def load(folder):
        PLANT.save(folder / "plant.json")
        document = json.loads((folder / "plant.json").read_text())
        change(document)
        plant_in(json.dumps(document))(folder)

    return load


def folder_for_a_file(folder):
    (folder / "plant.json").mkdir()
    plant_in(None)(folder)


def weakened_remainder():
    return altered(modeled(), remainder=Remainder(Ellipsoid(1e-4 * np.eye(2)), False, "an example"))


BOTH = {"channel": Channel(on_request=True), "downlink": Channel(on_request=True)}
ENVIRONMENTS = [
    *wrong(
        partial(gym.make, TRUCK),
        {
            "plant": ["nowhere.json", linear_plant(**GOOD | {"A": 1.1 * np.eye(2)})],
            "task": [{}, {"fastest": 1.0, "reach": 1.0}],
            "initial_set": [np.eye(2), {"radius": 1.0}],
            "disturbance": ["storm", {"M": 1.0}],
            "channel": [{"los": 0.1}, {"loss": {"p": 0.1}}, {"loss": 2.0}],
            "contract": [{}],
            "observe": ["speed", ["age", "age"], [1]],
            "process": [{"pole_mass": 0.1}],
        },
    ),
    partial(gym.make, "ncs_gym/Pendulum-v0", process={"mess": 2.0}),
    partial(gym.make, LINEAR),
    partial(gym.make_vec, LINEAR, num_envs=3),
    partial(gym.make, "ncs_gym/CSTR-v0", between_samples=65),
    partial(gym.make_vec, TRUCK, num_envs=2, render_mode="rgb_array"),
    *wrong(
        partial(NCSEnv, HEAVY),
        {
            "downlink": [Channel(quantization_step=0.1), Channel(send_period=2), 0.3],
            "downlink_contract": [ChannelContract(2)],
            "process": ["swing", np.add],
        },
    ),
    *changed(
        partial(NCSEnv, HEAVY),
        {"downlink": Channel(delay=3), "downlink_contract": ChannelContract(2)},
        {"downlink": Channel(), "downlink_contract": 2},
        {"downlink": Channel(delay=900), "contract": ChannelContract(200)},
        BOTH,
    ),
    partial(NCSEnv, UNSTABLE, Channel(), contract=4),
    partial(NCSEnv, UNSTABLE, Channel(quantization_step=0.1), contract=ChannelContract(4, 0.01)),
    partial(NCSEnv, linear_plant(**GOOD), noise="gaussian"),
    lambda: ncs_env(gym.make("CartPole-v1")),
    lambda: gym.make_vec(TRUCK, num_envs=3).reset(seed=[1, 2]),
    *wrong(partial(register_plant, "Plants/T-v0", PLANT), {"channel": [{"loss": 2.0}], "max_episode_steps": [0]}),
    partial(register_plant, TRUCK, PLANT),
    partial(NCSEnv, PLANT, task=SetpointTracking(output=[1.0, 0.0], reach=0.9, width=2.0)),
]
REQUESTS = [
    lambda: Channel(on_request=True, send_period=2),
    lambda: NCSEnv(UNSTABLE, Channel(0.1, on_request=True), contract=ChannelContract(9)),
    lambda: NCSEnv(UNSTABLE, Channel()).request(),
    lambda: NCSEnv(UNSTABLE, **ASKED).request("yes"),
    lambda: NCSVectorEnv(3, plant=UNSTABLE, **ASKED).request([True]),
    lambda: NCSEnv(UNSTABLE, **ASKED).reset(options={"channel": Channel()}),
    lambda: NCSEnv(PLANT).reset(options={"channel": Channel(on_request=True)}),
    lambda: NCSVectorEnv(2, plant=PLANT, channel=[Channel(), Channel()]),
    lambda: RequestActions(gym.make(POLE)),
    lambda: RequestActions(gym.make("CartPole-v1")),
    lambda: RequestActions(gym.make(POLE, **ASKED), -1.0),
    lambda: VectorRequestActions(gym.make_vec(POLE, num_envs=2, autoreset_mode="SameStep", **ASKED)),
    lambda: RequestActions(gym.make(POLE, **ASKED)).step(np.array([0.0, np.nan])),
    lambda: RequestActions(gym.make(POLE, **ASKED)).step(np.zeros(1)),
]
CHANNELS = [
    lambda: Channel(delay=(1, 2)),
    lambda: NCSEnv(HEAVY, downlink=Channel(delay=2)).reset(options={"downlink": Channel(delay=3)}),
    lambda: RandomChannel(NCSEnv(HEAVY)),
    lambda: VectorRandomChannel(NCSVectorEnv(2, plant=HEAVY), 0.3),
    lambda: RandomChannel(NCSEnv(HEAVY), lambda rng: 0.3).reset(),
    lambda: TraceChannel(trace=(0, -1), loss=0.1),
    TraceChannel,
    lambda: Actuator(input_delay=2, inputs=1).start(episode=0.5),
    *called(Actuator(input_delay=2, inputs=1).apply, 600.5, -1),
]
EXAMPLE = Remainder(Ellipsoid(np.eye(3)), True, "an example")


def plant_of(model=ROOM_MODEL, limits=ROOM_LIMITS, bounds=BOUNDS, labels=None):
    return LinearPlant(model, limits, bounds, labels)


def with_limits(model, bounds=BOUNDS):
    """Makes plants of limits given by their names."""
    return lambda **limits: LinearPlant(model, Limits(**limits), bounds)


PLANTS = [
    *wrong(
        Model,
        {
            "H": [[[0.0, 0.0]], [[1.0]]],
            "at": [([1.0], 0.0), ([1.0, 2.0], "10"), 3.0, [0.5, 0.0]],
            "offset": [[1.0], [1.0, 2.0]],
            "continuous": [[[-2.0, 1.0]]],
            "delays": [-1, 1.5, 101, [1, 2]],
        },
        A=0.5 * np.eye(2),
        B=np.ones((2, 1)),
        H=None,
        dt=0.1,
    ),
    *wrong(plant_of, {"model": [3, None], "limits": [3], "bounds": [0.1]}),
    *wrong(plant_of, {"labels": [{"angle": "rad"}, {"states": ["room"]}]}),
    *wrong(
        with_limits(PLAIN),
        {
            "state": [[np.inf] * 2, ([-1.0, -2.0], [-0.5, 2.0]), [1.0], [-1.0, 2.0]],
            "input": [(-1.0, np.inf), (0.0, 1.0), np.inf, None],
            "rows": [
                3,
                [([1.0, 0.0], -1.0, 1.0)],
                [([0.0, 0.0], None, -1.0, 1.0)],
                [([1.0], None, -1.0, 1.0)],
                [([1.0, 0.0], [0.0], -1.0, 1.0)],
                [([1.0, 0.0], None, 0.5, 1.0)],
            ],
            "rate": [2.0],
            "between_samples": [0, 65, 2.5, True, 8],
        },
        state=[1.0, 2.0],
        input=1.0,
    ),
    *wrong(
        with_limits(ROOM_MODEL),
        {
            "state": [(20.0, 25.0), 25.0, ([1.0, 2.0], 30.0), (np.nan, 30.0), (np.inf, -np.inf), (25.0, 18.0)],
            "input": [(0.0, 9.0), (-np.inf, np.inf), 1.0],
        },
        state=(18.0, 25.0),
        input=(0.0, 12.0),
    ),
    *(partial(plant_of, bounds=Bounds(**dict.fromkeys(SETS, 0.01) | {name: [0.1, 0.2]})) for name in SETS),
    lambda: plant_of(bounds=Bounds(EXAMPLE, 0.1, 0.1)),
    lambda: plant_of(bounds=Bounds(Gaussian([[1.0]], 0.1), Gaussian([[1.0]], 0.2), 0.0)),
    lambda: plant_of(bounds=Bounds(Box(0.0, 0.1) + Box(-0.1, 0.1), 0.0, 0.0)),
    lambda: plant_of(PLAIN.with_delays([[1], [0]]), Limits(1.0, 1.0, [([1.0, 0.0], [2.0], -1.0, 1.0)])),
    lambda: PLAIN.with_delays(outputs=0.5),
    lambda: PLAIN.held(np.eye(2)),
    lambda: Model.sampled(A, B, [[1.0]], 0.1),
    lambda: plant_of(bounds=Bounds(0.1, 0.1, Remainder(Ellipsoid(np.eye(1)), True, "an example"))),
    *wrong(truck_trailer, {"mass": [0.0], "stiffness": [-1.0], "damping": [-1.0], "dt": [0.0]}),
    lambda: replace(PLANT, limits=Limits([2.0, np.inf], 4.0, between_samples=8)),
    lambda: Model(0.9, 0.2, None, 60.0),
    lambda: plant_of(Model([[0.9]], [[0.2]], None, 60.0, ([19.0], [10.0]), [0.0])),
    lambda: plant_of(Model([[1.0]], [[0.2]], None, 60.0, ([20.0], [10.0]), [0.0])),
    *(
        partial(linear_model, np.add, limits, BOUNDS, 1.0)
        for limits in (3, Limits((-1.0, np.inf), 1.0), Limits(input=1.0), Limits((-1.0, 1.0), (0.0, 8.0)))
    ),
    *called(Model.of, MODEL, SimpleNamespace(num=[1.0]), (A, B, C, np.ones((1, 1)), 0.1), (A, B, np.eye(3), D, 0.1)),
    partial(Model.of, (*MODEL, 0.1), 0.2),
    lambda: plant_of(SAMPLED.with_delays(1), Limits([1.0, 2.0], 3.0, between_samples=8)),
    lambda: plant_of(replace(SAMPLED, A=1.001 * SAMPLED.A), Limits([1.0, 2.0], 3.0)),
    lambda: plant_of(replace(SAMPLED, continuous=None), Limits([1.0, 2.0], 3.0, between_samples=8)),
    lambda: plant_of(Model(SAMPLED.A, 0.0 * SAMPLED.B, None, 0.1), Limits(input=1.0)),  # how large do the states get?
    lambda: replace(nonlinear_pole(), limits=replace(nonlinear_pole().limits, between_samples=8)),
    *(partial(zero_order_hold, np.array([[size]]), np.array([[1.0]]), 1.0) for size in (1e3, 1e13, 1e20)),
    plant_in(None),
    folder_for_a_file,
    *map(plant_in, ("{", b"\xff\xfe", "[" * 100_000, "[]", '{"format": "ncs-gym plant 2", "model": 3}')),
    *map(
        plant_with,
        (
            lambda plant: plant["model"].pop("A"),
            lambda plant: plant["model"].update(mass=3),
            lambda plant: plant.pop("limits"),
            lambda plant: plant["bounds"].update(sensor={"radius": 1}),
            lambda plant: plant["bounds"].update(sensor={"Ellipsoid": {"shape_matrix": [[-1]]}}),
        ),
    ),
]
PROCESSES = [
    partial(GymProcess, Inner, read_state=3),
    partial(FunctionProcess, 3),
    partial(CartPoleProcess, pole_mass=-1.0),
    partial(InvertedPendulumProcess, mass_factor=0.0),
    partial(PendulumProcess, mass=0.0),
    *wrong(
        partial(NCSEnv, linear_plant(**GOOD)),
        {"process": [inner(kind=Counted), inner(kind=Wide), inner(kind=lambda: 3)]},
    ),
    partial(
        NCSEnv,
        linear_plant(**GOOD),
        process=GymProcess(Inner, lambda env: env.state),
        disturbance=lambda rng, plant, x: 0.0 * x,
    ),
    lambda: NCSEnv(linear_plant(**GOOD | {"u_max": 1.5}), process=inner()),
    lambda: reset(
        NCSEnv(linear_plant(**GOOD), process=GymProcess(Inner, read_state=lambda env: env.state)),
        options={"state": [0.0, 0.0]},
    ),
    lambda: NCSVectorEnv(2, plant=linear_plant(**GOOD), process=inner(kind=lambda: ONE)),
    *called(
        lambda read: moved(inner(read)),
        lambda env: env.position,
        lambda env: [1.0, 2.0, 3.0],
        lambda env: [1.0, np.nan],
        lambda env: env.state + 1.0,
    ),
    *called(lambda value: moved(FunctionProcess(lambda x, u: value)), np.ones(3), [1.0, np.inf], "x"),
    lambda: gym.make(LINEAR, plant=GRID, process=FunctionProcess(lambda x, u: GRID.A @ x + GRID.B @ u)),
    partial(Remainder, 0.1, True, "an example"),
    partial(Remainder, Ellipsoid(np.eye(2)), "yes", "an example"),
    *changed(
        modeled,
        {"process": lambda x, u: swing(x, u) + 3.0 * np.abs(x)},
        {"process": kinked_late()},
        {"process": LinearProcess()},
        {"process": 3},
        {"process": GymProcess(lambda: gym.make("Pendulum-v1"), lambda env: env.unwrapped.state)},
        {"process": GymProcess(lambda: gym.make("CartPole-v1"), lambda env: np.zeros(2))},
        {"state": [1.0, 1.0, 1.0]},
        {"samples": 5},
        {"safety_factor": 0.9},
        {"matrices": (np.eye(2), np.ones((3, 1)))},
        {"jacobian_bounds": SLOPES, "matrices": (np.eye(2), np.ones((2, 1)))},
        {"jacobian_bounds": SLOPES[::-1]},
        {"jacobian_bounds": 3},
        {"jacobian_bounds": (SLOPES[1], SLOPES[1])},
        *({"jacobian_bounds": SLOPES, "process": FunctionProcess(noisy, each)} for each in (False, True)),
    ),
    partial(pendulum, mass=0.04),
    lambda: replace(pendulum(), limits=Limits([3.0, 3.0], TORQUE)),
    *(
        lambda change=change: altered(modeled(), **change)
        for change in (
            {"box": [1.0, 1.0]},
            {"box": [0.2, 1.5]},
            {"u_max": 3.0},
            {"A": np.eye(2)},
            {"B": [[0.0], [0.1]]},
            {"dt": 0.1, "u_max": 3.0},
        )
    ),
    lambda: linear_plant(**GOOD | {"box": [0.25, 1.5], "u_max": TORQUE, "dt": STEP, "remainder": modeled().remainder}),
    lambda: altered(modeled(), remainder=altered(weakened_remainder(), box=[0.2, 1.5]).remainder),
]
UNCERTAINTY = [
    *called(lambda value: as_set(value).sized(2), [0.1, -0.2], 1e-200, 1e60, True, {"Ball": {}}),
    *called(
        lambda value: as_disturbance(value, PLANT, False),
        *("gusts", 3, BoxDisturbance([0.1, 0.1]), BoxDisturbance([0.1, 0.1, 0.1])),
        *(AdversarialDisturbance(np.eye(3)), AdversarialDisturbance(rows=np.ones((1, 3)))),
    ),
    *called(lambda d: checked(PLANT, d, allow_assumption_violation=True), [np.nan, 0.0], [0.0]),
    lambda: as_disturbance(
        BoxDisturbance([0.051, 0.00204]), altered(PLANT, gamma=0.0, disturbance_bound=[0.05, 0.002]), False
    ),
    *called(partial(bound_violation_probability, PLANT, Channel()), -1, 1.5),
    partial(bound_violation_probability, Channel(), PLANT, 1),
    lambda: Estimator(
        batch_reactor(), Channel(quantization_step=0.05), certified_error_set(batch_reactor(), ChannelContract(2))
    ),
]
OTHER_ERRORS = [
    (partial(NCSEnv, PLANT, render_mode="ansi"), RenderModeError),
    (partial(NCSEnv, UNSTABLE, Channel(loss=0.1)), UnstablePlantError),
    (partial(register_plant, "Plants/Pole-v0", UNSTABLE, channel=Channel(loss=0.1)), UnstablePlantError),
    (partial(certified_error_set, UNSTABLE), UnstablePlantError),
    (lambda: NCSEnv(PLANT).step(np.zeros(1)), ResetNeeded),
    (lambda: NCSVectorEnv(2, plant=PLANT).step(np.zeros((2, 1))), ResetNeeded),
    (lambda: NCSVectorEnv(2, plant=PLANT).reset(options={"reset_mask": np.array([True, False])}), ResetNeeded),
    (lambda: NCSEnv(PLANT, render_mode="rgb_array").render(), ResetNeeded),
    (partial(register_plant, "Plants/T-v0", PLANT, chanel=Channel()), TypeError),
    (partial(exact.inverse, np.ones((2, 2))), ZeroDivisionError),
    (partial(certified_error_set, batch_reactor(), ChannelContract(1000)), ErrorSetError),
]
CALLS = [
    lambda: reset(NCSVectorEnv(3, plant=PLANT)).step(np.zeros((3, 2))),
    *called(
        lambda mask: reset(NCSVectorEnv(3, plant=PLANT)).reset(options={"reset_mask": mask}),
        *(np.ones(2, np.bool_), np.ones(3), np.zeros(3, np.bool_)),
    ),
]
VALUE_ERRORS = [*ENVIRONMENTS, *REQUESTS, *CHANNELS, *PLANTS, *PROCESSES, *UNCERTAINTY, *CALLS]
ROWS = [*((call, ValueError) for call in VALUE_ERRORS), *OTHER_ERRORS]


@pytest.mark.parametrize(("call", "error"), ROWS)
def test_what_makes_no_sense_is_refused_in_one_sentence(call, error, tmp_path):
    before = set(gym.registry)
    with pytest.raises(error) as caught:
        call(tmp_path) if getattr(call, "__name__", "") in ("load", "folder_for_a_file") else call()
    said = re.sub(r"\. Did you mean '\w+'\?$", "", str(caught.value))  # Python's own, from 3.13 on
    assert not re.search(r"\n|[.!?] [A-Z]", said)
    assert set(gym.registry) == before


NO_COMMANDS = [
    *(COMMAND, None, 5, [COMMAND._replace(stamp=1), None], [COMMAND._replace(stamp=1.5)], [(1,)]),
    *([COMMAND._replace(stamp=1, episode="0")], [COMMAND._replace(stamp=1, inputs=np.zeros((2, 1)))]),
    [COMMAND._replace(stamp=1, inputs=np.array([[1.0], [np.nan], [3.0]]))],
]


@pytest.mark.parametrize("commands", NO_COMMANDS)
def test_what_is_no_command_is_refused_and_leaves_those_that_an_actuator_holds(commands):
    actuator = Actuator(input_delay=2, inputs=1)
    actuator.receive([COMMAND])
    with pytest.raises(ValueError, match="command"):
        actuator.receive(commands)
    np.testing.assert_array_equal(actuator.apply(2), [3.0])
    np.testing.assert_array_equal(actuator.apply(3), [0.0])
    assert actuator.missing
