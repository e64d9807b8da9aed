"""`ncs attack`: attacks shielded control loops by Monte Carlo simulation with worst-case disturbances."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from experiments.attack.attack_cases import AttackCase
from experiments.attack.monte_carlo_batch import MonteCarloBatch, cases_of, kinds_of_batches
from experiments.attack.safety_counts import (
    SafetyCounts,
    counts_table,
    gaussian_table,
    require_safe,
    require_within,
)
from experiments.backends.execution import results_of
from experiments.commands import short_version
from experiments.runs.output_folder import claim_folder
from experiments.runs.provenance import versions
from experiments.settings import AttackSettings, lasting_settings
from experiments.settings.certificates import FEWEST_ENVS
from experiments.terminal import wrapped
from ncs_gym.network import downlink_protocol
from ncs_gym.reading import json_values, read_file
from ncs_gym.registration import EPISODE_STEPS
from ncs_gym.uncertainty.disturbances import as_noise
from ncs_gym.validation import reason_of
from shields import Certificate
from shields.atomic_write import write_atomically
from shields.runtime.safety_filter import DEFAULT_HORIZON

# Budget of `--smoke`, which attacks the environments' own channels alone unless something else is asked for.
_SMOKE = {"steps": 1e5, "random_plants": 0}
_SMOKE_CHANNEL = "its channel"
# Cases that a line names.
_MOST_LISTED = 6


def attack(settings: AttackSettings) -> None:
    """Runs `ncs attack`."""
    settings = shortened(settings)
    cases, kinds = cases_of(settings), len(kinds_of_batches(settings))
    if settings.noise == "gaussian":
        cases = _with_covariances(cases)
    if not settings.unshielded:
        _require_claims(cases)
    # Smaller batches, so that each kind of each case comes in once within the budget; those in the folder are kept.
    each = max(int(settings.steps / (len(cases) * kinds * EPISODE_STEPS)), FEWEST_ENVS)
    there = None if settings.force else _envs_in(settings.out)
    settings = replace(settings, envs=min(settings.envs, each, there or each))
    claim_folder("attack", settings)
    horizon = (settings.horizon or DEFAULT_HORIZON) if settings.mode == "lookahead" else None
    plant = settings.plant and settings.plant.resolve()  # workers may have another working folder
    settings = replace(settings, horizon=horizon, plant=plant)
    certificates = _certificates(cases, settings.out / "certificates", settings.safe_set)
    numbers = _numbers_of_batches(len(cases), int(settings.steps // (settings.envs * EPISODE_STEPS)), kinds)
    batches = [
        MonteCarloBatch(settings, case, index, certificate)
        for (case, certificate), number in zip(certificates.items(), numbers, strict=True)
        for index in range(number)
    ]
    counts = {case: SafetyCounts() for case, number in zip(cases, numbers, strict=True) if number}
    for batch, counted in zip(batches, results_of(batches, settings.out, settings), strict=True):
        counts[batch.case] += counted
    total, looks_ahead = sum(counts.values(), SafetyCounts()), settings.mode == "lookahead"
    print(counts_table(counts, looks_ahead=looks_ahead))
    if settings.smoke:
        print(wrapped("A smoke run shows that everything runs; it attacks too little to show anything else."))
    if left_out := [name for name in cases if name not in counts]:
        listed = "; ".join([*left_out[:_MOST_LISTED], *["..."] * (len(left_out) > _MOST_LISTED)])
        budget = f"within {settings.steps:,.0f} steps"
        print(wrapped(f"{len(left_out)} of {len(cases)} cases are not attacked {budget}: {listed}"))
    limits = (
        {name: cases[name].bound_violation_probability() for name in counts} if settings.noise == "gaussian" else {}
    )
    if limits:
        print("", gaussian_table(counts, limits), sep="\n")
    document = {"settings": lasting_settings(settings), "versions": versions(), "total": total.document()}
    document["cases"] = {case: each.document() for case, each in counts.items()}
    if limits:
        document["bound_violation_probability"] = limits
    write_atomically(settings.out / "attack.json", json.dumps(document, indent=1) + "\n")
    if limits and not settings.unshielded:
        require_within(counts, limits)
    elif not settings.unshielded:
        require_safe(total, looks_ahead=looks_ahead)


def _envs_in(folder: Path) -> int | None:
    """Returns the episodes of a batch of the campaign that a folder has; None for none."""
    try:
        envs = json_values(read_file(folder / "settings.json"))["settings"]["envs"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return envs if type(envs) is int and envs >= FEWEST_ENVS else None


def shortened(settings: AttackSettings) -> AttackSettings:
    """Returns the settings of the short version if `--smoke` is given, otherwise the same settings."""
    chosen = {"channel": settings.channel or _SMOKE_CHANNEL} if settings.env is settings.plant is None else {}
    return short_version(settings, **_SMOKE, **chosen)


def _with_covariances(cases: dict[str, AttackCase]) -> dict[str, AttackCase]:
    """Returns the cases whose plants have Gaussian noise; raises ValueError if there is none."""
    kept, refusal = {}, ""
    for name, case in cases.items():
        try:
            as_noise("gaussian", case.plant)
        except ValueError as error:
            refusal = reason_of(error)
        else:
            kept[name] = case
    if not kept:
        raise ValueError(refusal)
    if len(kept) < len(cases):
        print(wrapped(f"{len(cases) - len(kept)} of {len(cases)} cases have no Gaussian noise and are left out."))
    return kept


def _require_claims(cases: dict[str, AttackCase]) -> None:
    """Raises unless something is claimed of every case."""
    for name, case in cases.items():
        if downlink_protocol(case.downlink, case.downlink_contract).contract is None:
            raise ValueError(
                f"{name}: nothing is claimed behind a downlink without a contract, so that there is nothing to attack; "
                "give it max_consecutive_losses, or the environment downlink_contract=ChannelContract(c)"
            )


def _certificates(cases: dict[str, AttackCase], folder: Path, safe_set: str | None = None) -> dict[str, Certificate]:
    """Returns the certificate of each case; those that the folder lacks are synthesized and written there."""
    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for name, case in tqdm(cases.items(), desc="certificates", leave=False, disable=None):
        contract = case.certificate_contract
        suffix = "" if contract is None else f"-{contract.max_age}-{contract.quantization_step:g}"
        suffix += f"-{safe_set}" if safe_set else ""
        file = folder / f"{case.plant.fingerprint[:16]}{suffix}.json"
        if not file.exists():
            case.certificate(safe_set).save(file)
        found[name] = Certificate.load(file)
    return found


def _numbers_of_batches(cases: int, count: int, least: int) -> list[int]:
    """Returns the number of batches of each case, as even as possible, more for earlier cases, `count` in all.

    One at least is run. The `least` kinds of batches take turns: where not all cases can have each kind, some have all.
    """
    count = max(count, 1)
    attacked = min(cases, -(-count // least))
    each, extra = divmod(count, attacked)
    return [each + (number < extra) if number < attacked else 0 for number in range(cases)]
