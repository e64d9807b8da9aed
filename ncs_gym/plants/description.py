"""A plant for people: its size, its limits and bounds with units, and what is assumed."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

import numpy as np

from ncs_gym.plants.between_samples import BetweenSamples
from ncs_gym.validation import counted

# Columns of the description: where its texts begin, and where they end.
_INDENT, _WIDTH = 16, 80
# What an end of a limit and its operating point differ from each other by rounding, relative to them, is printed as 0.
_ZERO = 1e-12
# Stands for a space at which no line ends.
_UNBROKEN = "\N{NO-BREAK SPACE}"
# What a plant without each kind of uncertainty assumes.
_WITHOUT = ("no disturbance acts on the plant", "the sensors measure without noise", "the first estimate is exact")


def described(plant: BetweenSamples) -> str:
    """Returns the limits, the bounds and the assumptions of a plant for people, with units."""
    counts = ((plant.n, "state"), (plant.m, "input"), (plant.p, "output"))
    sizes = ", ".join(counted(count, name) for count, name in counts)
    radius = f"spectral radius {plant.spectral_radius:.6g}"
    stable = f"stable ({radius})"
    unstable = f"not stable ({radius}): a certificate needs a contract of the channel"
    own = plant.n - plant.past  # past inputs are known, and their rows limit nothing: inputs have limits
    states = plant.state_names[:own], plant.state_units[:own]
    extents = {
        "disturbance": (np.sqrt(np.diag(plant.disturbance.shape_matrix))[:own], *states),
        "sensor noise": (np.sqrt(np.diag(plant.sensor_error.shape_matrix)), *outputs_of(plant)),
        "first error": (np.sqrt(np.diag(plant.initial_error.shape_matrix))[:own], *states),
    }
    lines = {
        "linear plant": [f"{sizes}, a step every {plant.dt:g} s"],
        "dynamics": [stable if plant.spectral_radius < 1.0 else unstable],
        "safe box": [row_limit(plant, j) for j in np.flatnonzero(~plant.is_past_row).tolist()],
        "input limits": [input_limit(plant, i) for i in range(plant.m)],
    }
    if plant.model.delays:
        lines["input limits"].append(f"inputs take effect {counted(plant.model.delays, 'step')} later")
    if len(plant.mixed_rows):
        lines["both together"] = [mixed_limit(plant, j) for j in range(len(plant.mixed_rows))]
    if plant.between_samples is not None:
        lines["safe box"].append(f"at all times: at {plant.between_samples} of each step, and bounded between them")
    for title, (sizes_of, names, units) in extents.items():
        parts = [f"{name} up to {_sized(*each)}" for name, *each in zip(names, sizes_of, units, strict=True)]
        lines[title] = [", ".join(part.replace(" ", _UNBROKEN) for part in parts)]
    lines["assumptions"] = list(assumptions_of(plant))
    shown_lines = (
        fill(text, _WIDTH, initial_indent=f"{title if number == 0 else '':<{_INDENT}}", subsequent_indent=" " * _INDENT)
        for title, texts in lines.items()
        for number, text in enumerate(texts)
    )
    return "\n".join(shown_lines).replace(_UNBROKEN, " ")


def assumptions_of(plant: BetweenSamples) -> tuple[str, ...]:
    """Returns what is assumed of everything uncertain about a plant."""
    first = [plant.initial_cov, *([] if plant.initial_bound is None else [plant.initial_bound.shape_matrix])]
    zero = (
        not np.any(plant.nominal_disturbance.shape_matrix),
        not np.any(plant.nominal_sensor_error.shape_matrix),
        not any(np.any(part) for part in first),
    )
    assumed = [f"It is assumed that {text}." for text, is_zero in zip(_WITHOUT, zero, strict=True) if is_zero]
    noises = {
        "disturbances": plant.process_noise_cov,
        "sensor noise": plant.measurement_noise_cov,
        "the first error": plant.initial_cov,
    }
    if truncated := [name for name, covariance in noises.items() if np.any(covariance)]:
        kept = f"{100.0 * (1.0 - plant.delta):.6g} % (delta = {plant.delta:g}) of {', '.join(truncated)}"
        assumed.append(f"Gaussian noise is truncated: the bounds hold {kept}, not the rest.")
    if plant.remainder is not None:
        assumed.append(plant.remainder.sentence)
    if plant.between_samples is not None:
        assumed.append("What disturbances have done by any time within a step respects the bound of a whole step.")
    return tuple(assumed)


def _sized(size: float, unit: str) -> str:
    return f"{size:.4g} {unit}".rstrip()


def _between(name: str, low: float, high: float, center: float, unit: str) -> str:
    """Returns the limits of a quantity, given its ends from the operating point and that point."""
    farthest = max((abs(end) for end in (low, high) if abs(end) < np.inf), default=np.inf)
    center = 0.0 if abs(center) <= _ZERO * farthest else center
    if center == 0.0 and low == -high:
        return f"|{name}| <= {_sized(high, unit)}"
    point = f" (operating point {center:.6g})" if center else ""
    bottom, top = (0.0 if abs(center + end) <= _ZERO * abs(center) else center + end for end in (low, high))
    if low == -np.inf:
        return f"{name} <= {_sized(top, unit)}{point}"
    if high == np.inf:
        return f"{name} >= {_sized(bottom, unit)}{point}"
    return f"{bottom:.6g} <= {name} <= {_sized(top, unit)}{point}"


def row_limit(plant: BetweenSamples, j: int) -> str:
    """Returns what row j of the safe box limits."""
    row, low, high = plant.box[j], float(plant.box_low[j]), float(plant.box_high[j])
    limited = np.flatnonzero(row).tolist()
    if len(limited) == 1:
        i = limited[0]
        low, high = sorted([low / float(row[i]), high / float(row[i])])
        return _between(plant.state_names[i], low, high, float(plant.operating_state[i]), plant.state_units[i])
    return _sum_between(row, low, high, plant.operating_state, plant.state_names)


def input_limit(plant: BetweenSamples, i: int) -> str:
    """Returns between what input i is."""
    low, high, center = float(plant.input_low[i]), float(plant.input_high[i]), float(plant.operating_input[i])
    return _between(plant.input_names[i], low, high, center, plant.input_units[i])


def mixed_limit(plant: BetweenSamples, j: int) -> str:
    """Returns what row j of the limits of states and inputs together limits."""
    low, high = plant.mixed_ends[:, j].tolist()
    row, center = np.roll(plant.mixed_rows[j], plant.m), np.concatenate([plant.operating_input, plant.operating_state])
    return _sum_between(row, low, high, center, plant.input_names + plant.state_names)


def _sum_between(row: np.ndarray, low: float, high: float, center: np.ndarray, names: Sequence[str]) -> str:
    """Returns the limits of a row of several quantities, given its ends from the operating point, in its own units.

    Those are units of its largest entry.
    """
    size = float(np.abs(row).max())
    terms = "".join(
        f" {'-' if row[i] < 0.0 else '+'} {_factor(abs(float(row[i])) / size)}{names[i]}"
        for i in np.flatnonzero(row).tolist()
    )
    terms = terms.removeprefix(" + ") if terms.startswith(" + ") else f"-{terms[3:]}"
    return _between(terms, low / size, high / size, float(row @ center) / size, "")


def _factor(size: float) -> str:
    return "" if size == 1.0 else f"{size:.4g} "


def outputs_of(plant: BetweenSamples) -> tuple[list[str], list[str]]:
    """Returns the names and units of the outputs: those of the states that are measured alone, else y1, y2."""
    names, units = [], []
    for j, row in enumerate(plant.H):
        measured = np.flatnonzero(row)
        alone = len(measured) == 1 and row[measured[0]] == 1.0
        names.append(plant.state_names[measured[0]] if alone else f"y{j + 1}")
        units.append(plant.state_units[measured[0]] if alone else "")
    return names, units
