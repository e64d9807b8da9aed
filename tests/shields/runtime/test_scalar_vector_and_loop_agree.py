"""Scalar shields, vector shields and loops without Gymnasium say the same of the same draws, feature by feature."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from ncs_gym import (
    Channel,
    ChannelContract,
    Ellipsoid,
    LinearPlant,
    SpeedTracking,
    cart_pole,
    truck_trailer,
)
from ncs_gym.plants.library import batch_reactor
from shields.runtime import guard as guarantee
from shields.runtime.safety_filter import MODES
from tests.certificates import certificate_of
from tests.ncs_gym.envs.same_draws import compare
from tests.plants import random_plant, with_remainder
from tests.product import library_plant, linear_plant, rate_limited, vector_env
from tests.shields.attacks.cases import RANDOM
from tests.shields.polytope.limits import CHANNEL, CONTRACT, TANKS

TRUCK, CART, REACTOR, LOCAL = truck_trailer(mass=4000.0), cart_pole(), batch_reactor(), with_remainder()
BOUNDS = {"box": [1.0, 1.0], "u_max": 1.0, "dt": 0.1, "sensor_bound": 0.001, "initial_bound": 0.001}
RATES = linear_plant(
    A=[[0.9, 0.1], [0.0, 0.8]],
    B=[[0.0], [0.3]],
    disturbance_bound=0.01,
    mixed_limits=[([0.5, -1.0], [0.5], -0.7, 0.8)],
    **BOUNDS,
)
RATES = rate_limited(RATES, 0.4)
SPARSE = Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2)
KEPT = Channel(loss=0.4, delay=1, max_consecutive_losses=1)
ASKED = Channel(0.5, delay=1, jitter=1, max_consecutive_losses=2, quantization_step=1e-4, on_request=True)
LATE_CART = {"channel": Channel(loss=0.6, max_consecutive_losses=2, jitter=2), "contract": ChannelContract(4)}


def gust(rng, plant, nominal_next):
    """Three times too strong now and then."""
    return (3.0 if rng.random() < 0.1 else 0.9) * plant.nominal_disturbance.sample_boundary(rng)


def edge(plant, scale):
    """Starts in the ellipsoid of the plant's own certificate, blown up or shrunk."""
    return {"initial_set": Ellipsoid(scale**2 * certificate_of(plant).safe_set.shape_matrix)}


@dataclass(frozen=True)
class Feature:
    """What environments are made with, in which modes, and what must have happened for the row to say anything."""

    plant: LinearPlant
    settings: dict[str, Any] = field(default_factory=dict)
    modes: tuple[str, ...] = ("project",)
    reasons: tuple[str, ...] = ("",)
    safe_set: str = "ellipsoid"
    options: dict[str, Any] | None = None
    count: int = 2


OUTSIDE = {"state": np.array([[1.99, 1.98], [0.0, 0.0], [-2.05, 1.0]])}
IN_BOX = {"state": np.array([[0.99, 0.99], [0.2, 0.2], [-0.9, -0.9]])}
CART_ANYWHERE = {"state": np.array([0.8, 0.1, -0.6])[:, None] * CART.half_widths * [1.0, -1.0, 1.0, -1.0]}
CORNER = certificate_of(TRUCK).safe_set.extreme_point(np.array([1.0, 0.4]))
EDGE = {"state": np.array([(1.0 - 1e-12) * CORNER, (1.0 + 1e-9) * CORNER])}
DRAWN = {"channel": lambda rng: Channel(loss=0.2, delay=int(rng.integers(3)))}
GOES_ON, NEVER = ("", guarantee.NOT_KNOWN_INSIDE), (guarantee.NO_DOWNLINK_CONTRACT, guarantee.LATE_INPUT)
FEATURES = {
    "one input, in every mode": Feature(TRUCK, {"channel": SPARSE, "disturbance": "adversarial"}, MODES),
    "an unstable plant with a contract": Feature(CART, LATE_CART, ("project", "lookahead", "monitor")),
    "starts all over the box": Feature(CART, LATE_CART, ("lookahead",), GOES_ON, options=CART_ANYWHERE, count=3),
    "limits of rates and of both together": Feature(
        RATES, {"channel": SPARSE, "disturbance": "adversarial"}, MODES, safe_set="polytope"
    ),
    "limits with two ends": Feature(
        TANKS,
        {"channel": CHANNEL, "contract": CONTRACT, "disturbance": "adversarial"},
        ("project", "switch", "boundary", "monitor"),
        safe_set="polytope",
    ),
    "some outputs": Feature(
        RANDOM["n=3 m=2 p=1"],
        {"channel": Channel(0.3, quantization_step=0.01, delay=1, jitter=2)},
        ("project", "switch", "boundary"),
    ),
    "a polytope": Feature(random_plant(0, 4, 2), {"channel": Channel(loss=0.3)}, safe_set="polytope"),
    "drawn channels": Feature(TRUCK, {"channel": Channel(loss=0.2, delay=2)}, options=DRAWN),
    "a task, and episodes that end": Feature(
        TRUCK, {"task": SpeedTracking(change_probability=0.2), "terminate_on_violation": True}, ("monitor",)
    ),
    "starts anywhere": Feature(TRUCK, {"channel": SPARSE}, ("project", "lookahead"), GOES_ON, options=OUTSIDE, count=3),
    "starts at the edge": Feature(TRUCK, {}, reasons=GOES_ON, options=EDGE),
    "between the samples": Feature(library_plant(truck_trailer, mass=4000.0, between_samples=2), {"channel": SPARSE}),
    "a remainder": Feature(LOCAL, {}, ("monitor", "project"), (guarantee.LEFT_MODEL, ""), options=IN_BOX, count=3),
    "gusts": Feature(
        REACTOR,
        {"disturbance": gust, "allow_assumption_violation": True, "contract": ChannelContract(3)},
        reasons=("", guarantee.OUTSIDE_BOUND),
    ),
    "Gaussian noise": Feature(
        library_plant(truck_trailer, mass=4000.0, delta=0.97),
        {"noise": "gaussian"},
        ("project", "monitor"),
        ("", guarantee.ALARM),
    ),
    "a broken contract": Feature(
        REACTOR,
        {"channel": Channel(loss=0.7), "contract": ChannelContract(2)},
        ("project", "monitor"),
        ("", guarantee.OLD_SAMPLE),
    ),
    "a downlink": Feature(TRUCK, {"channel": SPARSE, "downlink": KEPT, **edge(TRUCK, 0.98)}, ("boundary", "lookahead")),
    "a downlink, starts anywhere": Feature(
        TRUCK, {"channel": SPARSE, "downlink": KEPT}, ("project", "lookahead"), GOES_ON, options=OUTSIDE, count=3
    ),
    "a broken downlink": Feature(
        TRUCK,
        {"downlink": Channel(loss=0.3, delay=1), "downlink_contract": ChannelContract(2)},
        ("project", "lookahead"),
        ("", guarantee.LATE_INPUT),
    ),
    "a downlink without a contract": Feature(TRUCK, {"downlink": Channel(loss=0.1)}, reasons=NEVER),
    "an unstable plant behind a downlink": Feature(
        CART, {"channel": KEPT, "downlink": Channel(delay=2)}, ("project", "lookahead"), count=1
    ),
    "samples on request behind a downlink": Feature(
        CART,
        {
            "channel": ASKED,
            "contract": ChannelContract(9, 1e-4),
            "downlink": Channel(0.5, delay=1, max_consecutive_losses=1),
        },
    ),
}
RESETS = "NextStep", "SameStep"
# Each row with one way to begin anew, in turn; with the other one in the slow tests.
ROWS = [
    pytest.param(name, mode, reset, marks=[pytest.mark.slow] * (number % 2 != RESETS.index(reset)))
    for number, (name, mode) in enumerate((name, mode) for name, feature in FEATURES.items() for mode in feature.modes)
    for reset in RESETS
]


@pytest.mark.cases(7)
@pytest.mark.filterwarnings("ignore:the channel may lose any number of packets in a row")
@pytest.mark.parametrize(("name", "mode", "reset"), ROWS)
def test_scalar_shields_vector_shields_and_loops_agree(name, mode, reset):
    feature = FEATURES[name]
    settings = {"max_episode_steps": 11, "autoreset_mode": reset} | feature.settings
    many = vector_env(feature.count, plant=feature.plant, **settings)
    certificate = certificate_of(feature.plant, many.certificate_contract, feature.safe_set)
    seen = compare(many, 34, feature.options, certificate, mode, (1, 7, 25))
    # Nothing keeps the state in S, and after an outage the error is too large for a while.
    doubts = {guarantee.NOT_KNOWN_INSIDE, guarantee.LARGE_ERROR} if mode == "monitor" else set()
    assert set(feature.reasons) <= seen.reasons <= set(feature.reasons) | doubts
    assert seen.interventions > 0 or mode in ("monitor", "lookahead")
    assert seen.plans > 0 or mode != "lookahead"
    assert seen.forced > 0 or not many.channel.on_request
    assert bool({guarantee.ALARM, guarantee.OUTSIDE_BOUND} & seen.reasons) == (seen.alarms > 0)
    assert many.episodes.min() > 2
