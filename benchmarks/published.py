"""What certificates keep of plants that people published: `python -m benchmarks.published COMMAND`.

Commands: shares, attack, impossible, board.
"""

from __future__ import annotations

import ctypes
import json
import math
import subprocess
import tempfile
import time
from collections import Counter
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy import sparse
from scipy.optimize import linprog

from benchmarks.commands import run, table
from experiments.commands.attack import attacked, channels_of, worst_case
from ncs_gym import Bounds, Box, Channel, ChannelContract, Ellipsoid, Limits, LinearPlant, Model, NCSVectorEnv, Through
from ncs_gym.model import zero_order_hold
from ncs_gym.registration import EPISODE_STEPS
from shields import Certificate, Infeasible, VectorSafetyShield, reach_of, synthesize, verify
from shields.export import BoardTable, export_c
from shields.export.board_filter import GUARANTEED
from shields.polytope import Polytope
from shields.synthesis.invariant_polytope import points_of_box

# From so many points, a power of two, inputs are sought that keep the limits for so many steps.
_POINTS_LOG2, _STEPS = 9, 60
# After so many samples errors that are hidden in noise are sought.
_CYCLES = (1, 2, 4, 8, 16, 32)
# A constant disturbance that nothing balances is sought by so many linear programs from every state.
_TURNS = 4
_SIDES = {"low": -np.inf, "high": np.inf}
# Plants whose filters are attacked in C: limits of two ends, free states, unstable ones, outputs and registers.
_ON_BOARDS = (
    *("ctms_cruise", "fbs_cruise", "ctms_motor_pos", "lane_keeping", "acc_mathworks"),
    *("cstr_pcgym", "ampyc_sf", "boost", "bicycle", "heat_exchanger"),
)
# An episode of such an attack takes so many steps; another row of the safe set is aimed at every so many.
_EPISODE, _PATIENCE = 250, 25
Names = tyro.conf.Positional[tuple[str, ...]]


@cache
def published() -> dict[str, dict[str, Any]]:
    """Returns what was published of each plant by its name: source, model, limits, disturbance, sensors and network."""
    return json.loads(Path(__file__).with_name("published_plants.json").read_text("utf-8"))


def plant_of(name: str) -> LinearPlant:
    """Returns a published plant with its limits as they are.

    Disturbances of a model in continuous time are constant over a step. Where no state has a published limit, all have
    those that the file invents. The smallest ellipsoid around a box of first errors suits each state alike; where
    another one is needed, the file has its half-axes.
    """
    p = published()[name]
    A, n, dt = np.array(p["A"]), len(p["A"]), p["dt"]
    state = np.zeros(n) if p["operating_state"] is None else np.array(p["operating_state"])
    low, high = _ends(p["state_low"], -np.inf), _ends(p["state_high"], np.inf)
    if not (np.isfinite(low) | np.isfinite(high)).any():
        widths = np.array([p["invented_half_widths"].get(str(i), np.inf) for i in range(n)])
        low, high = state - widths, state + widths
    is_continuous = p["time"] == "continuous"
    E = np.array(p["disturbance_matrix"])
    E = zero_order_hold(A, E, dt)[1] if is_continuous else E
    outputs = [
        (row := each["row"], None, *(_end(each[side], end) + np.dot(row, state) for side, end in _SIDES.items()))
        for each in p["output_rows"]
    ]
    made = Model.sampled if is_continuous else Model
    disturbance = Through(E, Box(p["disturbance_low"], p["disturbance_high"]))
    first, axes = p["first_error_half_widths"], p.get("first_error_half_axes")
    return LinearPlant(
        made(A, p["B"], p["C"], dt, (state, p["operating_input"])).with_delays(p.get("input_delays")),
        Limits((low, high), (p["input_low"], p["input_high"]), outputs),
        Bounds(disturbance, p["sensor_half_widths"], first if axes is None else Ellipsoid(np.diag(np.square(axes)))),
    )


def _ends(ends: list[float | None], infinite: float) -> np.ndarray:
    return np.array([_end(each, infinite) for each in ends])


def _end(end: float | None, infinite: float) -> float:
    return infinite if end is None else end


def contract_of_plant(name: str) -> ChannelContract:
    """Returns what the network of a published plant promises."""
    return ChannelContract(max_age=published()[name]["max_age"])


def channel_of(name: str) -> Channel:
    """Returns a channel that keeps this contract."""
    return Channel(**published()[name]["channel"])


def shares(names: Names = ()) -> None:
    """What share of the published box a certificate keeps, and how long the processor works for it, verified twice.

    Where that is not known, "to 90 %" is how far every limited quantity gets at least on the way to its limits.
    The last line says how many of the plants have a certificate.
    """
    show = table("plant", "n, m", "age", "limits", "share", "at most", "rows", "CPU [s]", first=18, width=11)
    found = 0
    for name in names or published():
        began, plant = time.process_time(), plant_of(name)
        free = plant.n - int(np.linalg.matrix_rank(plant.box))
        limits = f"{free} free" if free else "symmetric" if plant.is_symmetric else "two ends"
        known = f"{plant.n}, {plant.m}", published()[name]["max_age"], limits
        try:
            certificate = certified(name, plant)
        except Infeasible as infeasible:
            show(name, *known, f"none ({infeasible.binding})", "", "", f"{time.process_time() - began:.1f}")
            continue
        took, found = f"{time.process_time() - began:.1f}", found + 1
        share, at_most = certificate.provenance.get("share_of_box"), largest_share(plant)
        if share is None or at_most is None:
            reached = [end for each in reach_of(certificate, plant) for end in (each.low, each.high) if end is not None]
            kept = f"to {min(reached):.1f} %", ""
        else:
            kept = f"{share:.3f}", f"{at_most:.2f}"
        S = certificate.safe_set
        show(name, *known, *kept, len(S.rows) if isinstance(S, Polytope) else "", took)
    print(f"{found} of {len(names or published())} have a certificate")


def attack(names: Names = (), steps: int = 45_000) -> None:
    """Attacks the certificate of each plant as `ncs attack` does: steps that left the set, or broke a limit."""
    show, total = table("plant", "steps", "outside S", "outside box", "no claim", first=18, width=11), Counter[str]()
    for name in names or published():
        plant, counts, rng = plant_of(name), Counter[str](), np.random.default_rng(0)
        try:
            certificate = certified(name, plant)
        except Infeasible:
            continue
        channels = channels_of(channel_of(name), contract := contract_of_plant(name))
        count = -(-steps // (len(channels) * EPISODE_STEPS))
        for channel in channels.values():
            settings = {"plant": plant, "contract": contract, "channel": channel} | worst_case(certificate)
            shield = VectorSafetyShield(NCSVectorEnv(count, **settings), certificate, on_unproved="ignore")
            counts += sum(attacked(shield, rng), Counter[str]())
        show(name, *(f"{counts[each]:,}" for each in ("steps", "outside S", "outside box", "no claim")))
        total += counts
    outside = total["outside S"] + total["outside box"]
    print(f"{outside} of {total['steps']:,} attacked steps left a set or broke a limit")


def impossible(names: Names = ("ctms_suspension", "double_integrator", "tvc_rocket", "bap_gepoc")) -> None:
    """From which multiple of its declared bounds on no controller at all keeps the limits of a plant, in exact numbers.

    Of smaller multiples it says nothing: a certificate alone shows that they are borne.
    """
    show = table("plant", "impossible beyond", first=18, width=18)
    for name in names:
        p = published()[name]
        least = impossible_beyond(plant_of(name), np.array(p["first_error_half_widths"]), p["max_age"] + 1)
        show(name, f"{math.ceil(1e3 * least) / 1e3:.3f}" if least < np.inf else "unknown")


def impossible_beyond(plant: LinearPlant, first: np.ndarray, period: int) -> Fraction | float:
    """Returns a multiple of all bounds beyond which no controller keeps the box of a plant; infinite if none is found.

    Linear programs find what defeats every controller. What part of the bounds it takes is computed without rounding.

    Args:
        plant: The plant, disturbed by a box through a matrix, with sensor noise in a box.
        first: Half-widths of the first error, shape (n,).
        period: The contract's largest age and one more [steps].
    """
    return min(_hidden_beyond(plant, first, period), _unbalanced_beyond(plant))


def _hidden_beyond(plant: LinearPlant, first: np.ndarray, period: int) -> Fraction | float:
    """Returns the multiple beyond which what no sample shows leaves the box.

    A sample comes every `period` steps. Let errors e follow from a first one and from disturbances, hidden in the noise
    by each sample, |H e| <= v. Then they and their opposites give the same outputs, hence the same inputs, and states
    that differ by 2 e just before the next sample: in one of the two cases a row c of a range below 2 c e is left.
    """
    disturbance, sensor = plant.bounds.disturbance.parts[0], plant.bounds.sensor.parts[0]
    values = plant.A, plant.H, np.diag(first), disturbance.E, np.diag(disturbance.set.half), sensor.half
    exact_values = [_exact(each) for each in values]
    least = np.inf
    for steps in (period * cycles for cycles in _CYCLES):
        units = np.eye(plant.n + steps * disturbance.E.shape[1])  # of the first error, then of every disturbance
        error, hidden = _errors(values, units, period)
        for row, low, high in zip(plant.box, *plant.box_ends, strict=True):
            found = linprog(-row @ error, np.vstack([hidden, -hidden]), np.ones(2 * len(hidden)), bounds=(-1.0, 1.0))
            if np.isfinite(high - low) and found.status == 0 and found.fun < 0.0:
                numbers = _exact(found.x)
                reached, shown = _errors(exact_values, numbers, period)
                taken = max(map(abs, [*numbers, *shown]))
                reach = sum(Fraction(c) * e for c, e in zip(row, reached, strict=True))
                least = min(least, (Fraction(high) - Fraction(low)) * taken / (2 * reach))
    return least


def _unbalanced_beyond(plant: LinearPlant) -> Fraction | float:
    """Returns the multiple beyond which a constant disturbance drives the state out of the box, even if all is known.

    For a row y let y (A - I) x + y B u >= -r for all states and inputs within their limits, and let the bounds allow a
    d with y d = s. While limits are kept under k d, y x grows by at least k s - r in every step, and leaves its range
    if k > r / s. Linear programs find the largest multiple of a d that an equilibrium balances, and y as multipliers;
    the next d is the one of the largest y d.
    """
    n, disturbance = plant.n, plant.bounds.disturbance.parts[0]
    ends = np.concatenate([_intervals(plant), _exact(plant.input_ends)], axis=1)
    moved = np.concatenate([_exact(plant.A) - _exact(np.eye(n)), _exact(plant.B)], axis=1)
    pushed = _exact(disturbance.E) * _exact(disturbance.set.half)
    units = np.concatenate([plant.half_widths, plant.input_half])
    balance, limits = moved.astype(float) * units / units[:n, None], ends.astype(float) / units
    push, least = pushed.astype(float) / units[:n, None], np.inf
    for y in np.eye(n):
        for _ in range(_TURNS):
            constant = push @ np.sign(y @ push)
            found = linprog(
                np.append(np.zeros(len(units)), -1.0),
                A_eq=np.column_stack([balance, constant]),
                b_eq=np.zeros(n),
                bounds=[*limits.T, (0.0, None)],
            )
            if found.status != 0 or not found.eqlin.marginals.any():  # nothing limits what is balanced
                break
            y = found.eqlin.marginals
            least = min(least, *(_balanced(_exact(row / units[:n]), moved, pushed, ends) for row in (y, -y)))
    return least


def _balanced(y: np.ndarray, moved: np.ndarray, pushed: np.ndarray, ends: np.ndarray) -> Fraction | float:
    """Returns r / s of a row y, shape (n,), without rounding; infinite if y x or r has no end.

    Args:
        y: The row.
        moved: (A - I, B), shape (n, n + m).
        pushed: What the disturbance's numbers push at the end of their bounds, shape (n, k).
        ends: Of states and inputs, shape (2, n + m).
    """
    highest, r = (
        sum(max(c * e for e in two) for c, two in zip(row, ends.T[: len(row)], strict=True) if c)
        for row in (y, -(y @ moved))
    )
    s = sum(map(abs, y @ pushed))
    return r / s if s and highest < np.inf and r < np.inf else np.inf


def _intervals(plant: LinearPlant) -> np.ndarray:
    """Returns the ends that rows of the box with one entry set to each state, exact or infinite, shape (2, n)."""
    ends = np.array([[-np.inf], [np.inf]], dtype=object).repeat(plant.n, axis=1)
    for row, two in zip(plant.box, plant.box_ends.T, strict=True):
        states = np.flatnonzero(row)
        if len(states) == 1:
            size = Fraction(row[states[0]])
            low, high = sorted(each * float(size) if np.isinf(each) else Fraction(each) / size for each in two)
            ends[:, states[0]] = max(ends[0, states[0]], low), min(ends[1, states[0]], high)
    return ends


def _exact(numbers: np.ndarray) -> np.ndarray:
    return np.vectorize(Fraction, otypes=[object])(numbers)


def _errors(values: Any, numbers: np.ndarray, period: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the error that parts of the bounds make in the end, shape (n, ...), and what each sample shows of it.

    Args:
        values: A, H, diagonal matrix of the first error's bounds, E, such a matrix of disturbances, bounds of noise.
        numbers: Parts of the bounds, in [-1, 1]: of the first error, then of the disturbance in each step.
        period: A sample comes every so many steps.
    """
    A, H, first, E, half, noise = values
    error, shown = first @ numbers[: len(A)], []
    for step, part in enumerate(numbers[len(A) :].reshape(-1, E.shape[1], *numbers.shape[1:])):
        if step % period == 0:
            shown.append(((H @ error).T / noise).T)
        error = A @ error + E @ (half @ part)
    return error, np.concatenate(shown)


def board(names: Names = _ON_BOARDS, steps: int = 20_000) -> None:
    """Exports the filter of each plant to C, checks its test vectors, and attacks what was compiled (cc, make).

    Noise of full size hides how near a row of the safe set is, disturbances push over it, proposals are extreme, and
    samples are as old as the contract allows, or mixed. What counts is outside while the filter says "guaranteed".
    """
    show, total = table("plant", "states", "guaranteed", "outside", "farthest", first=18, width=11), Counter[str]()
    for name in names:
        plant = plant_of(name)
        certificate = certified(name, plant)
        with tempfile.TemporaryDirectory() as folder:
            numbers = export_c(certificate, plant, Path(folder))
            subprocess.run(["make", "-C", folder], check=True, capture_output=True)
            subprocess.run(["cc", "-O2", "-shared", "-fPIC", "ncs_filter.c", "-o", "f.so"], cwd=folder, check=True)
            compiled = ctypes.CDLL(f"{folder}/f.so")
            guaranteed, outside, farthest = _attacked_board(compiled, numbers, plant, certificate, steps)
        total += Counter(outside=outside, steps=guaranteed)
        show(name, plant.n, f"{guaranteed:,}", outside, f"{farthest:.4f}")
    print(f"{total['outside']} of {total['steps']:,} guaranteed steps left a set or broke a limit")


def _attacked_board(
    c: Any, table: BoardTable, plant: LinearPlant, certificate: Certificate, steps: int
) -> tuple[int, int, float]:
    """Returns guaranteed steps, how many were outside, and how far the state got, 1 at the boundary of the set."""
    rng, polytope, (n, m, _, h, _) = np.random.default_rng(0), certificate.safe_set, table.sizes.values()
    assert isinstance(polytope, Polytope)
    memory = np.zeros(2 * (2 * n + (h + 1) * m) + 16, np.int32)
    reason, (low, high) = memory[2 * (2 * n + (h + 1) * m) + 5 :], plant.input_ends  # after five counters
    u, guaranteed, outside, farthest, oldest, mixes = np.zeros(m), 0, 0, 0.0, 0, False
    noises = plant.nominal_disturbance, plant.nominal_sensor_error

    def at(numbers: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(numbers.ctypes.data)

    for episode in range(steps // _EPISODE):
        x = rng.standard_normal(n) * plant.half_widths
        x = polytope.center + rng.uniform(0.5, 0.999) / polytope.gauge(polytope.center + x) * x
        assert c.ncs_start(at(memory), episode, at(x + plant.nominal_initial_error.sample_boundary(rng)))
        taken: list[np.ndarray] = []
        for step in range(_EPISODE):
            if step % _PATIENCE == 0:
                oldest, mixes = int(rng.integers(h + 1)), bool(rng.random() < 0.5)
            f = polytope.F[(polytope.F @ (plant.A @ x + plant.B @ u - polytope.center)).argmax()]
            d, v = (_pushed(each, row, rng) for each, row in zip(noises, (f, -plant.H @ f), strict=True))
            taken.append(plant.H @ x + v)
            ages = [h, oldest, *rng.integers(h + 1, size=2 * mixes).tolist()]
            for age in sorted((each for each in ages if step - each >= 1), reverse=True):
                c.ncs_receive(at(memory), episode, step - age, at(taken[step - age]))
            outwards = np.where(plant.B.T @ f > 0.0, high, low)
            proposed = rng.choice([outwards, rng.uniform(1.5 * low, 1.5 * high), np.nan * u])
            c.ncs_decide(at(memory), at(proposed), at(u))
            if reason[0] == GUARANTEED:
                guaranteed, farthest = guaranteed + 1, max(farthest, float(polytope.gauge(x)))
                outside += int(polytope.gauge(x) > 1.0 + 1e-9 or plant.constraint_values(x).max() > 1e-9)
            x = plant.A @ x + plant.B @ u + d
    return guaranteed, outside, farthest


def _pushed(noise: Ellipsoid, row: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns what of a noise moves farthest along a row, or now and then any of its extremes."""
    size = noise.support(row)
    return noise.sample_boundary(rng) if size == 0.0 or rng.random() < 0.2 else noise.shape_matrix @ row / size


def certified(name: str, plant: LinearPlant) -> Certificate:
    """Returns a certificate of a published plant that verifies; raises Infeasible if none is found."""
    certificate = synthesize(plant, contract=contract_of_plant(name))
    assert verify(certificate, plant).valid
    return certificate


def largest_share(plant: LinearPlant) -> float | None:
    """Returns the share of the safe box from which some sequence of inputs keeps the limits of a plant for 60 steps.

    Without disturbance, errors and limits of states and inputs together: no invariant set has a larger share. It is
    counted at 512 points, to about .02. None where the box is no product of intervals.
    """
    points = points_of_box(plant, _POINTS_LOG2)
    if points is None:
        return None
    n = plant.n
    # Of u_0, ..., u_(N-1), x_1, ..., x_N: x_(k+1) - A x_k - B u_k is A x_0 in the first step and 0 in the others.
    pushed = sparse.kron(sparse.eye(_STEPS), -plant.B)
    moved = sparse.eye(n * _STEPS) - sparse.kron(sparse.eye(_STEPS, k=-1), plant.A)
    model = sparse.hstack([pushed, moved]).tocsr()
    row = np.abs(plant.box).argmax(axis=0)  # of each state
    states = np.sort(plant.box_ends[:, row] / plant.box.sum(axis=0), axis=0)
    inputs = plant.input_ends
    ends = np.concatenate([np.tile(inputs, _STEPS), np.tile(states, _STEPS)], axis=1).T
    first = np.zeros(n * _STEPS)
    kept = 0
    for point in points:
        first[:n] = plant.A @ point
        found = linprog(np.zeros(len(ends)), A_eq=model, b_eq=first, bounds=ends, method="highs")
        kept += found.status == 0
    return kept / len(points)


COMMANDS = (shares, attack, impossible, board)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
