"""What hypothesis draws to attack the project with, and how often."""

from __future__ import annotations

from datetime import date
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from ncs_gym import (
    BoxDisturbance,
    Channel,
    Ellipsoid,
    GilbertElliott,
    LinearPlant,
    Regulation,
    SetpointTracking,
    SpeedTracking,
)
from ncs_gym.tasks import farthest_equilibrium
from tests.product import linear_plant


def examples(count: int, *, same: bool = True) -> settings:
    """Settings for some examples: the same ones in every run, or new ones (for what is not part of the quick suite)."""
    slow = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
    return settings(max_examples=count, derandomize=same, deadline=None, database=None, suppress_health_check=slow)


def covariance(rng: np.random.Generator, size: int, scale: np.ndarray, rank: int) -> np.ndarray:
    """A random covariance of some rank (0: none) in units of `scale`."""
    factor = scale[:, None] * rng.standard_normal((size, rank))
    product = factor @ factor.T
    return 0.5 * (product + product.T)


@st.composite
def plants(draw, most_states=6, most_inputs=3, radius=(0.0, 0.98), units=6.0, unit=None) -> LinearPlant:
    """A stable plant of any size, in units up to 10^`units` away from the box, with flat and full bounds."""
    n, m = draw(st.integers(1, most_states), label="n"), draw(st.integers(1, most_inputs), label="m")
    p = draw(st.integers(1, n), label="p")
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1), label="seed"))
    spread = draw(st.sampled_from([0.0, 0.5 * units, units]), label="decades")
    scale = 10.0 ** rng.uniform(-spread, spread, n)
    A = rng.standard_normal((n, n))
    A *= draw(st.floats(*radius), label="radius") / max(float(np.abs(np.linalg.eigvals(A)).max()), 1e-9)
    C = np.eye(n) if draw(st.booleans(), label="box") else rng.standard_normal((n + 1, n))
    H = None if draw(st.booleans(), label="H") else rng.standard_normal((p, n)) / scale
    y = scale if H is None else np.ones(p)
    sizes = [draw(st.sampled_from([0.0, 1e-6, 1e-3]), label=name) for name in ("Q", "R", "P0")]
    ranks = [draw(st.integers(0, size), label="rank") for size in (n, len(y), n)]
    noises = [
        size**2 * covariance(rng, len(units), units, rank)
        for size, rank, units in zip(sizes, ranks, (scale, y, scale), strict=True)
    ]
    return linear_plant(
        A=scale[:, None] * A / scale,
        B=scale[:, None] * rng.standard_normal((n, m)),
        box=C / scale,
        u_max=draw(st.sampled_from([1e-3, 1.0, 1e3]), label="u_max"),
        dt=draw(st.sampled_from([1e-3, 0.1, 10.0]), label="dt"),
        gamma=draw(st.sampled_from([0.0, 1e-6, 1e-3]), label="gamma") * float(scale.min()) ** 2,
        H=H,
        process_noise_cov=noises[0],
        measurement_noise_cov=noises[1],
        initial_cov=noises[2],
        delta=draw(st.sampled_from([1e-6, 0.05, 0.9]), label="delta"),
    )


def channels() -> st.SearchStrategy[Channel]:
    """A network of any kind."""
    share = st.sampled_from([0.0, 0.3, 0.9, 1.0]) | st.floats(0.0, 1.0)
    bursts = st.builds(GilbertElliott, p_good_to_bad=share, p_bad_to_good=share, loss_good=share, loss_bad=share)
    return st.builds(
        Channel,
        loss=share | bursts,
        quantization_step=st.sampled_from([0.0, 1e-6, 0.05, 10.0]),
        send_period=st.integers(1, 5),
        delay=st.integers(0, 4),
        jitter=st.integers(0, 3),
        max_consecutive_losses=st.none() | st.integers(0, 4),
    )


@st.composite
def tasks(draw, plant: LinearPlant) -> Any:
    """A task that suits a plant."""
    kind = draw(st.sampled_from(["regulation", "costs", "speed", "setpoint"]), label="task")
    if kind == "speed":
        return SpeedTracking(fastest=draw(st.sampled_from([1e-3, 25.0, 1e6])), input_index=plant.m - 1)
    if kind == "setpoint" and (farthest := farthest_equilibrium(plant, plant.box[0])) > 1e-6:
        reach = min(draw(st.sampled_from([1e-6, 0.5, 1e6])), farthest)
        preview, price = draw(st.sampled_from([0, 3])), draw(st.sampled_from([0.0, 0.5]))
        return SetpointTracking(output=plant.box[0], reach=reach, width=0.1, preview=preview, change_price=price)
    if kind == "costs":
        return Regulation(state_cost=plant.box.T @ plant.box, input_cost=np.zeros((plant.m, plant.m)))
    return Regulation()


@st.composite
def environment_settings(draw, **limits: Any) -> dict[str, Any]:
    """Settings of an environment: a plant, a channel, a task and a disturbance that fit each other."""
    plant = draw(plants(**limits))
    names = ["ball", "box", "sinusoid", "sphere", "adversarial"]
    disturbance = draw(st.sampled_from([*names, BoxDisturbance(np.zeros(plant.n))]), label="disturbance")
    start = draw(st.sampled_from([None, 0.0, 0.9]), label="start")
    around = None if start is None else Ellipsoid(start**2 * np.diag(plant.half_widths**2) / plant.n)
    return {
        "plant": plant,
        "channel": draw(channels()),
        "task": draw(tasks(plant)),
        "disturbance": disturbance,
        "initial_set": around,
        "terminate_on_violation": draw(st.booleans(), label="terminates"),
    }


class Hostile:
    """Raises whatever it is asked."""

    def __float__(self):
        raise RuntimeError("no")

    __array__ = __bool__ = __len__ = __iter__ = __repr__ = __int__ = __index__ = __float__


# No number, no matrix and no setting at all.
NOTHING_USABLE = [
    "1",
    "",
    b"1",
    1j,
    object(),
    Hostile(),
    {},
    {"a": 1},
    date(2020, 1, 1),
    np.datetime64("2020-01-01"),
    [[1.0], [1.0, 2.0]],
    [None],
    ["1"],
    np.ma.masked_array([1.0], mask=[True]),
    np.array([1.0 + 1.0j]),
    np.zeros((0, 0)),
    np.zeros((1, 1, 1, 1)),
    lambda: 1.0,
    int,
    ...,
]
# Numbers that no setting can have.
WRONG_NUMBERS = [np.nan, np.inf, -np.inf, -1.0, True, np.True_, 10**400, -(10**400), 1e300, np.float64(1e76), [1.0]]
