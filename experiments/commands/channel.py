"""`ncs channel`: what recorded packets say of a network, and which contract it kept."""

from __future__ import annotations

import json
from collections import Counter
from typing import Any

import numpy as np

from experiments.runs.loops import registered_env
from experiments.runs.output_folder import require_place
from experiments.settings import ChannelSettings
from experiments.terminal import text_table, wrapped
from ncs_gym import PacketLog, contract_of
from ncs_gym.network.contract import MAX_AGE
from shields.atomic_write import write_atomically

# Rows of the table of contracts that are printed: those nearest to what was kept.
_MOST_ROWS = 12


def channel(settings: ChannelSettings) -> None:
    """Runs `ncs channel`."""
    require_place(settings.out)
    env = None if settings.env is None else registered_env(settings.env)
    step = settings.sampling_period or (1.0 if env is None else env.plant.dt)
    log = PacketLog.load(settings.file, settings.ping_period, step)
    dt = settings.sampling_period or (log.period if env is None else env.plant.dt)
    found = _numbers(log, dt, settings.seed)
    print(_text(log, dt, found))
    if env is not None:
        print(wrapped(_compared(env.contract, found)))
    if settings.out is not None:
        write_atomically(settings.out, json.dumps(found, indent=1) + "\n")


def _numbers(log: PacketLog, dt: float, seed: int) -> dict[str, Any]:
    replayed, trace = log.channel(dt), np.array(log.trace(dt))
    lost, arrived = trace < 0, log.delays[np.isfinite(log.delays)]
    ages = log.ages(dt)
    if not len(ages):
        raise ValueError("none of the packets arrived")
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])))
    runs = Counter((edges[1::2] - edges[::2]).tolist())
    promised = contract_of(replayed)
    first, second = (int(half.max()) for half in np.array_split(ages, 2))
    return {
        "packets": len(trace),
        "sampling_period": dt,
        "send_period": replayed.send_period,
        "lost": int(lost.sum()),
        "runs_of_losses": {str(length): count for length, count in sorted(runs.items())},
        "delay_quantiles": [float(each) for each in np.quantile(arrived, [0.5, 0.9, 0.99, 1.0])],
        "delays": [replayed.delay, replayed.longest_delay],
        "kept": int(ages.max()),
        "promised": None if promised is None else promised.max_age,
        "kept_by_halves": [first, second],
        "contracts": broken_contracts(ages, np.random.default_rng(seed)),
    }


def _text(log: PacketLog, dt: float, found: dict[str, Any]) -> str:
    low, high = found["delays"]
    runs = ", ".join(f"{count} of {length}" for length, count in found["runs_of_losses"].items()) or "none"
    median, ninety, ninety_nine, longest = (1000.0 * each for each in found["delay_quantiles"])
    first, second = found["kept_by_halves"]
    late = f"{low} to {high} steps" if low < high else "1 step" if low == 1 else f"{low} steps"
    together = "none" if found["promised"] is None else f"max_age = {found['promised']}"
    lines = [
        f"{found['packets']:,} packets in {log.sent[-1] - log.sent[0]:.4g} s, control steps of {1000.0 * dt:.4g} ms, a "
        f"packet every {'step' if found['send_period'] == 1 else str(found['send_period']) + ' steps'}.",
        f"Lost: {found['lost']:,} ({100.0 * found['lost'] / found['packets']:.3g} %); runs of losses: {runs}.",
        f"Delays: median {median:.3g} ms, 90 % {ninety:.3g} ms, 99 % {ninety_nine:.3g} ms, longest {longest:.3g} ms: "
        f"{late}.",
        f"Contract kept: max_age = {found['kept']} (first half {first}, second half {second}); by the longest run of "
        f"losses and the longest delay together: {together}.",
    ]
    header = [["max_age", "steps beyond", "[95 % CI]", "times", "first half", "second half"]]
    cells = [
        [
            str(row["max_age"]),
            f"{100.0 * row['broken']:.3g} %",
            f"[{100.0 * row['broken_ci95'][0]:.3g}, {100.0 * row['broken_ci95'][1]:.3g}]",
            f"{row['times']:,}",
            *(f"{100.0 * half:.3g} %" for half in row["halves"]),
        ]
        for row in found["contracts"][:_MOST_ROWS]
    ]
    return "\n".join([*map(wrapped, lines), "", text_table([*header, *cells])])


def _compared(contract: Any, found: dict[str, Any]) -> str:
    if contract is None:
        return "The environment's certificate needs no contract."
    row = next((row for row in found["contracts"] if row["max_age"] == contract.max_age), None)
    if row is None or row["broken"] == 0.0:
        return f"The environment's contract, max_age = {contract.max_age}, was kept throughout."
    broken = f"{100.0 * row['broken']:.3g} % of steps"
    return f"The environment's contract, max_age = {contract.max_age}, was broken in {broken}."


# A block is at least so many times as long as the largest age: what happens in one hardly depends on the one before.
_AGES_PER_BLOCK, _MOST_BLOCKS = 10, 5000
_RESAMPLES = 2000


def broken_contracts(ages: np.ndarray, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Returns, for every largest age up to the recorded one that contracts can have, how often it was exceeded.

    The interval is that of a circular block bootstrap of the steps (95 %), blocks being at least ten times as
    long as the largest age. Where an age was never exceeded it ends at 3 / (number of blocks), what is excluded at that
    level if blocks are independent. `halves` are the two halves of the record.

    Args:
        ages: Age of the newest sample at every step, shape (k,).
        rng: Draws the blocks.

    Returns:
        Rows of JSON values, from the age that was kept (or `MAX_AGE`) down to 0.
    """
    largest, steps = int(ages.max()), len(ages)
    block = min(max(_AGES_PER_BLOCK * (largest + 1), steps // _MOST_BLOCKS), steps)
    blocks = -(-steps // block)
    starts = rng.integers(steps, size=(_RESAMPLES, blocks))
    halves = np.array_split(ages, 2)
    rows = []
    for age in range(min(largest, MAX_AGE), -1, -1):
        broken = ages > age
        sums = np.concatenate([[0], np.cumsum(np.concatenate([broken, broken[:block]]))])
        resampled = (sums[starts + block] - sums[starts]).sum(axis=1) / (blocks * block)
        low, high = np.quantile(resampled, [0.025, 0.975])
        if not broken.any():
            low, high = 0.0, min(3.0 / blocks, 1.0)
        edges = np.diff(np.concatenate([[0], broken.astype(int)]))
        rows.append(
            {
                "max_age": age,
                "broken": float(broken.mean()),
                "broken_ci95": [float(low), float(high)],
                "times": int((edges > 0).sum()),
                "halves": [float((half > age).mean()) for half in halves],
            }
        )
    return rows
