"""A plant for people: its size, its limits and bounds with units, and what is assumed."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from ncs_gym.validation import counted

if TYPE_CHECKING:
    from ncs_gym.plants.linear_plant import LinearPlant

# Columns of the description: where its texts begin, and where they end.
_INDENT, _WIDTH = 16, 80
# What an end of a limit and its operating point differ from each other by rounding, relative to them, is printed as 0.
_ZERO = 1e-12
# Stands for a space at which no line ends.
_UNBROKEN = "\N{NO-BREAK SPACE}"
_WITHOUT = ("no disturbance acts on the plant", "the sensors measure without noise", "the first estimate is exact")
_NOISES = ("disturbances", "sensor noise", "the first error")


def described(plant: LinearPlant) -> str:
    """Returns limits, bounds and assumptions for people, with units."""
    sizes = ", ".join(counted(*each) for each in ((plant.n, "state"), (plant.m, "input"), (plant.p, "output")))
    radius = f"spectral radius {plant.spectral_radius:.6g}"
    unstable = f"not stable ({radius}): a certificate needs a contract of the channel"
    k, together = len(plant.box), len(plant.box) + plant.m
    lines = {
        "linear plant": [f"{sizes}, a step every {plant.dt:g} s"],
        "dynamics": [f"stable ({radius})" if plant.spectral_radius < 1.0 else unstable],
        "safe box": [row_limit(plant, j) for j in np.flatnonzero(~plant.is_past_row).tolist()],
        "input limits": [row_limit(plant, j) for j in range(k, together)],
        "both together": [row_limit(plant, j) for j in range(together, together + len(plant.mixed_rows))],
    }
    if longest := int(plant.model.delays.max()):
        up_to = "up to " if np.ptp(plant.model.delays) else ""
        lines["input limits"].append(f"inputs take effect {up_to}{counted(longest, 'step')} later")
    if plant.between_samples is not None:
        lines["safe box"].append(f"at all times: at {plant.between_samples} of each step, and bounded between them")
    own = plant.n - plant.past  # past inputs are known, and their rows limit nothing: inputs have limits
    states = plant.state_names[:own], plant.state_units[:own]
    outputs = of_outputs(plant.H, plant.state_names), of_outputs(plant.H, plant.state_units, "")
    for title, bound, (names, units) in (
        ("disturbance", plant.disturbance, states),
        ("sensor noise", plant.sensor_error, outputs),
        ("first error", plant.initial_error, states),
    ):
        extents = zip(names, np.sqrt(np.diag(bound.shape_matrix)), units, strict=False)
        parts = [f"{name} up to {_sized(size, unit)}".replace(" ", _UNBROKEN) for name, size, unit in extents]
        lines[title] = [", ".join(parts)]
    lines["assumptions"] = [*assumptions_of(plant)]
    shown_lines = (
        fill(text, _WIDTH, initial_indent=f"{title if number == 0 else '':<{_INDENT}}", subsequent_indent=" " * _INDENT)
        for title, texts in lines.items()
        for number, text in enumerate(texts)
    )
    return "\n".join(shown_lines).replace(_UNBROKEN, " ")


def assumptions_of(plant: LinearPlant) -> tuple[str, ...]:
    """What a certificate takes for granted beyond numbers, in sentences."""
    held = plant.nominal_disturbance, plant.nominal_sensor_error, plant.nominal_initial_error
    without = zip(_WITHOUT, held, strict=True)
    assumed = [f"It is assumed that {text}." for text, each in without if not each.shape_matrix.any()]
    noises = zip(_NOISES, (plant.process_noise_cov, plant.measurement_noise_cov, plant.initial_cov), strict=True)
    if truncated := [name for name, covariance in noises if covariance.any()]:
        kept = f"{100.0 * (1.0 - plant.delta):.6g} % (delta = {plant.delta:g}) of {', '.join(truncated)}"
        assumed.append(f"Gaussian noise is truncated: the bounds hold {kept}, not the rest.")
    if plant.remainder is not None:
        assumed.append(plant.remainder.sentence)
    if plant.between_samples is not None:
        assumed.append("What disturbances have done by any time within a step respects the bound of a whole step.")
    return tuple(assumed)


def row_limit(plant: LinearPlant, j: int) -> str:
    """Returns what limit j of the safe box, the inputs and both together says; that of a sum in its largest entry."""
    n, m = plant.n, plant.m
    rows = [np.pad(plant.box, ((0, 0), (m, 0))), np.eye(m, m + n), np.roll(plant.mixed_rows, m, axis=1)]
    ends = np.concatenate([plant.box_ends, plant.input_ends, plant.mixed_ends], axis=1)
    row, names = np.concatenate(rows)[j], plant.input_names + plant.state_names
    limited, center = np.flatnonzero(row).tolist(), np.concatenate([plant.operating_input, plant.operating_state])
    size, unit = np.abs(row).max(), ""
    if len(limited) == 1:
        size, unit = row[limited[0]], (plant.input_units + plant.state_units)[limited[0]]
    factors = [(row[i] / size, names[i]) for i in limited]
    terms = [f"{'-' if each < 0.0 else '+'} {_factor(abs(each))}{name}" for each, name in factors]
    name = " ".join(terms).removeprefix("+ ")
    name = f"-{name[2:]}" if name.startswith("- ") else name
    (low, high), center = sorted((ends[:, j] / size).tolist()), float(row @ center / size)
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


def _sized(size: float, unit: str) -> str:
    return f"{size:.4g} {unit}".rstrip()


def _factor(size: float) -> str:
    return "" if size == 1.0 else f"{size:.4g} "


def of_outputs(H: np.ndarray, of_states: Sequence[str], otherwise: str = "y{}") -> list[str]:
    """Returns names, or units, of outputs: those of states that are measured alone, else y1, y2, ..."""
    alone = (np.abs(H).sum(axis=1) == 1.0) & (H.max(axis=1) == 1.0)
    return [str(of_states[row.argmax()]) if alone[j] else otherwise.format(j + 1) for j, row in enumerate(H)]
