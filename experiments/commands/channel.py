"""`ncs channel`: what a record of packets says of a network, and how often it would have broken which contract."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy.stats import chi2

from experiments.runs.loops import registered_env
from experiments.runs.output_folder import require_place, write_json
from experiments.terminal import text_table, wrapped
from ncs_gym import LinearPlant, PacketLog
from ncs_gym.network.channel import MAX_AGE, in_time
from ncs_gym.validation import counted
from shields import Certificate, silence_of
from shields.packaged_certificates import certificate_of_package


@dataclass(frozen=True, kw_only=True)
class ChannelSettings:
    """Reads recorded packets, and says how often each channel contract would have been broken.

    Attributes:
        file: A table with the columns sent and received in seconds, received empty where a packet was lost, or the
            output of Linux `ping -D` (recipes for others are in the documentation under
            "Contracts and recorded networks").
        sampling_period: Duration of a control step [s]; by default that of --env or --plant, or the time between
            packets.
        env: Id of an environment whose contract is compared with the record.
        certificate: File of a certificate whose contract is compared with the record, in place of an environment's.
        plant: File of the plant that it is for (`LinearPlant.save`); alone it gives the sampling period.
        out: File for the numbers (JSON).
    """

    file: tyro.conf.Positional[Path]
    sampling_period: float | None = None
    env: str | None = None
    certificate: Path | None = None
    plant: Path | None = None
    out: Path | None = None

    def __post_init__(self) -> None:
        if (self.certificate and not self.plant) or (self.env and self.plant):
            raise ValueError("give --certificate and --plant, or --env, whose contract and certificate are known")
        period = self.sampling_period
        if not (period is None or 0.0 < period < math.inf):
            raise ValueError(f"--sampling-period must be a number > 0, got {period}")


# The record is cut into so many parts, into twice as many, and so on, to see how unevenly stalls are spread.
_FEWEST_PARTS, _MOST_PARTS = 4, 4096
# Ages of a table: all up to the first, then these of every decade.
_ALL_UP_TO, _OF_A_DECADE = 10, (2, 5, 10)


def channel(settings: ChannelSettings) -> None:
    """Runs `ncs channel`."""
    require_place(settings.out)
    plant = contract = certificate = None
    if settings.plant is not None:
        plant = LinearPlant.load(settings.plant)
        if settings.certificate is not None:
            certificate = Certificate.load(settings.certificate)
            contract = certificate.contract
    elif settings.env is not None:
        env = registered_env(settings.env)
        plant, contract = env.plant, env.contract
        certificate = certificate_of_package(plant, env.certificate_contract)
    silence = certificate and plant and silence_of(certificate, plant)  # raises unless they belong together
    given = settings.sampling_period or (plant and plant.dt)
    if plant is not None and given != plant.dt:
        raise ValueError(
            f"--sampling-period {given:g} s: a control step of the plant takes {plant.dt:g} s, and its contract counts "
            "these: leave the option out, or --env, --plant and --certificate"
        )
    log = PacketLog.load(settings.file)
    dt = given or log.period
    extra = [0, silence.anywhere] if silence else [0]
    asked = [] if contract is None else [contract.max_age + each for each in extra]
    found = _numbers(log, dt, asked)
    print(_text(log, found))
    whose = "certificate" if settings.certificate else "environment"
    if contract is not None:
        row = _row(found, contract.max_age)
        share = f", in {100.0 * row['broken']:.3g} % of steps" if row["times"] else ""
        newest = f"a newest sample of at most {counted(contract.max_age, 'step')}"
        ahead = " (behind a downlink it also counts the steps by which inputs are committed ahead)"
        newest += ahead * (settings.certificate is not None)
        print(wrapped(f"The {whose}'s contract, {newest}, was broken {how_often(row)}{share}."))
    elif certificate is not None:
        print(f"The {whose} needs no contract: it holds through any silence.")
    if len(asked) > 1:
        print(
            wrapped(
                "From any belief that the contract allows the box is kept until the newest sample is "
                f"{counted(asked[1], 'step')} old, in every mode that protects; the record exceeds that "
                f"{how_often(_row(found, asked[1]))}. Where the guarantee returns in between and no late sample comes "
                "meanwhile, the box is left no more often."
            )
        )
    write_json(settings.out, found)


def _numbers(log: PacketLog, dt: float, asked: list[int]) -> dict[str, Any]:
    arrived = log.delays[np.isfinite(log.delays)]
    if not len(arrived):
        raise ValueError("none of the packets arrived")
    ages = log.ages(dt)
    if len(ages) < 2:
        raise ValueError(
            f"the record spans one control step of {dt:g} s, a contract needs two: take a longer record or a shorter "
            "step, and write its times in seconds"
        )
    _, lost_in_a_row = stalls(np.isnan(log.delays), 0)
    return {
        "read_as": log.read_as,
        "disagreement": log.disagreement,
        "packets": len(log.sent),
        "span": float(log.sent[-1] - log.sent[0]),
        "sampling_period": dt,
        "steps": len(ages),
        "steps_with_a_packet": len(log.sent) - log.left_out(dt),
        "left_out": log.left_out(dt),
        "lost": len(log.sent) - len(arrived),
        "most_lost_in_a_row": int(lost_in_a_row.max(initial=0)),
        "delay_quantiles": [float(each) for each in np.quantile(arrived, [0.5, 0.9, 0.99, 1.0])],
        "kept": int(ages.max()),
        "contracts": broken_contracts(ages, dt, asked),
    }


def _text(log: PacketLog, found: dict[str, Any]) -> str:
    dt, left_out = found["sampling_period"], found["left_out"]
    empty = found["steps"] - found["steps_with_a_packet"]
    placed = (
        f"{counted(empty, 'step')} without a packet, {counted(left_out, 'packet')} not the first of their step and "
    )
    placed = f"{placed}left out" if empty or left_out else "one in each"
    share = 100.0 * found["lost"] / found["packets"]
    median, ninety, ninety_nine, longest = map(in_time, found["delay_quantiles"])
    too_old = f", more than the {MAX_AGE} of any contract" if found["kept"] > MAX_AGE else ""
    lines = [
        log.read_as,
        f"{counted(found['packets'], 'packet')} in {in_time(found['span'])}, "
        f"{counted(found['steps'], 'control step')} of {in_time(dt)}: {placed}.",
        log.disagreement,
        f"Lost: {counted(found['lost'], 'packet')} ({share:.3g} %), at most {found['most_lost_in_a_row']:,} in a row.",
        f"Delays: median {median}, 90 % {ninety}, 99 % {ninety_nine}, longest {longest}.",
        f"Contract kept by the record: max_age = {found['kept']}{too_old} ({in_time(found['kept'] * dt)}).",
    ]
    cells = [["max_age", "time", "broken", "per hour", "[95 % CI]", "longest"]]
    for row in found["contracts"]:
        interval = f"[{', '.join(map(rate_text, row['per_hour_ci95']))}]"
        longest = in_time(row["longest"] * dt) if row["longest"] else "-"
        times = str(row["max_age"]), in_time(row["max_age"] * dt), f"{row['times']:,}", rate_text(row["per_hour"])
        cells.append([*times, interval, longest])
    note = (
        "broken: stretches of steps whose newest sample is older; longest: the longest of them. The intervals allow "
        "for their clusters, and take the record for typical."
    )
    return "\n".join([*map(wrapped, filter(None, lines)), "", text_table(cells), "", wrapped(note)])


def _row(found: dict[str, Any], age: int) -> dict[str, Any]:
    return next(row for row in found["contracts"] if row["max_age"] == age)


def stalls(ages: np.ndarray, max_age: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns where ages, shape (k,), are larger than `max_age`, and for how long each, shape (stalls,) [steps]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (ages > max_age).astype(np.int8), [0]])))
    return edges[::2], edges[1::2] - edges[::2]


def count_interval(starts: np.ndarray, steps: int) -> tuple[float, float]:
    """Returns a 95 % interval for the expected number of stalls in a record as long as this one.

    Stalls, which begin at the steps `starts`, shape (n,), come in clusters. The record is cut into 4, 8, 16, ... equal
    parts, and D is the largest ratio of variance to mean of the numbers of stalls in these parts, at least 1. The n
    stalls then count as n / D independent clusters of D stalls (quasi-Poisson), for which the interval is Garwood's: D
    times the quantiles of chi-square with 2 n / D and 2 n / D + 2 degrees of freedom, halved. It assumes that the
    network goes on as in the record, that clusters are shorter than a quarter of it, and that the record has some of
    the large ones: of heavy-tailed clusters it needs twenty or more.
    """
    spread, parts = 1.0, _FEWEST_PARTS
    while len(starts) and parts <= min(_MOST_PARTS, steps):
        counts = np.bincount(starts * parts // steps, minlength=parts)
        spread, parts = max(spread, float(counts.var(ddof=1) / counts.mean())), 2 * parts
    clusters = len(starts) / spread
    low = spread * chi2.ppf(0.025, 2.0 * clusters) / 2.0 if clusters else 0.0
    return float(low), float(spread * chi2.ppf(0.975, 2.0 * clusters + 2.0) / 2.0)


def broken_contracts(ages: np.ndarray, dt: float, also: Collection[int] = ()) -> list[dict[str, Any]]:
    """Returns how often contracts would have been broken in a record, once for every stall.

    Args:
        ages: Age of the newest sample at every step, shape (k,) [steps].
        dt: Duration of a step [s].
        also: Values of `max_age` that are among them.

    Returns:
        Rows of JSON values by falling age: all ages up to 10 and some larger ones.
    """
    largest, steps = min(int(ages.max()), MAX_AGE), len(ages)
    decades = (10**power * each for power in (1, 2) for each in _OF_A_DECADE)
    chosen = {*range(_ALL_UP_TO + 1), *decades, largest, *also}
    hours = steps * dt / 3600.0
    rows = []
    for age in sorted((each for each in chosen if each <= largest or each in also), reverse=True):
        starts, lengths = stalls(ages, age)
        rows.append(
            {
                "max_age": age,
                "times": len(starts),
                "per_hour": len(starts) / hours,
                "per_hour_ci95": [bound / hours for bound in count_interval(starts, steps)],
                "longest": int(lengths.max(initial=0)),
                "broken": float(lengths.sum() / steps),
            }
        )
    return rows


def how_often(row: dict[str, Any]) -> str:
    """Returns how often the newest sample was older than a row of `broken_contracts` allows, as words."""
    low, high = map(rate_text, row["per_hour_ci95"])
    if row["times"] == 0:
        return f"at no time; a record of this length excludes more than {high} times per hour"
    times = "once" if row["times"] == 1 else f"{row['times']:,} times"
    return f"{times}, {rate_text(row['per_hour'])} per hour [{low}, {high}]"


def rate_text(rate: float) -> str:
    """Returns a rate in three digits."""
    return f"{rate:.3g}" if rate < 999.5 else f"{rate:,.0f}"
