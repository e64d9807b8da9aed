"""The one door through which tests make plants, loops, shields and certificates of the product.

Where a constructor changes, this file translates; `tests/test_product.py` finds the calls that go past it. Tests
describe a plant by its parts: `A`, `B`, `H`, `dt`, limits (`box`, `u_max`, ...) and bounds (`gamma`, covariances,
`disturbance_bound`, ...), of which `described` makes the values of a `LinearPlant`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np

import ncs_gym
import shields
from ncs_gym import Ball, Bounds, Box, Ellipsoid, Gaussian, Limits, LinearPlant, Model, Sum, Through
from ncs_gym.ellipsoid import UncertainSet
from ncs_gym.estimation.estimator import Belief
from ncs_gym.plants import family as families
from ncs_gym.validation import as_setting
from shields.runtime.set_test import PredictedErrors

_SOURCES = (
    ("disturbance", "process_noise_cov", "disturbance_bound"),
    ("sensor", "measurement_noise_cov", "sensor_bound"),
    ("first_error", "initial_cov", "initial_bound"),
)


def belief(estimate: np.ndarray, alarm: Any = False) -> Belief:
    """What a monitor is told of one loop, or of N."""
    table: Any = None
    return Belief(estimate, 0, table, 0, alarm, False, False, estimate, estimate)


def staying(errors: PredictedErrors) -> PredictedErrors:
    """The same, with error sets that are known to stay where they are certified."""
    return errors._replace(stays=np.ones_like(errors.certified) if np.ndim(errors.certified) else True)


def linear_plant(**described: Any) -> LinearPlant:
    """A plant by its matrices, limits and bounds."""
    model = Model(**{"H": None} | _of_model(described))
    return _made(model, described)


def sampled_plant(model: Any, dt: float | None = None, **described: Any) -> LinearPlant:
    """A plant sampled from a state-space model: (A, B, C, D), or an object that has them."""
    return _made(replace(Model.of(model, dt), **_of_model(described)), described)


def library_plant(make: Callable[..., LinearPlant], *physical: Any, **described: Any) -> LinearPlant:
    """A plant of the library with limits and bounds that are not its own."""
    own = {
        name: described.pop(name)
        for name in ("dt", "mass", "speed", "full_state", "length", "pole_mass", "lag")
        if name in described
    }
    return altered(make(*physical, **own), **described)


def altered(plant: LinearPlant, **described: Any) -> LinearPlant:
    """The plant with other matrices, limits or bounds."""
    described = dict(described)
    model = replace(plant.model, **_of_model(described))
    limits, bounds, labels = (
        _limits(plant, model, described),
        _bounds(plant.bounds, described, model),
        _labels(plant, described),
    )
    if described:
        raise TypeError(f"no part of a plant: {sorted(described)}")
    return replace(plant, model=model, limits=limits, bounds=bounds, labels=labels)


def _made(model: Model, described: dict[str, Any]) -> LinearPlant:
    limits = _limits(None, model, described)
    plant = LinearPlant(model, limits, _bounds(Bounds(*[Sum(())] * 3), described, model), _labels(None, described))
    if described:
        raise TypeError(f"no part of a plant: {sorted(described)}")
    return plant


def _of_model(described: dict[str, Any]) -> dict[str, Any]:
    """Takes what belongs to a model out of a description."""
    names = {"continuous_model": "continuous", "input_delay": "delays"}
    own = {
        names.get(name, name): described.pop(name) for name in [*described] if name in (*names, *"ABH", "dt", "offset")
    }
    if (delays := own.get("delays", 0)) is None:
        own["delays"] = 0 if delays is None else delays
    point = tuple(described.pop(f"operating_{name}", None) for name in ("state", "input"))
    return own | ({} if all(each is None for each in point) else {"at": point})


def _limits(plant: LinearPlant | None, model: Model, described: dict[str, Any]) -> Limits:
    """The limits of a description, those of a plant where it says nothing; in deviations but for pairs."""
    names = ("box", "box_ends", "state_limits", "output_limits", "mixed_limits", "mixed_rows", "mixed_ends")
    names += ("u_max", "input_limits", "input_ends", "du_max", "between_samples")
    given = {name: described.pop(name) for name in names if name in described}
    if plant is not None and plant.limits.rate is not None and "mixed_ends" in given:
        given |= _without_rates(plant, given)
    own = Limits(input=1.0) if plant is None else plant.limits
    if model.at is not None and plant is not None:
        own = _around(own, model)
    point = np.concatenate([model.state, model.input])
    of_states = [each for each in own.rows if each[1] is None]
    mixed = [each for each in own.rows if each[1] is not None]
    state, n = own.state, len(model.A)
    if given.get("state_limits") is not None:
        state, of_states = _pair(given["state_limits"], n), []
        state = None if np.isinf(state).all() else state
    if given.get("box") is not None:
        box, ends = as_setting(given["box"]), given.get("box_ends")
        ends = (
            np.array([[-1.0], [1.0]]) * np.ones(len(box) if box.ndim == 2 else n) if ends is None else np.asarray(ends)
        )
        if box.ndim == 2:
            state, of_states = (
                None,
                [(row, None, *(end + row @ model.state)) for row, end in zip(box, ends.T, strict=True)],
            )
        elif "box_ends" in given and given["box_ends"] is not None:
            state, of_states = (model.state + ends[0] * box, model.state + ends[1] * box), []
        else:
            state, of_states = (model.state - box, model.state + box) if model.at is not None else box, []
    elif given.get("box_ends") is not None and plant is not None:
        rows = zip(plant.box, np.asarray(given["box_ends"]).T, strict=True)
        state, of_states = None, [(row, None, *(end + row @ model.state)) for row, end in rows]
    of_states = [*of_states, *((row, None, *ends) for row, *ends in given.get("output_limits") or ())]
    if "mixed_limits" in given or "mixed_rows" in given or "mixed_ends" in given:
        rows = given.get("mixed_rows", None if plant is None or "mixed_ends" not in given else plant.mixed_rows)
        kept = mixed if "mixed_rows" not in given and "mixed_ends" not in given else []
        mixed = [*kept, *(given.get("mixed_limits") or ())]
        if rows is not None and len(rows):
            ends = given.get("mixed_ends")
            ends = np.array([[-1.0], [1.0]]) * np.ones(len(rows)) if ends is None else np.asarray(ends)
            mixed = [(row[:n], row[n:], *(end + row @ point)) for row, end in zip(rows, ends.T, strict=True)] + mixed
    inputs = own.input
    if given.get("u_max") is not None:
        widths = np.asarray(given["u_max"], dtype=float)
        inputs = (model.input - widths, model.input + widths) if model.at is not None else widths
    if given.get("input_limits") is not None:
        inputs = _pair(given["input_limits"], len(model.input))
    if given.get("input_ends") is not None:
        inputs = tuple(model.input + np.asarray(each) for each in given["input_ends"])
    rate, points = given.get("du_max", own.rate), given.get("between_samples", own.between_samples)
    return Limits(state, inputs, (*of_states, *mixed), rate, points)


def _without_rates(plant: LinearPlant, given: dict[str, Any]) -> dict[str, Any]:
    """What a description says of coupled rows and of rates, which are the last of these; nothing is a loose rate."""
    if given["mixed_ends"] is None:
        return {"du_max": 1.99 * plant.input_half}
    own, n = len(plant.mixed_rows) - plant.m, plant.n - plant.past
    rows = np.hstack([plant.mixed_rows[:own, :n], plant.mixed_rows[:own, plant.n :]])
    rate = plant.limits.rate * given["mixed_ends"][1][own:]
    return {"du_max": rate, "mixed_rows": rows, "mixed_ends": np.asarray(given["mixed_ends"])[:, :own]}


def _pair(limits: Any, size: int) -> tuple[np.ndarray, ...]:
    return tuple(np.broadcast_to(np.asarray(end, dtype=float), (size,)) for end in limits)


def _around(limits: Limits, model: Model) -> Limits:
    """Half-widths as pairs around the point of a model."""
    pairs = {}
    for name, point in (("state", model.state), ("input", model.input)):
        value = getattr(limits, name)
        if value is not None and not (isinstance(value, tuple) and len(value) == 2 and np.ndim(value[0])):
            widths = np.asarray(value, dtype=float)
            if widths.shape in ((), point.shape):
                pairs[name] = (point - widths, point + widths)
    return replace(limits, **pairs)


def _bounds(bounds: Bounds, described: dict[str, Any], model: Model) -> Bounds:
    """The bounds of a description, given ones where it says nothing."""
    made, delta = {}, described.pop("delta", None)
    for name, covariance, bound in _SOURCES:
        parts = Sum((getattr(bounds, name),)).parts
        balls = [each for each in parts if isinstance(each, Ball) and name == "disturbance"]
        noises = [each for each in parts if isinstance(each, Gaussian)]
        left_out = [each for each in parts if each.is_left_out]
        others = [each for each in parts if not any(each is one for one in (*balls, *noises, *left_out))]
        if name == "disturbance" and "gamma" in described:
            balls = [Ball(np.sqrt(gamma))] if (gamma := described.pop("gamma")) else []
        if name == "disturbance" and "remainder" in described:
            left_out = [] if (remainder := described.pop("remainder")) is None else [remainder]
        if covariance in described:
            noise = described.pop(covariance)
            noises = [] if noise is None else [Gaussian(noise, 0.05 if delta is None else delta)]
        elif delta is not None:
            noises = [Gaussian(each.covariance, delta) for each in noises]
        elif name == "sensor" and noises and len(noises[0].covariance) != len(model.H):
            noises = [Gaussian(each.covariance[0, 0] * np.eye(len(model.H)), each.delta) for each in noises]
        if bound in described:
            others = _others(described.pop(bound), len(model.A) if name == "disturbance" else None)
        made[name] = Sum((*balls, *noises, *others, *left_out))
    return Bounds(**made)


def _others(value: Any, n: int | None) -> list[Any]:
    """The set of a declared bound: a radius, half-widths, an ellipsoid, or (E, w) or (E, low, high) through E."""
    if value is None:
        return []
    if isinstance(value, tuple | list) and len(value) in (2, 3) and getattr(value[0], "ndim", np.ndim(value[0])) == 2:
        return [Through(value[0], value[1] if len(value) == 2 else Box(*value[1:]))]
    if isinstance(value, UncertainSet) or np.ndim(value):
        return [value]
    return [Ball(value) if n is None else Ellipsoid(np.square(value) * np.eye(n))]


def _labels(plant: LinearPlant | None, described: dict[str, Any]) -> Mapping[str, Any] | None:
    labels = dict((plant and plant.labels) or {})
    for kind, letter in (("state", "x"), ("input", "u")):
        names, units = (described.pop(f"{kind}_{part}", None) for part in ("names", "units"))
        if names or units:
            own = labels.get(f"{kind}s", {})
            names = names or [*own] or [f"{letter}{i + 1}" for i in range(len(units))]
            labels[f"{kind}s"] = dict(zip(names, units or [*own.values()] or [""] * len(names), strict=True))
    return labels or None


def linear_model(process: Any, box: Any = None, u_max: Any = None, dt: Any = None, **described: Any) -> LinearPlant:
    """The linear model of a process, with what it leaves out."""
    described |= {} if box is None else {"box": box}
    described |= {} if u_max is None else {"u_max": u_max}
    A, B, delays = described.pop("A", None), described.pop("B", None), described.pop("input_delay", 0)
    sizes = [("operating_state", "box", "state_limits"), ("operating_input", "u_max", "input_limits")]
    n, m = (
        max(
            (np.shape(part)[-1] for name in names if name in described for part in _parts(name, described[name])),
            default=1,
        )
        for names in sizes
    )
    model = Model(
        np.zeros((n, n)), np.zeros((n, m)), None, dt, **{k: v for k, v in _of_model(described).items() if k == "at"}
    )
    limits, bounds = _limits(None, model, described), _bounds(Bounds(*[Sum(())] * 3), described, model)
    labels = _labels(None, described)
    if A is not None or B is not None:
        described["matrices"] = (A, B)
    plant = ncs_gym.linear_model(process, limits, bounds, dt, at=model.at, labels=labels, **described)
    return replace(plant, model=plant.model.with_delays(delays)) if delays else plant


def _parts(name: str, value: Any) -> list[np.ndarray]:
    return [np.atleast_1d(each) for each in (value if name.endswith("limits") else [value])]


def family_of(members: Any, ranges: Any = None, **settings: Any) -> LinearPlant:
    """A plant of which several members, or ranges of parameters, are possible; a function is called in few points."""

    def check(*of: Any, whole: Any = families._check_monotone) -> None:
        with mock.patch.object(families, "grid_size", return_value=4):
            whole(*of)

    with mock.patch.object(families, "_check_monotone", check):
        return ncs_gym.family(members, ranges, **settings)


def rate_limited(plant: LinearPlant, largest: Any) -> LinearPlant:
    """The plant whose inputs change by so much from one step to the next at most."""
    return replace(plant, limits=replace(plant.limits, rate=largest))


# One loop, several loops, and those that gymnasium makes of a plant or of an id.
loop_env = ncs_gym.NCSEnv
vector_env = ncs_gym.NCSVectorEnv


def gym_env(env_id: str = "ncs_gym/LinearNCS-v0", **settings: Any) -> gym.Env:
    """The environment that `gym.make` gives for a plant, or for an id."""
    return gym.make(env_id, **settings)


def gym_vector_env(num_envs: int, env_id: str = "ncs_gym/LinearNCS-v0", **settings: Any) -> gym.vector.VectorEnv:
    """The environment that `gym.make_vec` gives for a plant, or for an id."""
    return gym.make_vec(env_id, num_envs, **settings)


# Environments behind a shield, what decides on inputs alone, and the controller's side of a loop.
safety_shield = shields.SafetyShield
vector_shield = shields.VectorSafetyShield
safety_filter = shields.SafetyFilter
safe_loop = shields.SafeLoop


def loop_step(loop: Any, proposed: Any, packets: Any = (), **more: Any) -> Any:
    """What a `SafeLoop` decides after it has received."""
    loop.receive(packets, **more)
    return loop.decide(proposed)


# Certificates that are made here, of this method and of the published one.
synthesize = shields.synthesize
paper_synthesis = shields.paper.synthesize
