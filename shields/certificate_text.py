"""A certificate, and a loop that runs under one, in words, for people."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from shields.certificate import Certificate
    from shields.runtime.safe_loop import SafeLoop

_WIDTH, _INDENT = 110, 14
_METHODS = {
    "certified": "certified (docs/theory.md section 3)",
    "paper": "paper (OP and Algorithm 1 of Liu et al. as printed, docs/paper.md)",
}


def description_of(certificate: Certificate) -> str:
    """Returns what a certificate is for, how large its set is and what it rests on, a line or more for each."""
    m, n = certificate.K.shape
    recorded = certificate.provenance
    rows = [
        ("method", _METHODS[certificate.method]),
        ("plant", f"{_count(n, 'state')}, {_count(m, 'input')}, fingerprint {certificate.fingerprint[:16]}"),
        ("safe set", f"x'Mx <= 1, that reaches |x_i| <= {_numbers(np.sqrt(np.diag(certificate.L)))}"),
        ("size", size_of(recorded)),
        ("fallback", "u = K x_hat"),
        ("contract", _contract(certificate)),
        ("tolerance", _tolerance(recorded)),
        ("assumes", _assumptions(recorded)),
        ("interrupted", _interruption(recorded)),
    ]
    title = "Certificate of a robust control invariant set; shields.verify(certificate, plant) checks it"
    return _table(title, rows)


def description_of_loop(loop: SafeLoop, is_started: bool) -> str:
    """Returns how a loop decides, what it rests on and what is proved now, a line or more for each."""
    certificate, mode, horizon = loop.filter.certificate, loop.filter.mode, loop.filter.horizon
    fingerprint = f"of the plant with fingerprint {certificate.fingerprint[:16]}"
    age = f"the newest sample is {_count(loop.measurement_age, 'step')} old"
    contract = None if certificate.ages is None else certificate.ages.sets.contract
    largest = None if contract is None else contract.max_age - loop.lead
    if largest is not None and loop.measurement_age > largest:
        age += ", older than the contract allows"
    proved = "the state stays in the box" if mode == "lookahead" else "the state is in S"
    rows = [
        ("mode", mode if horizon is None else f"{mode}, horizon {_count(horizon, 'step')}"),
        ("certificate", ", ".join(filter(None, (fingerprint, size_of(certificate.provenance))))),
        ("contract", _contract(certificate, largest)),
        ("downlink", f"inputs take effect {_count(loop.lead, 'step')} after the decision" if loop.lead else ""),
        ("step", f"{loop.steps} of episode {loop.episode}, {age}" if is_started else ""),
        ("guaranteed", f"yes: {proved}" if loop.guaranteed else f"no: {loop.reason}"),
    ]
    return _table("Safe loop: estimator, safety filter and monitor of the guarantee", rows)


def size_of(recorded: dict[str, Any]) -> str:
    """Returns the volume of the set as shares of the safe box and of the largest ellipsoid in it, as far as known.

    Args:
        recorded: The provenance of a certificate.
    """
    unknown = recorded.get("share_of_box_unknown")
    shares = (
        _text(recorded.get("share_of_box"), "{:.4g} % of the safe box's volume", 100.0),
        _text(
            recorded.get("share_of_box_at_rest"),
            "{:.4g} % of the volume of the safe box of the states, with no input under way",
            100.0,
        ),
        f"an unknown share of the safe box ({unknown})" if isinstance(unknown, str) else "",
        _text(
            recorded.get("volume_of_box_ellipsoid"), "{:.4g} % of the volume of the largest ellipsoid in the box", 100.0
        ),
    )
    return ", ".join(filter(None, shares))


def _table(title: str, rows: list[tuple[str, str]]) -> str:
    """Returns a title and named texts below it, without those that are empty."""
    lines, indent = [title], " " * _INDENT
    for name, text in rows:
        if text:
            first = f"  {name}".ljust(_INDENT)
            lines.append(textwrap.fill(text, _WIDTH, initial_indent=first, subsequent_indent=indent))
    return "\n".join(lines)


def _contract(certificate: Certificate, largest: int | None = None) -> str:
    """Returns what the channel has to promise.

    Args:
        certificate: A certificate.
        largest: What a downlink leaves of the contract's age for the samples [steps]; all of it if None.
    """
    if certificate.method == "paper":
        return "none; no error set: the guarantee is the paper's own, and a shield with it is never guaranteed"
    if certificate.ages is None:
        return "none: any packets may be lost or late"
    contract = certificate.ages.sets.contract
    step = contract.quantization_step
    rounding = f"rounded to {step:g} or finer" if step else "not rounded"
    age = contract.max_age if largest is None else largest
    less = contract.max_age - age
    of = f" ({contract.max_age} less the downlink's {less})" if less else ""
    return f"the newest sample is never older than {_count(age, 'step')}{of}; samples are {rounding}"


def _tolerance(recorded: dict[str, Any]) -> str:
    """Returns the largest tolerated disturbance, if it is recorded."""
    return _text(
        recorded.get("tolerated_scale"),
        "some set exists for disturbances and estimation errors up to {:.2f} times those assumed",
    )


def _assumptions(recorded: dict[str, Any]) -> str:
    """Returns the plant's assumptions, if they are recorded."""
    given = recorded.get("assumptions")
    return " ".join(each for each in given if isinstance(each, str)) if isinstance(given, list) else ""


def _interruption(recorded: dict[str, Any]) -> str:
    """Returns where the synthesis was interrupted, if it was."""
    stage = recorded.get("interrupted_at")
    return f"the synthesis was stopped at {stage}: other sets may be larger" if isinstance(stage, str) else ""


def _numbers(values: np.ndarray) -> str:
    """Returns numbers as people read them."""
    return ", ".join(f"{value:.4g}" for value in values)


def _count(number: int, noun: str) -> str:
    """Returns a number of things."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _text(value: Any, pattern: str, scale: float = 1.0) -> str:
    """Returns a recorded number, scaled, in a pattern; an empty string for anything else: files hold what they like."""
    return pattern.format(scale * value) if isinstance(value, float) else ""
