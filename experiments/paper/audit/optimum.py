"""The row about where the printed K and M come from: the optimum of OP for other parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.paper.audit.claim import PRINTED_DIGITS, Claim, Defect, Verdict
from experiments.paper.audit.constraints import misread_alpha
from experiments.paper.paper_example import PaperExample
from shields.paper.bounds import PaperBounds
from shields.paper.optimization_problem import OptimizationProblem


def optimum_claim(example: PaperExample) -> Claim:
    """Returns the row about K and M as the optimum of OP at the printed kappa."""
    effort = float((example.K @ example.L @ example.K.T).item())
    asked, limit = (2.0 * effort) ** 0.5, float(example.plant.u_max[0])
    printed = optimum(example, limit)
    other = optimum(example, float(round(asked)))
    complete = optimum(example, float(round(asked)), with_misread_margin=True)
    agrees = np.abs(printed[1] - example.K).max() <= PRINTED_DIGITS
    return Claim(
        f"K and M are the optimum of OP at kappa = {example.kappa}",
        _text(example.L, example.K),
        f"without (C2) and (C4), which alpha enters, the optimum at u_max = {limit:g} has {_text(*printed)}. As "
        f"sqrt(2 K L K') = {asked:.3f}, try u_max = {round(asked)}: without them the optimum has {_text(*other)}. All "
        f"of OP with the printed epsilon, but gamma in place of its square root in alpha (alpha = "
        f"{misread_alpha(example):.2f}): {_text(*complete)}",
        Verdict.of(bool(agrees)),
        f"within the rounding of kappa they are OP's optimum for u_max = {round(asked)} and that alpha: the first "
        "explains rows 5 and 6, the second rows 3 and 7"
        if np.abs(complete[1] - example.K).max() <= PRINTED_DIGITS
        else "",
        "" if agrees else Defect.INPUT_LIMIT,
    )


def optimum(example: PaperExample, u_max: float, *, with_misread_margin: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Returns L, shape (2, 2), and K, shape (1, 2), of the largest set that OP finds at the printed kappa.

    Args:
        example: The printed numbers.
        u_max: Input limit in place of the printed one [m/s^2].
        with_misread_margin: True keeps all of OP, with gamma in place of its square root in alpha. False drops (C2)
            and (C4), the constraints that alpha enters, and with (C4) the communication error in the input limit.

    Raises:
        ArithmeticError: If the solver finds no optimum.
    """
    plant = replace(example.plant, u_max=u_max)
    # The smallest rho, to two digits, that (C7) allows for the printed set.
    rho = float(np.ceil(100.0 * np.linalg.cond(example.L)) / 100.0)
    g_bar = (example.kappa * rho) ** 0.5
    epsilon_up = example.epsilon / (g_bar + float(np.linalg.norm(plant.A, 2))) ** 2  # Theorem 3, solved for epsilon_up
    if not with_misread_margin:
        rho = 1.0 / example.kappa
    bounds = PaperBounds(example.kappa, rho, epsilon_up, example.epsilon, misread_alpha(example))
    problem = OptimizationProblem(plant)
    found = problem.solution(bounds, with_margin=with_misread_margin, with_error=with_misread_margin)
    if found is None:
        raise ArithmeticError(f"the solver found no optimum of OP at u_max = {u_max:g}")
    return found.L, found.K


def _text(L: np.ndarray, K: np.ndarray) -> str:
    """Returns K, the off-diagonal entry of M and the effort."""
    gain = ", ".join(f"{entry:.4f}" for entry in K.ravel())
    effort = float((K @ L @ K.T).item())
    return f"K = [{gain}], M12 = {float(np.linalg.inv(L)[0, 1]):.2e}, K L K' = {effort:.2f}"
