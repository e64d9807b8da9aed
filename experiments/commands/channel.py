"""`ncs channel`: what a record of packets says of a network, and how often it would have broken which contract."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

from experiments.analysis.stalls import broken_contracts, how_often, rate_text, silences_text
from experiments.runs.loops import registered_env
from experiments.runs.output_folder import require_place
from experiments.settings import require_limits
from experiments.terminal import text_table, wrapped
from ncs_gym import ChannelContract, LinearPlant, PacketLog, contract_of
from ncs_gym.network.channel import in_time
from ncs_gym.network.contract import MAX_AGE
from ncs_gym.reading import MOST_PACKETS
from ncs_gym.validation import counted
from shields import Certificate, silence_of
from shields.atomic_write import write_atomically
from shields.packaged_certificates import certificate_of_package


@dataclass(frozen=True, kw_only=True)
class ChannelSettings:
    """Reads recorded packets, and says how often each channel contract would have been broken.

    Attributes:
        file: A table with the columns sent and received in seconds, received empty where a packet was lost, or the
            output of Linux `ping -D` (docs/requirements.md has recipes for others).
        sampling_period: Duration of a control step [s]; by default that of --env or --plant, or the time between
            packets.
        env: Id of an environment whose contract is compared with the record.
        certificate: File of a certificate whose contract is compared with the record, in place of an environment's.
        plant: File of the plant that it is for (`LinearPlant.save`); alone it gives the sampling period.
        committed_ahead: Steps by which inputs are committed ahead behind a downlink, of --certificate, whose contract
            counts them, too: samples may be so many steps less old (docs/contracts.md).
        out: File for the numbers (JSON).
    """

    file: tyro.conf.Positional[Path]
    sampling_period: float | None = None
    env: str | None = None
    certificate: Path | None = None
    plant: Path | None = None
    committed_ahead: int = 0
    out: Path | None = None

    def __post_init__(self) -> None:
        require_limits(self, committed_ahead=0)
        if self.committed_ahead and self.certificate is None:
            raise ValueError("--committed-ahead is of --certificate: an environment knows its own")
        if (self.certificate and not self.plant) or (self.env and self.plant):
            raise ValueError("give --certificate and --plant, or --env, whose contract and certificate are known")
        period = self.sampling_period
        if not (period is None or 0.0 < period < math.inf):
            raise ValueError(f"--sampling-period must be a number > 0, got {period}")


class _Promise(NamedTuple):
    """What a record is compared with.

    Attributes:
        whose: "environment" or "certificate".
        dt: Duration of a control step [s].
        contract: What was promised of samples; None for nothing.
        oldest: Until which age of the newest sample the certificate keeps the box; None if there is none.
    """

    whose: str
    dt: float
    contract: ChannelContract | None
    oldest: int | None


def channel(settings: ChannelSettings) -> None:
    """Runs `ncs channel`."""
    require_place(settings.out)
    plant = None if settings.plant is None else LinearPlant.load(settings.plant)
    promise = _promise(settings, plant)
    step = plant.dt if plant is not None else promise.dt if promise is not None else None
    known = settings.sampling_period or step
    if step is not None and known != step:
        raise ValueError(
            f"--sampling-period {known:g} s: a control step of the {'environment' if plant is None else 'plant'} takes "
            f"{step:g} s, and its contract counts these: leave the option out, or --env, --plant and --certificate"
        )
    log = PacketLog.load(settings.file)
    dt = known or log.period
    contract = None if promise is None else promise.contract
    oldest = None if promise is None else promise.oldest
    asked = () if contract is None else (contract.max_age,)
    asked += () if oldest is None else (oldest,)
    found = _numbers(log, dt, asked)
    print(_text(log, found))
    if promise is not None:
        print(wrapped(_compared(promise, found)))
    if oldest is not None:
        print(wrapped(silences_text(oldest, _row(found, oldest))))
    if settings.out is not None:
        write_atomically(settings.out, json.dumps(found, indent=1) + "\n")


def _promise(settings: ChannelSettings, plant: LinearPlant | None) -> _Promise | None:
    if settings.certificate is not None and plant is not None:
        certificate = Certificate.load(settings.certificate)
        silence, ahead = silence_of(certificate, plant), settings.committed_ahead
        if certificate.contract is None and ahead:
            raise ValueError("--committed-ahead is counted by contracts, and this certificate needs none")
        if certificate.contract is None:
            return _Promise("certificate", plant.dt, None, None)
        max_age = certificate.contract.max_age - ahead
        if max_age < 0:
            most = certificate.contract.max_age
            raise ValueError(f"--committed-ahead {ahead}: the certificate's contract is of {most} steps in all")
        contract = replace(certificate.contract, max_age=max_age)
        return _Promise("certificate", plant.dt, contract, silence and max_age + silence.anywhere)
    if settings.env is None:
        return None
    env = registered_env(settings.env)
    certificate = certificate_of_package(env.plant, env.certificate_contract)
    silence = None if certificate is None else silence_of(certificate, env.plant)
    oldest = None if silence is None or env.contract is None else env.contract.max_age + silence.anywhere
    return _Promise("environment", env.plant.dt, env.contract, oldest)


def _numbers(log: PacketLog, dt: float, asked: tuple[int, ...]) -> dict[str, Any]:
    arrived = log.delays[np.isfinite(log.delays)]
    if not len(arrived):
        raise ValueError("none of the packets arrived")
    ages = log.ages(dt)
    if len(ages) < 2:
        raise ValueError(
            f"the record spans one control step of {dt:g} s, a contract needs two: take a longer record or a shorter "
            "step, and write its times in seconds"
        )
    samples = len(log.sent) - log.left_out(dt)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.isnan(log.delays).astype(np.int8), [0]])))
    first, second = (int(half.max()) for half in np.array_split(ages, 2) if len(half))
    return {
        "read_as": log.read_as,
        "disagreement": log.disagreement,
        "packets": len(log.sent),
        "span": float(log.sent[-1] - log.sent[0]),
        "sampling_period": dt,
        "steps": len(ages),
        "steps_with_a_packet": samples,
        "left_out": log.left_out(dt),
        "lost": len(log.sent) - len(arrived),
        "most_lost_in_a_row": int((edges[1::2] - edges[::2]).max(initial=0)),
        "delay_quantiles": [float(each) for each in np.quantile(arrived, [0.5, 0.9, 0.99, 1.0])],
        "kept": int(ages.max()),
        "kept_by_halves": [first, second],
        "replay": _replay(log, dt),
        "contracts": broken_contracts(ages, dt, asked),
    }


def _replay(log: PacketLog, dt: float) -> int | None:
    """Returns the largest age of a replay; None if it is larger than a contract's or there is no replay."""
    if len(log.ages(dt)) > log.send_period(dt) * MOST_PACKETS:
        return None
    promised = contract_of(log.channel(dt))
    return None if promised is None else promised.max_age


def _text(log: PacketLog, found: dict[str, Any]) -> str:
    dt = found["sampling_period"]
    empty = found["steps"] - found["steps_with_a_packet"]
    median, ninety, ninety_nine, longest = map(in_time, found["delay_quantiles"])
    first, second = found["kept_by_halves"]
    again = "none" if found["replay"] is None else f"max_age = {found['replay']}"
    too_old = f", more than the {MAX_AGE} of any contract" if found["kept"] > MAX_AGE else ""
    lines = [
        log.read_as,
        f"{counted(found['packets'], 'packet')} in {in_time(found['span'])}, "
        f"{counted(found['steps'], 'control step')} of {in_time(dt)}: {_placed(empty, found['left_out'])}.",
        log.disagreement,
        _lost(found),
        f"Delays: median {median}, 90 % {ninety}, 99 % {ninety_nine}, longest {longest}.",
        f"Contract kept by the record: max_age = {found['kept']}{too_old} ({in_time(found['kept'] * dt)}; first half "
        f"{first}, second half {second}); by its replay around and around: {again}.",
    ]
    header = ["max_age", "time", "broken", "per hour", "[95 % CI]", "longest", "half 1", "half 2"]
    cells = [
        [
            str(row["max_age"]),
            in_time(row["max_age"] * dt),
            f"{row['times']:,}",
            rate_text(row["per_hour"]),
            f"[{', '.join(map(rate_text, row['per_hour_ci95']))}]",
            in_time(row["longest"] * dt) if row["longest"] else "-",
            *map(rate_text, row["halves"]),
        ]
        for row in found["contracts"]
    ]
    note = (
        "broken: stretches of steps whose newest sample is older, also per hour in each half; longest: the longest of "
        "them. The intervals allow for their clusters, and take the record for typical."
    )
    return "\n".join([*map(wrapped, filter(None, lines)), "", text_table([header, *cells]), "", wrapped(note)])


def _lost(found: dict[str, Any]) -> str:
    share = 100.0 * found["lost"] / found["packets"]
    return (
        f"Lost: {counted(found['lost'], 'packet')} ({share:.3g} %), at most {found['most_lost_in_a_row']:,} in a row."
    )


def _placed(empty: int, left_out: int) -> str:
    if not empty and not left_out:
        return "one in each"
    without, later = counted(empty, "step"), counted(left_out, "packet")
    return f"{without} without a packet, {later} not the first of their step and left out"


def _compared(promise: _Promise, found: dict[str, Any]) -> str:
    contract = promise.contract
    if contract is None:
        certificate = "certificate" if promise.whose == "certificate" else "environment's certificate"
        return f"The {certificate} needs no contract: it holds through any silence."
    row = _row(found, contract.max_age)
    share = f", in {100.0 * row['broken']:.3g} % of steps" if row["times"] else ""
    said = f"The {promise.whose}'s contract, a newest sample of at most {counted(contract.max_age, 'step')}, was broken"
    text = f"{said} {how_often(row)}{share}."
    if promise.whose == "environment":
        return text
    return (
        f"{text} Behind a downlink the certificate's own also counts the steps by which inputs are committed ahead, "
        "which --committed-ahead takes off."
    )


def _row(found: dict[str, Any], age: int) -> dict[str, Any]:
    return next(row for row in found["contracts"] if row["max_age"] == age)
