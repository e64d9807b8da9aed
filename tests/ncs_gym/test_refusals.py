"""What is refused, by which error, and the words that a user needs to put it right: one row each.

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
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete

from ncs_gym import (
    Actuator,
    AdversarialDisturbance,
    BoxDisturbance,
    Channel,
    ChannelContract,
    Command,
    Ellipsoid,
    ErrorSetError,
    Estimator,
    FunctionProcess,
    GymProcess,
    LinearPlant,
    LinearProcess,
    NCSEnv,
    NCSVectorEnv,
    RandomChannel,
    Regulation,
    Remainder,
    RequestActions,
    SetpointTracking,
    SpeedTracking,
    TraceChannel,
    UnstablePlantError,
    VectorRandomChannel,
    VectorRequestActions,
    batch_reactor,
    bound_violation_probability,
    cart_pole,
    certified_error_set,
    exact,
    linear_model,
    register_plant,
    truck_trailer,
)
from ncs_gym.envs.env import RenderModeError, ncs_env
from ncs_gym.plants.statespace import zero_order_hold
from ncs_gym.processes import CartPoleProcess, InvertedPendulumProcess, PendulumProcess, pendulum
from ncs_gym.uncertainty.declared_bound import as_bound
from ncs_gym.uncertainty.disturbances import as_disturbance, checked
from ncs_gym.validation import reason_of
from shields import SafetyShield
from tests.fuzz import NOTHING_USABLE, WRONG_NUMBERS

TRUCK, POLE, LINEAR = "ncs_gym/TruckTrailer-v0", "ncs_gym/CartPole-v0", "ncs_gym/LinearNCS-v0"
PLANT, HEAVY, UNSTABLE = truck_trailer(), truck_trailer(mass=4000.0), cart_pole()
GRID = replace(HEAVY, between_samples=8)
QUIET = {"disturbance_bound": 0.01, "sensor_bound": 0.01, "initial_bound": 0.01}
GOOD = {"A": np.eye(2) * 0.5, "B": np.ones((2, 1)), "box": np.eye(2), "u_max": 1.0, "dt": 0.1} | QUIET
ROOM = {"A": [[0.9]], "B": [[0.2]], "operating_state": [20.0], "operating_input": [10.0], "dt": 60.0} | QUIET
ROOM |= {"state_limits": (18.0, 25.0), "input_limits": (0.0, 12.0)}
A, B, C, D = np.array([[0.0, 1.0], [-2.0, -3.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), np.zeros((1, 1))
MODEL = (A, B, C, D)
LIMITS = {"box": [1.0, 2.0], "u_max": 3.0} | QUIET
ON_REQUEST = Channel(0.5, delay=1, jitter=1, max_consecutive_losses=2, quantization_step=1e-4, on_request=True)
ASKED = {"channel": ON_REQUEST, "contract": ChannelContract(9, 1e-4), "terminate_on_violation": False}
STEP, TORQUE = 0.05, 2.0
SLOPES = (
    [[1.0 + STEP**2 * 15.0 * np.cos(0.25), STEP, 0.0075], [STEP * 15.0 * np.cos(0.25), 1.0, 0.15]],
    [[1.0 + STEP**2 * 15.0, STEP, 0.0075], [STEP * 15.0, 1.0, 0.15]],
)
COMMAND = Command(stamp=0, inputs=np.array([[1.0], [2.0], [3.0]]))


def changed(make, *rows, **settings):
    """Rows of arguments that replace good ones."""
    return [(partial(make, **(settings | change)), words) for change, words in rows]


def called(make, *rows):
    """Rows of a single argument."""
    return [(partial(make, argument), words) for argument, words in rows]


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
        return swing(state, u) + (1e-3 if len(calls) > 2_000 else 0.0)

    return step


def modeled(process=swing, **changes):
    settings = {"box": [0.25, 1.5], "samples": 2_000, "u_max": TORQUE, "dt": STEP} | dict.fromkeys(QUIET, 0.0)
    return linear_model(process, **(settings | changes))


class Inner(gym.Env):
    """A Gymnasium environment with two states."""

    observation_space, action_space = Box(-np.inf, np.inf, (2,)), Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        self.state = np.zeros(2)
        return self.state, {}


ONE = Inner()


class Counted(Inner):
    action_space = Discrete(2)


class Wide(Inner):
    action_space = Box(-1.0, 1.0, (3,))


def write(env, state):
    env.state = state


def inner(read=lambda env: env.state, kind=Inner, **settings):
    return GymProcess(kind, read_state=read, write_state=write, **settings)


def reset(env, **settings):
    env.reset(seed=0, **settings)
    return env


def moved(process):
    return reset(NCSEnv(LinearPlant(**GOOD), process=process)).step(np.zeros(1))


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
        change(document["plant"])
        plant_in(json.dumps(document))(folder)

    return load


def folder_for_a_file(folder):
    (folder / "plant.json").mkdir()
    plant_in(None)(folder)


def weakened_remainder():
    return replace(modeled(), remainder=Remainder(Ellipsoid(1e-4 * np.eye(2)), False, "an example"))


ENVIRONMENTS = [
    *changed(
        partial(gym.make, TRUCK),
        ({"plant": "nowhere.json"}, "nowhere.json"),
        ({"task": "drive"}, "task must be of type Task"),
        ({"task": {}}, "task must be the settings of a Regulation .* or a SpeedTracking .* or a SetpointTracking"),
        ({"task": {"fastest": 1.0, "reach": 1.0}}, "task must be the settings of"),
        ({"task": Regulation(state_cost=np.eye(3))}, "state_cost must have shape"),
        ({"task": SpeedTracking(input_index=1)}, "input_index"),
        ({"initial_set": np.eye(2)}, "initial_set must be of type Ellipsoid"),
        ({"initial_set": {"radius": 1.0}}, "initial_set must be the settings of"),
        ({"initial_set": Ellipsoid(np.eye(3))}, "dimension 2, got 3"),
        ({"disturbance": "storm"}, "disturbance must be one of"),
        ({"disturbance": {"M": 1.0}}, "disturbance must be the settings of a BoxDisturbance"),
        ({"disturbance": BoxDisturbance([1.0, 1.0])}, "squared length"),
        ({"plant": LinearPlant(**GOOD | {"A": 1.1 * np.eye(2)})}, "spectral radius"),
        ({"channel": "lossy"}, "channel must be of type Channel"),
        ({"channel": {"los": 0.1}}, "channel must be the settings of a Channel .*loss.*, got {'los': 0.1}"),
        ({"channel": {"loss": {"p": 0.1}}}, "loss must be a probability or the fields of GilbertElliott"),
        ({"channel": {"loss": 2.0}}, "loss must be a number"),
        ({"contract": {}}, "contract must be the settings of a ChannelContract"),
        ({"noise": "Gaussian"}, "noise must be one of"),
        ({"observe": "speed"}, "observe must be a list of some of"),
        ({"observe": ["age", "age"]}, "observe must be a list of some of"),
        ({"observe": [1]}, "observe must be a list of some of"),
        ({"process": {"pole_mass": 0.1}}, "the cart-pole has 4 states and 1 input, the plant 2 and 1"),
    ),
    (partial(gym.make, "ncs_gym/Pendulum-v0", process={"mess": 2.0}), "process must be the settings of"),
    (partial(gym.make, LINEAR), "give plant="),
    (partial(gym.make_vec, LINEAR, num_envs=3), "no plant of its own"),
    (partial(gym.make, "ncs_gym/CSTR-v0", between_samples=65), "between_samples must be"),
    (partial(gym.make_vec, "ncs_gym/CSTR-v0", num_envs=2, between_samples=65), "between_samples must be"),
    (partial(gym.make_vec, TRUCK, num_envs=2, rendered_env=3), "rendered_env must be a whole number <= 1"),
    (partial(gym.make_vec, TRUCK, num_envs=2, speed=1), TypeError, "speed"),
    (partial(gym.make_vec, TRUCK, num_envs=2, autoreset_mode="Later"), "Later"),
    *changed(
        partial(NCSEnv, HEAVY),
        ({"downlink": Channel(quantization_step=0.1)}, "a downlink carries inputs as they are, without quantization"),
        ({"downlink": Channel(send_period=2)}, "a downlink sends a command at every step: leave out send_period"),
        ({"downlink": 0.3}, "downlink must be of type Channel, got 0.3"),
        ({"downlink_contract": ChannelContract(2)}, "downlink_contract is about a downlink"),
        ({"downlink": Channel(delay=3), "downlink_contract": ChannelContract(2)}, "delays commands by up to 3 steps"),
        ({"downlink": Channel(), "downlink_contract": 2}, "downlink_contract must be of type ChannelContract"),
        (
            {"downlink": Channel(delay=900), "contract": ChannelContract(200)},
            "contracts of uplink and downlink add up to 1100 steps, more than 1000",
        ),
        ({"channel": Channel(on_request=True), "downlink": Channel(on_request=True)}, "for the channel of the samples"),
        ({"process": "swing"}, "process must be of type Process, got str"),
        ({"process": np.add}, "got ufunc: give ncs_gym.FunctionProcess of a function"),
    ),
    (partial(NCSEnv, PLANT, render_mode="ansi"), RenderModeError, "render_mode must be None or one of"),
    (partial(NCSEnv, PLANT, render_mode="ansi"), "render_mode must be None or one of"),
    (partial(NCSEnv, PLANT, render_mode="ansi"), TypeError, "render_mode must be None or one of"),  # as SB3 expects
    (partial(NCSEnv, UNSTABLE, Channel(loss=0.1)), UnstablePlantError, "max_consecutive_losses"),
    (
        partial(NCSVectorEnv, 2, plant=UNSTABLE, channel=[Channel(), Channel(loss=0.1)]),
        UnstablePlantError,
        "max_consecutive_losses",
    ),
    (partial(NCSEnv, UNSTABLE, Channel(), contract=4), "contract must be"),
    (partial(NCSEnv, UNSTABLE, Channel(quantization_step=0.1), contract=ChannelContract(4, 0.01)), "rounds to"),
    (partial(NCSEnv, LinearPlant(**GOOD), noise="gaussian"), "needs a covariance"),
    (partial(NCSVectorEnv, 2, plant=LinearPlant(**GOOD), noise="gaussian"), "needs a covariance"),
    (lambda: ncs_env(gym.make("CartPole-v1")), "expected an NCSEnv inside, got CartPoleEnv"),
    (lambda: NCSEnv(PLANT).step(np.zeros(1)), ResetNeeded, "reset"),
    (lambda: NCSVectorEnv(2, plant=PLANT).step(np.zeros((2, 1))), ResetNeeded, "reset"),
    (lambda: NCSVectorEnv(2, plant=PLANT).reset(options={"reset_mask": np.array([True, False])}), ResetNeeded, "reset"),
    (lambda: NCSEnv(PLANT, render_mode="rgb_array").render(), ResetNeeded, "reset"),
    (lambda: gym.make_vec(TRUCK, num_envs=3, render_mode="rgb_array").render(), ResetNeeded, "reset"),
    (lambda: gym.make_vec(TRUCK, num_envs=3).reset(seed=[1, 2]), "give one seed, or 3 of them, got 2"),
    (partial(gym.make_vec, TRUCK, num_envs=3, max_episode_steps=None), "leave it out for that of the id"),
    *((partial(gym.make_vec, TRUCK, num_envs=3, horizon=each), "horizon must be") for each in (-1, 0, 1.5, "x", None)),
]
REGISTERED = [
    (partial(register_plant, "Plants/Pole-v0", UNSTABLE, channel=Channel(loss=0.1)), UnstablePlantError, "max_consec"),
    (partial(register_plant, "Plants/T-v0", PLANT, channel={"loss": 2.0}), "loss must be a number"),
    (partial(register_plant, "Plants/T-v0", PLANT, chanel=Channel()), TypeError, "chanel"),
    (partial(register_plant, "Plants/T-v0", PLANT, max_episode_steps=0), "max_episode_steps"),
    (partial(register_plant, TRUCK, PLANT), "an environment of this package"),
]
REQUESTS = [
    (lambda: Channel(on_request=True, send_period=2), "leave out send_period"),
    (
        lambda: NCSEnv(UNSTABLE, Channel(0.1, on_request=True), contract=ChannelContract(9)),
        "give it max_consecutive_losses",
    ),
    (lambda: NCSEnv(UNSTABLE, Channel()).request(), r"make it with Channel\(..., on_request=True\)"),
    (lambda: NCSEnv(UNSTABLE, **ASKED).request("yes"), "a request is True or False"),
    (lambda: NCSVectorEnv(3, plant=UNSTABLE, **ASKED).request([True]), r"bool of shape \(3,\)"),
    (lambda: NCSEnv(UNSTABLE, **ASKED).reset(options={"channel": Channel()}), "give one with on_request=True"),
    (lambda: NCSEnv(PLANT).reset(options={"channel": Channel(on_request=True)}), "on_request=False"),
    (lambda: NCSVectorEnv(2, plant=PLANT, channel=[Channel(), Channel(on_request=True)]), "on_request="),
    (lambda: RequestActions(gym.make(POLE)), "on_request=True"),
    (lambda: RequestActions(gym.make("CartPole-v1")), "expected an NCSEnv inside"),
    (lambda: RequestActions(gym.make(POLE, **ASKED), -1.0), "cost"),
    (lambda: VectorRequestActions(gym.make_vec(POLE, num_envs=2, autoreset_mode="SameStep", **ASKED)), "NEXT_STEP"),
    (lambda: SafetyShield(RequestActions(gym.make(POLE, **ASKED))), "changes the action space"),
    (lambda: RequestActions(gym.make(POLE, **ASKED)).step(np.array([0.0, np.nan])), "must be finite"),
    (lambda: RequestActions(gym.make(POLE, **ASKED)).step(np.zeros(1)), r"with shape \(2,\)"),
]
CHANNELS = [
    (lambda: Channel(delay=(1, 2)), r"got \(1, 2\): jitter is .* delay=1, jitter=1 stands for 1 to 2 steps"),
    (
        lambda: NCSEnv(HEAVY, downlink=Channel(delay=2)).reset(options={"downlink": Channel(delay=3)}),
        "delays commands by up to 3 steps",
    ),
    (lambda: RandomChannel(NCSEnv(HEAVY)), "give channel or downlink"),
    (lambda: VectorRandomChannel(NCSVectorEnv(2, plant=HEAVY), 0.3), "or a list of channels"),
    (lambda: RandomChannel(NCSEnv(HEAVY), lambda rng: 0.3).reset(), "what was drawn must be a Channel"),
    (lambda: TraceChannel(trace=(0, -1), loss=0.1), "loss of a TraceChannel"),
    (TraceChannel, "trace"),
    (lambda: Actuator(input_delay=2, inputs=1).start(episode=0.5), "episode must be a whole number >= 0"),
    *called(
        Actuator(input_delay=2, inputs=1).apply,
        *((step, "step must be a whole number >= 0") for step in (600.5, -1, None, True)),
    ),
]
PLANTS = [
    *changed(
        LinearPlant,
        ({"A": np.ones((2, 3))}, r"A must have shape \(2, 2\), got \(2, 3\)"),
        ({"A": [1.0, 0.0]}, r"A must have shape \(any, any\), got \(2,\)$"),
        ({"B": np.ones((3, 1))}, r"B must have shape \(2, any\), got \(3, 1\)$"),
        ({"B": [0.5]}, r"B must have shape \(2, any\), got \(1,\)$"),
        ({"B": [0, 0.5]}, r"B must .*, got \(2,\); a single column is written \[\[0.0\], \[0.5\]\]$"),
        ({"H": [1.0, 0.0]}, r"H must have shape \(any, 2\), got \(2,\); a single row is written \[\[1.0, 0.0\]\]$"),
        ({"H": [[1.0, 0.0], [0.0, 0.0]]}, "every row of H must measure something"),
        ({"error_gain": [1.0, 0.0]}, r"\(1, 2\), got \(2,\); a single row is written \[\[1.0, 0.0\]\]$"),
        ({"box": [[1e150, 0.0], [0.0, 1.0]]}, "box must be finite and below 1e"),
        ({"box": [[0.0, 0.0], [1.0, 0.0]]}, "every row of box must limit something"),
        ({"box": [1.0, 2.0, 3.0]}, r"box must be positive half-widths of shape \(2,\)"),
        ({"box": [np.inf, np.inf]}, "box must be positive half-widths"),
        ({"box": "wide"}, r"box must be half-widths of shape \(2,\) or rows of shape \(any, 2\)"),
        ({"box": ((0, 3), (0, np.inf))}, r"box looks like lower and upper limits.*give them as an array"),
        ({"A": [[0.5]], "B": [[1.0]], "box": [(0.5, 1.0)]}, "box looks like lower and upper limits"),
        ({"A": np.eye(3) / 2, "B": np.ones((3, 1)), "box": [[-1, 1]] * 3}, r"box looks like.*\(state_limits="),
        ({"A": np.eye(3) / 2, "B": np.ones((3, 1)), "box": ([-1, -2, -3], [1, 2, 3])}, "box looks like lower and"),
        ({"A": np.eye(3) / 2, "B": np.ones((3, 1)), "box": ([1, 2, 3], [-1, -2, -3])}, "box looks like lower and"),
        ({"box": [[0.05, -0.05], [0.01, -0.01]]}, "box looks like lower and upper limits"),
        (
            {"A": np.eye(3) / 2, "B": np.ones((3, 1)), "box": np.array([[-1, -2, -3], [1, 2, 3]])},
            "box looks like lower and upper limits",
        ),
        *(
            ({"box": box}, r"box looks like lower and upper limits.* LinearPlant\(state_limits.* as an array")
            for box in (
                ([-1, -2], [1, 2]),
                [[-1, -2], [1, 2]],
                [[-1, 1], [-2, 2]],
                [(0.5, 1.0), (-2.0, 2.0)],
                [[1, 2], [3, 4]],  # without zero between them
                ([0, 0], [10, 5]),
                [(0, 1), (-2, 2)],
                [[-1, -np.inf], [1, np.inf]],
                [[-1, 1], [0, 2]],  # a pair for each state
                np.array([[-1, -2], [1, 2]]),  # as rows the same row twice
                np.array([[-1, 1], [-2, 2]]),
            )
        ),
        ({"u_max": -1.0}, "u_max must be a positive number"),
        ({"u_max": (-1.0, 2.0)}, r"u_max must be a positive number.*LinearPlant\(input_limits="),
        ({"disturbance_bound": 1e-6 * np.eye(2)}, "a covariance has an argument of its own"),
        ({"sensor_bound": ([[1e-200], [1e-200]], 1.0)}, "sensor_bound: the entries of E diag"),
        *(({name: [0.1, 0.2, 0.3]}, f"{name} must be a number") for name in QUIET),
        ({"gamma": -1e-9}, "gamma must be a number >= 0, got -1e-09"),
        ({"delta": 1.0}, r"delta must be a number >= 1e-12 and <= 0\.999"),
        ({"process_noise_cov": -np.eye(2)}, "process_noise_cov must be positive semidefinite"),
        ({"initial_cov": [[1.0, 0.5], [0.0, 1.0]]}, "initial_cov must be symmetric"),
        ({"remainder": 0.1}, "remainder must be a Remainder"),
        ({"remainder": Remainder(Ellipsoid(np.eye(3)), True, "an example")}, "dimension 2"),
        **GOOD,
    ),
    *changed(
        truck_trailer,
        *(({name: value}, name) for name, value in (("mass", 0.0), ("stiffness", -1.0), ("damping", -1.0), ("H", 3))),
        *(({"between_samples": wrong}, "between_samples must be") for wrong in (0, -3, 65, 2.5, True, "8", [8])),
        ({"box": [2.0, np.inf], "between_samples": 8}, "bounds every state"),
    ),
    (partial(cart_pole, delta=None), r"delta must be a number >= 1e-12 and <= 0\.999"),
    (partial(LinearPlant, **GOOD, sensor_bonud=0.1), TypeError, "unexpected keyword argument 'sensor_bonud'"),
    (partial(LinearPlant, **GOOD, input_ends=[[-0.5], [0.5]]), "input_ends follow from u_max"),
    (partial(LinearPlant, **ROOM, box_ends=[[-1.0], [1.0]]), "box_ends follow from state_limits"),
    *(
        (partial(linear_model, np.add, [0.7], 1.0, 1.0, **{name: [[-1.0], [3.0]]}), f"follows? from {given}")
        for name, given in (("input_ends", "u_max"), ("state_limits", ""), ("input_limits", ""))
    ),
    (partial(linear_model, np.add, u_max=1.0, dt=1.0, state_limits=(-1.0, np.inf)), "state 1 has no two finite ones"),
    (partial(linear_model, np.add, dt=1.0), TypeError, "needs limits: give box or state_limits, and u_max"),
    (partial(linear_model, np.add, [0.7], 1.0), "dt must be a number"),
    (partial(truck_trailer, wheels=18), TypeError, "unexpected keyword argument 'wheels'"),
    (
        partial(LinearPlant, A=A, B=B, dt=0.1),
        TypeError,
        "needs limits: give box or state_limits, and u_max or input_limits",
    ),
    (
        partial(LinearPlant, A=A, B=B, dt=0.1, box=[1.0, 1.0], umax=1.0),
        TypeError,
        r"needs limits: give u_max or input_limits \(it has no argument umax\)",
    ),
    *(
        (make, r"C= is not an argument: pass box=.* \|c_j x\| <= 1 .* H=.* output matrix")
        for make in (
            partial(LinearPlant, **GOOD, C=np.eye(2)),
            partial(truck_trailer, C=np.eye(2)),
            partial(cart_pole, C=np.eye(4)),
            partial(replace, PLANT, C=np.eye(2)),
            partial(LinearPlant.from_statespace, MODEL, dt=0.1, **LIMITS, C=C),
        )
    ),
    *changed(
        LinearPlant,
        (
            {"operating_state": [19.0], "offset": [0.0]},
            r"no equilibrium: .* not zero; with this input the equilibrium is \[20.0",
        ),
        ({"A": [[1.0]], "offset": [0.0]}, "no equilibrium: .* leave out offset, which is c of a step, if the model"),
        ({"offset": [1.0]}, r"the equilibrium is \[30"),
        ({"state_limits": (20.0, 25.0)}, r"state_limits must have the operating point \[20.0\] strictly between"),
        ({"input_limits": (0.0, 9.0)}, "input_limits must have the operating point"),
        ({"state_limits": 25.0}, r"state_limits must be a pair \(low, high\)"),
        ({"state_limits": ([1.0, 2.0], 30.0)}, "state_limits must be a pair"),
        ({"state_limits": (np.nan, 30.0)}, "state_limits must be a pair"),
        ({"state_limits": (-np.inf, np.inf)}, "give at least one finite limit of a state"),
        ({"input_limits": (-np.inf, np.inf)}, "input_limits must be finite"),
        ({"operating_state": [20.0, 1.0]}, "operating_state must have shape"),
        ({"operating_input": "10"}, "operating_input must be a vector"),
        ({"box": [1.0]}, "box follows from state_limits"),
        ({"u_max": 1.0}, "u_max follows from input_limits"),
        ({"state_limits": (25.0, 18.0)}, "low < high"),
        ({"offset": [1.0, 2.0]}, "offset must have shape"),
        **ROOM,
    ),
    *changed(
        partial(LinearPlant, A=[[0.9]], B=[[0.2]], dt=60.0, box=1.0, **QUIET),
        ({"u_max": 1.0, "box_ends": ([0.1], [1.0])}, "must have 0 between them"),
        ({"u_max": 1.0, "output_limits": [([1.0], 0.0)]}, r"a list of \(row, low, high\)"),
        ({"u_max": 1.0, "output_limits": [([0.0], -1.0, 1.0)]}, "must limit something"),
        ({"input_ends": ([-1.0], [np.inf])}, "finite, below and above 0"),
    ),
    (partial(LinearPlant, A=A, B=B, dt=0.1, u_max=1.0), TypeError, "LinearPlant needs limits: give box or state_lim"),
    *called(PLANT.to_deviation, ([1.0], "the state must have shape")),
    *called(PLANT.from_deviation, ([1.0], "the state must have shape")),
    (partial(PLANT.to_deviation, [1.0, 1.0], "speed"), "of must be one of"),
    (partial(PLANT.from_deviation, [1.0, 1.0], "speed"), "of must be one of"),
    *changed(
        partial(LinearPlant.from_statespace, **LIMITS),
        ({"sys": MODEL}, "the model has no sampling time: give dt"),
        ({"sys": SimpleNamespace(A=A, B=B, C=C, D=D, dt=True)}, "the model has no sampling time: give dt"),
        ({"sys": (*MODEL, 0.1), "dt": 0.2}, "dt must be that of the model in discrete time, 0.1, or be left out, got"),
        ({"sys": (*MODEL, -0.1)}, "dt must be a number > 0"),
        ({"sys": (A, B, C, np.ones((1, 1))), "dt": 0.1}, "D of the model must be zero, .* subtract D u"),
        ({"sys": (A, B, np.eye(3), D), "dt": 0.1}, r"C of the model must have shape \(any, 2\)"),
        ({"sys": (A[:1], B, C, D), "dt": 0.1}, r"A of the model must have shape \(1, 1\), got \(1, 2\)"),
        ({"sys": (A, B), "dt": 0.1}, r"sys must be a state-space model of python-control \(control.ss"),
        ({"sys": "plant", "dt": 0.1}, "sys must be a state-space model"),
        ({"sys": SimpleNamespace(num=[1.0]), "dt": 0.1}, "is a transfer function"),
        ({"sys": (*MODEL, 0.1), "between_samples": 8}, "needs a plant that was sampled from a model in continuous"),
    ),
    *changed(
        partial(LinearPlant.from_statespace, MODEL),
        ({"H": C}, "H come from the state-space model"),
        ({"input_delay": -1}, "input_delay must be a whole number >= 0"),
        ({"du_max": 8.0}, "limits nothing: inputs change by no more"),
        ({"state_names": ("a", "a")}, "state_names must differ, got"),
        ({"input_delay": 1, "initial_cov": np.eye(2)}, "must be given by initial_bound"),
        ({"input_delay": 1, "between_samples": 8}, "without input_delay"),
        ({"continuous_model": [[-2.0, 1.0]]}, "continuous_model is that of sys"),
        **LIMITS,
        dt=0.1,
    ),
    (
        partial(LinearPlant.from_statespace, MODEL, dt=0.1, input_limits=(-2.0, 3.0), **QUIET),
        TypeError,
        "needs limits: give box or state_limits",
    ),
    (
        partial(
            LinearPlant.from_statespace,
            MODEL,
            dt=0.1,
            state_limits=([0.0, -1.0], [3.0, 1.0]),
            input_limits=(-2.0, 3.0),
            **QUIET,
        ),
        r"state_limits must have the operating point \[0.0, 0.0\] strictly between",
    ),
    *changed(
        partial(LinearPlant, A=A, B=B, dt=0.1, **QUIET),
        (
            {"state_limits": (0.0, 3.0), "input_limits": (-2.0, 3.0), "operating_state": [1.0, 1.0]},
            r"input_limits are absolute: beside operating_state give operating_input, too \(0 if it is\)",
        ),
        (
            {"box": 1.0, "u_max": 1.0, "mixed_limits": ([1.0, 0.0, 1.0], -1.0, 3.0), "operating_state": [1.0, 1.0]},
            "mixed_limits are absolute: beside operating_state give operating_input",
        ),
    ),
    *changed(
        partial(replace, PLANT, between_samples=8),
        ({"continuous_model": None}, "needs a plant that was sampled from a model in continuous time"),
        ({"A": 1.001 * PLANT.A}, "is another one"),
    ),
    (
        lambda: replace(
            gym.make("ncs_gym/CartPoleNonlinear-v0").unwrapped.plant,
            continuous_model=UNSTABLE.continuous_model,
            between_samples=8,
        ),
        "without a remainder",
    ),
    *(
        (
            partial(zero_order_hold, np.array([[size]]), np.array([[1.0]]), 1.0),
            "grows beyond all numbers within a step of 1 s: give a smaller dt",
        )
        for size in (1e3, 1e13, 1e20)
    ),
    (partial(exact.inverse, np.ones((2, 2))), ZeroDivisionError, ""),
    (plant_in(None), "cannot read the plant in .*: No such file"),
    (folder_for_a_file, "cannot read the plant in .*: Is a directory"),
    *((plant_in(text), "it is not valid JSON") for text in ("{", b"\xff\xfe", "[" * 100_000)),
    (plant_in("[]"), "is not a plant of format 'ncs-gym plant 1'"),
    (plant_in('{"format": "ncs-gym plant 1", "plant": 3}'), "is not a plant of format"),
    *(
        (plant_with(change), words)
        for change, words in (
            (lambda plant: plant.pop("A"), r"missing 1 required .*'A'"),
            (lambda plant: plant.update(mass=3), "unexpected keyword argument 'mass'"),
            (lambda plant: plant.update(C=plant.pop("box")), "C= is not an argument"),
            (lambda plant: plant.update(A=[["1", "2"], ["3", "4"]]), "A must be a matrix of numbers"),
            (lambda plant: plant.update(dt=None), "dt must be a number"),
            (
                lambda plant: plant.update(sensor_bound={"radius": 1}),
                'a bound in the file of a plant must be .*"shape"',
            ),
            (lambda plant: plant.update(sensor_bound={"shape": [[-1]]}), "must be positive semidefinite"),
        )
    ),
]
PROCESSES = [
    (partial(GymProcess, Inner, read_state=3), "GymProcess: read_state must be a function, got 3"),
    (partial(FunctionProcess, 3), "the process must be a function"),
    (partial(CartPoleProcess, pole_mass=-1.0), "pole_mass must be"),
    (partial(InvertedPendulumProcess, mass_factor=0.0), "mass_factor must be"),
    *changed(PendulumProcess, *(({name: 0.0}, f"{name} must be") for name in ("gravity", "mass", "length"))),
    *changed(
        partial(NCSEnv, LinearPlant(**GOOD)),
        ({"process": inner(kind=Counted)}, "needs an environment with a Box of actions, got Discrete: wrap it in"),
        ({"process": inner(kind=Wide)}, r"the plant has 1 inputs, actions have shape \(3,\): give GymProcess write_ac"),
        ({"process": inner(kind=lambda: 3)}, "make must return a gymnasium.Env, got 3"),
        (
            {"process": GymProcess(Inner, lambda env: env.state), "disturbance": lambda rng, plant, x: 0.0 * x},
            "disturbance of your own can act only on a process with write_state",
        ),
    ),
    (lambda: NCSEnv(LinearPlant(**GOOD | {"u_max": 1.5}), process=inner()), "go beyond the actions"),
    (
        lambda: reset(
            NCSEnv(LinearPlant(**GOOD), process=GymProcess(Inner, read_state=lambda env: env.state)),
            options={"state": [0.0, 0.0]},
        ),
        "cannot start at a given state: give its GymProcess write_state",
    ),
    (
        lambda: NCSVectorEnv(2, plant=LinearPlant(**GOOD), process=inner(kind=lambda: ONE)),
        "make must return a fresh environment at every call",
    ),
    *called(
        lambda read: moved(inner(read)),
        (lambda env: env.position, r"must return the state, .* it raised AttributeError"),
        (lambda env: [1.0, 2.0, 3.0], "must return the 2 finite numbers of the state"),
        (lambda env: [1.0, np.nan], "must return the 2 finite numbers of the state"),
        (lambda env: env.state + 1.0, "where write_state wrote .* they must agree"),
    ),
    *called(
        lambda value: moved(FunctionProcess(lambda x, u: value)),
        *((value, r"must return a finite next state of shape \(2,\)") for value in (np.ones(3), [1.0, np.inf], "x")),
    ),
    (
        lambda: gym.make(LINEAR, plant=GRID, process=FunctionProcess(lambda x, u: GRID.A @ x + GRID.B @ u)),
        "the plant's own equations",
    ),
    (partial(Remainder, 0.1, True, "an example"), "bound of a remainder must be an Ellipsoid"),
    (partial(Remainder, Ellipsoid(np.eye(2)), "yes", "an example"), "proved must be"),
    (partial(Remainder, Ellipsoid(np.eye(2)), True, 3), "basis of a remainder must be text"),
    *changed(
        modeled,
        ({"process": lambda x, u: swing(x, u) + 3.0 * np.abs(x)}, "shrink the box, the input limits or dt"),
        ({"process": kinked_late()}, r"a fresh sample of the remainder is .* use more samples, a larger"),
        ({"process": LinearProcess()}, "the linear process is its own model"),
        ({"process": 3}, "must be a function"),
        (
            {"process": GymProcess(lambda: gym.make("Pendulum-v1"), lambda env: env.unwrapped.state)},
            "give GymProcess write_state",
        ),
        (
            {"process": GymProcess(lambda: gym.make("CartPole-v1"), lambda env: np.zeros(2))},
            "Box of actions, got Discrete",
        ),
        ({"box": [1.0, 1.0, 1.0]}, r"a state of 3 entries \(as box has\) with 1 input \(as u_max"),
        ({"samples": 5}, "samples must be"),
        ({"safety_factor": 0.9}, "safety_factor must be"),
        ({"A": np.eye(2)}, "give A and B together, or jacobian_bounds"),
        ({"jacobian_bounds": SLOPES, "A": np.eye(2), "B": np.ones((2, 1))}, "give A and B together, or jacobian_b"),
        ({"jacobian_bounds": SLOPES[::-1]}, "must be the smallest values, then the largest"),
        ({"jacobian_bounds": 3}, r"jacobian_bounds must be two arrays of shape \(2, 3\)"),
        ({"jacobian_bounds": (SLOPES[1], SLOPES[1])}, "a fresh sample of the remainder is .* correct the jacobian_b"),
        *(
            (
                {"jacobian_bounds": SLOPES, "process": FunctionProcess(noisy, vectorized)},
                r"same state with the same input differ .* bounds on a Jacobian prove nothing",
            )
            for vectorized in (False, True)
        ),
    ),
    *changed(
        pendulum,
        ({"box": [0.6, 3.0]}, r"proved for its own .*, which box would replace"),
        ({"u_max": 4.0, "dt": 0.1}, "which dt, u_max would replace"),
        ({"mass": 0.04}, "which Pendulum-v1 clips to 8"),
    ),
    (lambda: replace(pendulum(), box=[3.0, 3.0]), "another box"),
    *(
        (
            lambda change=change: replace(modeled(), **change),
            f"belongs to a plant with another {named}: .*linear_model.* anew if it holds",
        )
        for change, named in (
            ({"box": [1.0, 1.0]}, "box"),
            ({"box": [0.2, 1.5]}, "box"),
            ({"u_max": 3.0}, "u_max"),
            ({"A": np.eye(2)}, "A"),
            ({"B": [[0.0], [0.1]]}, "B"),
            ({"dt": 0.1, "u_max": 3.0}, "u_max, dt"),
        )
    ),
    (
        lambda: LinearPlant(
            **GOOD | {"box": [0.25, 1.5], "u_max": TORQUE, "dt": STEP, "remainder": modeled().remainder}
        ),
        "belongs to a plant with another A, B",
    ),
    (lambda: replace(modeled(), remainder=replace(weakened_remainder(), box=[0.2, 1.5]).remainder), "another box"),
]
TASKS = [
    *changed(
        partial(NCSEnv, PLANT),
        (
            {"task": SetpointTracking(output=[1.0, 0.0], reach=0.9, width=2.0)},
            "farthest equilibrium inside the safe box and the input limits",
        ),
        ({"task": SetpointTracking(output=[1.0], reach=0.1, width=2.0)}, r"output must have shape \(2,\)"),
    ),
]
UNCERTAINTY = [
    *called(
        lambda value: as_bound(value, 2, "d"),
        (-1.0, r"d must be a number or shape \(2,\), each 0 or between"),
        *((value, "d must be a number or shape") for value in (np.nan, np.inf, [0.1, -0.2])),
        *((value, "each 0 or between 1e-37 and 1e") for value in (1e-200, 1e60)),
        ([0.1, 0.2, 0.3], r"d must be a number or shape \(2,\)"),
        (np.eye(2), r"d must be a number, half-widths of shape \(2,\), an Ellipsoid\(shape\), or a pair"),
        *((value, "d must be a number, half-widths") for value in ("small", True)),
        (Ellipsoid(np.eye(3)), "d must be an ellipsoid of dimension 2, got one of dimension 3"),
        ((np.ones((3, 1)), 1.0), r"d: E of d = E w must have shape \(2, any\)"),
        ((np.ones((2, 1)), [1.0, 2.0]), r"d: w of d = E w must be a number or shape \(1,\)"),
        ((np.ones((2, 1)), -1.0), "d: w of d = E w must be"),
    ),
    *called(
        lambda value: as_disturbance(value, PLANT, False),
        ("gusts", "disturbance must be one of"),
        (3, "disturbance must be one of"),
        (BoxDisturbance([0.1, 0.1]), "squared length"),
        (BoxDisturbance([0.1, 0.1, 0.1]), "2 entries"),
        (AdversarialDisturbance(np.eye(3)), "M must have shape"),
        (AdversarialDisturbance(rows=np.ones((1, 3))), "rows must have 2 columns, got 3"),
    ),
    *called(
        lambda d: checked(PLANT, d, allow_assumption_violation=True),
        *((d, "the disturbance must") for d in ([np.nan, 0.0], [0.0], "gust", None)),
    ),
    (
        lambda: as_disturbance(
            BoxDisturbance([0.051, 0.00204]), replace(PLANT, gamma=0.0, disturbance_bound=[0.05, 0.002]), False
        ),
        r"the box is 1\.02 times as large",
    ),
    *called(partial(bound_violation_probability, PLANT, Channel()), *((steps, "steps") for steps in (-1, 1.5, "many"))),
    (partial(bound_violation_probability, Channel(), PLANT, 1), "expected a LinearPlant and a Channel"),
    (partial(certified_error_set, UNSTABLE), UnstablePlantError, r"spectral radius of A is 1\.\d"),
    (partial(certified_error_set, batch_reactor(), ChannelContract(200)), ErrorSetError, "promise"),
    (partial(certified_error_set, batch_reactor(), ChannelContract(1000)), ErrorSetError, ""),
    (partial(certified_error_set, cart_pole(full_state=False), ChannelContract(400)), ErrorSetError, ""),
    (
        lambda: Estimator(
            batch_reactor(), Channel(quantization_step=0.05), certified_error_set(batch_reactor(), ChannelContract(2))
        ),
        "coarsely",
    ),
]
ROWS = [
    (call, *(error or [ValueError]), words)
    for call, *error, words in (
        *ENVIRONMENTS,
        *REGISTERED,
        *REQUESTS,
        *CHANNELS,
        *PLANTS,
        *PROCESSES,
        *TASKS,
        *UNCERTAINTY,
    )
]


@pytest.mark.parametrize(("call", "error", "words"), ROWS, ids=[words or error.__name__ for _, error, words in ROWS])
def test_what_makes_no_sense_is_refused_in_one_sentence(call, error, words, tmp_path):
    before = set(gym.registry)
    with pytest.raises(error, match=words) as caught:
        call(tmp_path) if getattr(call, "__name__", "") in ("load", "folder_for_a_file") else call()
    said = re.sub(r"\. Did you mean '\w+'\?$", "", str(caught.value))  # Python's own, from 3.13 on
    assert not re.search(r"\n|[.!?] [A-Z]", said)
    assert set(gym.registry) == before


UNUSABLE = [*NOTHING_USABLE, *WRONG_NUMBERS]
CALLS = {  # What is called, whether with an environment or with three, the argument, and the words.
    "step": [
        *((False, action, "the action must be finite") for action in ([np.nan], [np.inf], [0.0, 0.0], 0.5, "go", None)),
        (False, [[0.1]], "the action must be finite"),
        *((True, np.zeros(shape), "actions must be finite with shape") for shape in ((3, 2), 3)),
        *((True, [[0.0], [wrong], [0.0]], "actions must be finite with shape") for wrong in (np.inf, np.nan, 1j)),
        *((True, wrong, "actions must be finite with shape") for wrong in (None, "a")),
    ],
    "reset": [
        *((False, {"state": wrong}, "state") for wrong in ([1.0], [np.nan, 0.0], "a", None)),
        *((True, {"state": wrong}, "state") for wrong in (np.zeros(3), np.full((3, 2), np.nan))),
        *((many, {"sate": [0.0, 0.0]}, "reset knows the options") for many in (False, True)),
        *((many, wrong, "option") for many in (False, True) for wrong in UNUSABLE if type(wrong) is not dict),
        *((many, wrong, "option") for many in (False, True) for wrong in ({"a": 1}, {1: 2})),
        *((many, {"state": wrong}, "state") for many in (False, True) for wrong in UNUSABLE),
        *((True, {"reset_mask": wrong}, "reset_mask") for wrong in (np.ones(2, np.bool_), np.ones(3), *UNUSABLE)),
        (True, {"reset_mask": np.zeros(3, np.bool_)}, "reset_mask"),
        *(
            (many, {name: wrong}, words)
            for many in (False, True)
            for name, wrong, words in (
                ("channel", 0.3, "channel must be a Channel or a function"),
                ("channel", [Channel()] * 2, "channel must be a Channel or a function"),
                ("channel", Channel(quantization_step=0.1), "rounds to 0.1, the environment was made for no more than"),
                ("downlink", Channel(), "ideal downlink, and commits no inputs ahead"),
            )
        ),
    ],
}


@pytest.mark.parametrize(("call", "many", "wrong", "words"), [(c, *row) for c, rows in CALLS.items() for row in rows])
def test_what_an_environment_refuses_changes_nothing(call, many, wrong, words):
    env, twin = (NCSVectorEnv(3, plant=PLANT) if many else NCSEnv(PLANT) for _ in range(2))
    reset(env)
    reset(twin)
    with pytest.raises(ValueError, match=words) as caught:
        env.step(wrong) if call == "step" else env.reset(seed=7, options=wrong)
    assert not re.search(r"\n|[.!?] [A-Z]", str(caught.value))
    action = np.full(env.action_space.shape, 0.25)
    np.testing.assert_array_equal(env.step(action)[4]["state"], twin.step(action)[4]["state"])


@pytest.mark.parametrize(
    ("commands", "words"),
    [
        (COMMAND, r"commands must be a list of Command\(stamp, inputs\), empty if nothing arrived, got Command"),
        (None, "commands must be a list of Command.* got None"),
        (5, "commands must be a list of Command.* got 5"),
        ([COMMAND._replace(stamp=1), None], r"a command is Command\(stamp, inputs\) .* got None"),
        ([COMMAND._replace(stamp=1.5)], r"with whole numbers and finite inputs of shape \(3, 1\)"),
        ([COMMAND._replace(stamp=1, episode="0")], "a command is"),
        ([COMMAND._replace(stamp=1, inputs=np.zeros((2, 1)))], "a command is"),
        ([COMMAND._replace(stamp=1, inputs=np.array([[1.0], [np.nan], [3.0]]))], "a command is"),
        ([(1,)], "a command is"),
    ],
)
def test_what_is_no_command_is_refused_and_leaves_those_that_an_actuator_holds(commands, words):
    actuator = Actuator(input_delay=2, inputs=1)
    actuator.receive([COMMAND])
    with pytest.raises(ValueError, match=words):
        actuator.receive(commands)
    np.testing.assert_array_equal(actuator.apply(2), [3.0])
    np.testing.assert_array_equal(actuator.apply(3), [0.0])
    assert actuator.missing


def test_hints_of_python_are_quoted_in_brackets():
    error = TypeError("f() got an unexpected keyword argument 'a'. Did you mean 'b'?")
    assert reason_of(error) == "f() got an unexpected keyword argument 'a' (did you mean 'b'?)"
