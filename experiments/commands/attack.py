"""`ncs attack`: attacks shielded control loops by Monte Carlo simulation with worst-case disturbances."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

from tqdm import tqdm

from experiments.analysis.terminal_text import wrapped
from experiments.attack import MonteCarloBatch, SafetyCounts
from experiments.attack.attack_cases import AttackCase
from experiments.attack.campaign import Campaign
from experiments.attack.counts_table import GAUSSIAN_LEGEND, counts_table, gaussian_table, require_safe, require_within
from experiments.backends.execution import results_of
from experiments.runs import claim_folder, versions
from experiments.settings import AttackSettings
from experiments.settings.certificates import FEWEST_ENVS, changed_contract
from ncs_gym.network import downlink_protocol
from ncs_gym.registration import EPISODE_STEPS
from shields import Certificate
from shields.atomic_write import write_atomically
from shields.runtime.safety_filter import DEFAULT_HORIZON

# Cases that a line names.
_MOST_LISTED = 6


def attack(settings: AttackSettings) -> None:
    """Runs `ncs attack`.

    Raises:
        SafetyBroken: If a shielded state left S or its box (in mode "lookahead": its box), or a proof did not hold,
            although the channels kept their contracts; with Gaussian noise, if more episodes did so than the bound on
            their probability allows.
        ResultsError: If a stored result is damaged.
        FolderInUseError: If another command is writing to the output folder.
        OtherResultsError: If the output folder holds finished results of other settings.
        ValueError: If there is no environment of the given id, the plant's file cannot be read, or nothing is
            claimed of an environment because its downlink promises nothing.
        Infeasible: If there is no certificate for the plant.
        CertificateError: If a certificate in the folder is damaged.
        RunError: If a batch fails.
        ClusterError: If a cluster cannot execute the batches.
        OSError: If the folder cannot be written.
    """
    campaign = _campaign(settings)
    cases = campaign.cases()
    # Smaller batches, so that each kind of each case comes in once within the budget.
    each = int(settings.steps / (len(cases) * campaign.kinds_of_batches * EPISODE_STEPS))
    campaign = replace(campaign, envs=min(campaign.envs, max(each, FEWEST_ENVS)))
    if campaign.shielded:
        _require_claims(cases)
    with claim_folder("certify", settings):  # the name of the command in files
        _attack_in_folder(settings, campaign, cases)


def _attack_in_folder(settings: AttackSettings, campaign: Campaign, cases: dict[str, AttackCase]) -> None:
    """Executes the batches that are missing, prints the table and writes the counts; raises as `attack` says."""
    certificates = _certificates(cases, settings.out / "certificates")
    numbers = _numbers_of_batches(len(cases), int(settings.steps // campaign.batch_steps), campaign.kinds_of_batches)
    batches = [
        MonteCarloBatch(campaign, case, index, certificate)
        for (case, certificate), number in zip(certificates.items(), numbers, strict=True)
        for index in range(number)
    ]
    counts = {case: SafetyCounts() for case, number in zip(cases, numbers, strict=True) if number}
    for batch, counted in zip(batches, results_of(batches, settings.out, settings), strict=True):
        counts[batch.case] += counted
    total = sum(counts.values(), SafetyCounts())
    print(counts_table(counts, looks_ahead=campaign.looks_ahead))
    if left_out := [name for name in cases if name not in counts]:
        listed = "; ".join([*left_out[:_MOST_LISTED], *["..."] * (len(left_out) > _MOST_LISTED)])
        budget = f"within {settings.steps:,.0f} steps"
        print(wrapped(f"{len(left_out)} of {len(cases)} cases are not attacked {budget}: {listed}"))
    limits = {name: cases[name].escape_probability() for name in counts} if campaign.gaussian else {}
    if limits:
        print("", gaussian_table(counts, limits), GAUSSIAN_LEGEND, sep="\n")
    document = {"settings": asdict(campaign), "versions": versions(), "total": total.document()}
    document["cases"] = {case: each.document() for case, each in counts.items()}
    if limits:
        document["escape_probability"] = limits
    write_atomically(settings.out / "certify.json", json.dumps(document, indent=1) + "\n")
    if campaign.shielded and campaign.gaussian:
        require_within(counts, limits)
    elif campaign.shielded:
        require_safe(total, looks_ahead=campaign.looks_ahead)


def _campaign(settings: AttackSettings) -> Campaign:
    return Campaign(
        seed=settings.seed,
        random_plants=settings.random_plants,
        envs=settings.envs,
        shielded=not settings.unshielded,
        gaussian=settings.noise == "gaussian",
        delta=settings.delta,
        env=settings.env,
        plant=settings.plant and str(settings.plant.resolve()),  # workers may have another working folder
        contract=changed_contract(None, settings.max_age, settings.quantization_step),
        mode=settings.mode,
        horizon=(settings.horizon or DEFAULT_HORIZON) if settings.mode == "lookahead" else None,
    )


def _require_claims(cases: dict[str, AttackCase]) -> None:
    """Returns if something is claimed of every case.

    Raises:
        ValueError: If a downlink promises nothing, so that there is nothing to attack.
    """
    for name, case in cases.items():
        protocol = downlink_protocol(case.downlink, case.downlink_contract)
        if protocol is not None and protocol.contract is None:
            raise ValueError(
                f"{name}: nothing is claimed behind a downlink without a contract, so that there is nothing to attack; "
                "give it max_consecutive_losses, or the environment downlink_contract=ChannelContract(c)"
            )


def _certificates(cases: dict[str, AttackCase], folder: Path) -> dict[str, Certificate]:
    """Returns the certificate of each case; those that the folder lacks are synthesized and written there."""
    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for name, case in tqdm(cases.items(), desc="certificates", leave=False, disable=None):
        contract = case.certificate_contract
        suffix = "" if contract is None else f"-{contract.max_age}-{contract.quantization_step:g}"
        file = folder / f"{case.plant.fingerprint[:16]}{suffix}.json"
        if not file.exists():
            case.certificate.save(file)
        found[name] = Certificate.load(file)
    return found


def _numbers_of_batches(cases: int, count: int, least: int) -> list[int]:
    """Returns the number of batches of each case, as even as possible, more for earlier cases.

    Args:
        cases: Number of cases.
        count: Number of batches in all that the budget allows; one at least is run.
        least: Number of kinds of batches, which take turns: they come in for the same cases where not all can.
    """
    count = max(count, 1)
    attacked = min(cases, -(-count // least))
    each, extra = divmod(count, attacked)
    return [each + (number < extra) if number < attacked else 0 for number in range(cases)]
