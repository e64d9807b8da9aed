"""Why a design problem is infeasible: what binds, and by how much."""

from __future__ import annotations

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.estimation.error_bound import unseen_state
from ncs_gym.limits import FREE_REACH
from ncs_gym.plants.linear_plant import row_limit
from shields.errors import Infeasible
from shields.synthesis.tolerance import Tolerated


def infeasibility(plant: LinearPlant, tolerated: Tolerated | None, *, polytope: bool, reason: str = "") -> Infeasible:
    """Returns the exception that names the binding condition and the fraction of the radii that is feasible.

    `tolerated` is what the best gain bears, `reason` why the polytope of one that bears the radii was given up.
    """
    if tolerated is None:
        unmoved = unseen_state(plant.A.T, plant.B.T, 1.0 / plant.half_widths, plant.state_names)
        if unmoved is None:
            return Infeasible("(I) no gain was found that stabilizes the plant, whatever the bounds are", "I", 1.0)
        what = f"(I) no gain stabilizes the plant: no input moves {unmoved}, which does not decay by itself"
        return Infeasible(what, "I", 1.0)
    if polytope and tolerated.margin >= 1.0:
        what = "(P) a gain bears disturbances and errors within the limits, but its polytope was not found"
        return Infeasible(f"{what}: {reason}", "P", 0.0)
    k, m, binding = len(plant.box), plant.m, tolerated.binding
    fraction = min(tolerated.margin, 1.0)
    missing = "set within the limits" if polytope else "ellipsoid in the box"
    what = (
        "(U) no gain was found that keeps the input limits"
        if binding and all(k <= j < k + m for j in binding)
        else f"(I) no invariant {missing} was found"
    )
    own = k + m + len(plant.mixed_rows)  # rows beyond are those of the box at other times of a step
    limits = [row_limit(plant, j if j < own else (j - own) % k) for j in binding]
    named = f" (those that bind: {', '.join(dict.fromkeys(limits))})" if limits else ""
    once = f"a quick search finds one once disturbance and error radii shrink to {100.0 * fraction:.3g}% of those given"
    return Infeasible(f"{what}{named}: {once}", what[1], 1.0 - fraction)


def with_limits_out_of_proportion(infeasible: Infeasible, plant: LinearPlant) -> Infeasible:
    """Returns the exception with the limits that a bound exceeds alone, and those that nothing comes near."""
    two_ends = np.flatnonzero(np.isfinite(plant.box_ends).all(axis=0)).tolist()
    alone = {
        "the disturbance of one step": plant.nominal_disturbance,
        "the error of the first estimate": plant.nominal_initial_error,
    }
    said = [
        f"{what} alone reaches {size:.3g} times the limit {row_limit(plant, j)}"
        for what, shape in alone.items()
        for j, size in enumerate(np.ravel(shape.support(plant.box)).tolist())
        if size >= 1.0 and j in two_ends
    ]
    of_one_state = (np.count_nonzero(plant.box, axis=1) == 1) & ~plant.is_past_row
    out_of_reach = np.abs(plant.box) @ (FREE_REACH * plant.reach_from_rest) < 1.0
    far = [row_limit(plant, j) for j in np.flatnonzero(of_one_state & out_of_reach).tolist()]
    if far:
        said.append(
            f"inputs and disturbances take no state to a hundredth of {', '.join(far)} in {plant.n} steps: leave out "
            "limits that stand for none"
        )
    return Infeasible("; ".join([str(infeasible), *said]), infeasible.binding, infeasible.shortfall)
