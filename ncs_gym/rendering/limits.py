"""How far a picture's axes reach, and the safe box in two coordinates."""

from __future__ import annotations

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant

# Corners of a polygon outside any axis, in units of the axes' reach.
FAR = 10.0


def row_of(plant: LinearPlant, index: int) -> float | None:
    """Returns the limit of |x_i| where a row of the safe box is about it alone; None elsewhere."""
    alone = [row[index] for row in plant.C if row[index] != 0.0 and np.count_nonzero(row) == 1]
    return 1.0 / max(abs(entry) for entry in alone) if alone else None


def limit_of(plant: LinearPlant, index: int) -> float:
    """Returns the limit of |x_i|, or how far it reaches in the ellipsoid inside the box [its unit]."""
    limit = row_of(plant, index)
    return float(plant.half_widths[index]) if limit is None else limit


def box_in(plant: LinearPlant, pair: tuple[int, int]) -> np.ndarray:
    """Returns the corners, shape (k, 2), of what the rows about two coordinates alone allow these."""
    reach = np.array([limit_of(plant, index) for index in pair])
    corners = FAR * reach * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    others = np.ones(plant.n, dtype=bool)
    others[list(pair)] = False
    for row in plant.C:
        if not row[others].any():
            for sign in (-1.0, 1.0):
                corners = _cut(corners, sign * row[list(pair)])
    return corners


def _cut(corners: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Returns the part of a convex polygon with row @ x <= 1."""
    kept: list[np.ndarray] = []
    excess = corners @ row - 1.0
    for i in range(len(corners)):
        a, b = excess[i - 1], excess[i]
        if (a > 0.0) != (b > 0.0):
            kept.append(corners[i - 1] + a / (a - b) * (corners[i] - corners[i - 1]))
        if b <= 0.0:
            kept.append(corners[i])
    return np.array(kept)


def outline(shape: np.ndarray, count: int = 72) -> np.ndarray:
    """Returns points around the plane ellipse of shape P (2, 2), shape (count, 2)."""
    values, vectors = np.linalg.eigh(shape)
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return circle @ (vectors * np.sqrt(np.maximum(values, 0.0))).T


def number(value: float) -> str:
    """Returns a number for a label: three digits, a true minus sign."""
    text = f"{value:.3g}" if abs(value) >= 1e-12 else "0"
    return text.replace("-", "\N{MINUS SIGN}")


def reading(value: float, limit: float) -> str:
    """Returns a changing value with as many decimals always as its limit asks for."""
    decimals = 2 if not 0.0 < limit < 1e300 else int(np.clip(2 - np.floor(np.log10(limit)), 0, 6))
    value = round(value, decimals) + 0.0  # no minus zero
    text = f"{value:+.{decimals}f}" if abs(value) < 1e6 else f"{value:+.1e}"
    return text.replace("-", "\N{MINUS SIGN}")


def unit_text(unit: str) -> str:
    """Returns a unit as it is printed."""
    return unit.replace("^2", "\N{SUPERSCRIPT TWO}").replace("^3", "\N{SUPERSCRIPT THREE}")


def titled(name: str, unit: str) -> str:
    """Returns the title of an axis."""
    return f"{name} [{unit_text(unit)}]" if unit else name
