"""`ncs attack`: attacks shielded control loops by Monte Carlo simulation with worst-case disturbances."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from tqdm import tqdm

from experiments.attack import MonteCarloBatch, SafetyCounts, run_batch
from experiments.attack.attack_cases import AttackCase
from experiments.attack.campaign import Campaign
from experiments.attack.counts_store import CountsStore
from experiments.attack.counts_table import GAUSSIAN_LEGEND, counts_table, gaussian_table, require_safe, require_within
from experiments.backends.execution import execute
from experiments.backends.job import Job
from experiments.runs import claim_folder, versions
from experiments.settings import BackendSettings, CertifySettings
from experiments.settings.certificates import FEWEST_ENVS, changed_contract
from ncs_gym.network import downlink_protocol
from ncs_gym.registration import EPISODE_STEPS
from shields import Certificate
from shields.atomic_write import write_atomically
from shields.runtime.safety_filter import DEFAULT_HORIZON


def attack(settings: CertifySettings) -> None:
    """Runs `ncs attack`.

    Raises:
        SafetyBroken: If a shielded state left S or its box (in mode "lookahead": its box), or a proof did not hold,
            although the channels kept their contracts; with Gaussian noise, if more episodes did so than the bound on
            their probability allows.
        ResultsError: If the stored counts are damaged.
        FolderInUseError: If another command is writing to the output folder.
        OtherResultsError: If the output folder holds finished results of other settings.
        ValueError: If there is no environment of the given id, the plant's file cannot be read, or nothing is
            claimed of an environment because its downlink promises nothing.
        Infeasible: If there is no certificate for the plant.
        CertificateError: If a certificate in the folder is damaged.
        RunError: If a batch fails.
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


def _attack_in_folder(settings: CertifySettings, campaign: Campaign, cases: dict[str, AttackCase]) -> None:
    """Executes the batches that are missing, prints the table and writes the counts; raises as `attack` says."""
    certificates = _certificate_files(cases, settings.out / "certificates")
    keys = {case: f"{campaign.key} {Certificate.load(file).checksum}" for case, file in certificates.items()}
    if campaign.env is not None:  # what a module registers may change
        keys = {case: f"{key} {cases[case].channel} {cases[case].downlink}" for case, key in keys.items()}
    store = CountsStore(settings.out / "tallies.jsonl", keys, campaign.envs)
    batches = _batches(list(cases), int(settings.steps // campaign.batch_steps), campaign.kinds_of_batches)
    missing = [each for planned in batches.values() for each in planned if each not in store.counts]
    start, steps = time.perf_counter(), campaign.batch_steps * len(missing)
    execute_batches(campaign, missing, certificates, store, settings.jobs)
    seconds = time.perf_counter() - start
    counts = {case: sum((store.counts[each] for each in planned), SafetyCounts()) for case, planned in batches.items()}
    total = sum(counts.values(), SafetyCounts())
    print(counts_table(counts, looks_ahead=campaign.looks_ahead))
    if left_out := len(cases) - len(batches):
        print(f"{left_out} of {len(cases)} cases are not attacked within {settings.steps:,.0f} steps")
    limits = {name: cases[name].escape_probability() for name in batches} if campaign.gaussian else {}
    if limits:
        print("", gaussian_table(counts, limits), GAUSSIAN_LEGEND, sep="\n")
    if steps > 0:
        rate = steps / seconds
        speed = f"{rate / 1e6:.2f} million" if rate >= 1e5 else f"{rate:,.0f}"
        print(f"{steps:,} steps in {seconds:.0f} s: {speed} per second")
    document = {"settings": asdict(campaign), "versions": versions(), "total": total.document()}
    document["cases"] = {case: each.document() for case, each in counts.items()}
    if limits:
        document["escape_probability"] = limits
    write_atomically(settings.out / "certify.json", json.dumps(document, indent=1) + "\n")
    if campaign.shielded and campaign.gaussian:
        require_within(counts, limits)
    elif campaign.shielded:
        require_safe(total, looks_ahead=campaign.looks_ahead)


def execute_batches(
    campaign: Campaign,
    missing: Sequence[MonteCarloBatch],
    certificates: Mapping[str, Path],
    store: CountsStore,
    workers: int,
) -> None:
    """Executes batches in worker processes, and stores the counts of each that is finished.

    Args:
        campaign: Settings of the campaign.
        missing: Batches to execute; a worker prepares a case once for all batches of it in a row.
        certificates: File with the certificate of each case.
        store: Store of the counts.
        workers: Number of worker processes.

    Raises:
        RunError: If a batch fails.
        OSError: If the counts cannot be written.
    """
    jobs = {}
    for batch in missing:
        work = partial(run_batch, campaign, batch, certificates[batch.case])
        jobs[Job(f"{batch.case}, batch {batch.index}", campaign.batch_steps, work)] = batch
    if jobs:
        execute(list(jobs), BackendSettings(jobs=workers), lambda job, counts: store.add(jobs[job], counts))


def _campaign(settings: CertifySettings) -> Campaign:
    return Campaign(
        seed=settings.seed,
        random_plants=settings.random_plants,
        envs=settings.envs,
        shielded=not settings.unshielded,
        gaussian=settings.noise == "gaussian",
        delta=settings.delta,
        env=settings.env,
        plant=None if settings.plant is None else str(settings.plant),
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


def _certificate_files(cases: dict[str, AttackCase], folder: Path) -> dict[str, Path]:
    """Returns a file with the certificate of each case; certificates that are missing are synthesized."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {}
    for name, case in tqdm(cases.items(), desc="certificates", leave=False, disable=None):
        contract = case.certificate_contract
        suffix = "" if contract is None else f"-{contract.max_age}-{contract.quantization_step:g}"
        files[name] = folder / f"{case.plant.fingerprint[:16]}{suffix}.json"
        if not files[name].exists():
            case.certificate.save(files[name])
    return files


def _batches(cases: list[str], count: int, least: int) -> dict[str, list[MonteCarloBatch]]:
    """Returns the batches of each case that has some, as evenly as possible, earlier cases first.

    Args:
        cases: Names of the cases.
        count: Number of batches in all that the budget allows; one at least is run.
        least: Number of kinds of batches, which take turns: they come in for the same cases where not all can.
    """
    count = max(count, 1)
    if count < least * len(cases):
        cases = cases[: -(-count // least)]
    each, extra = divmod(count, len(cases))
    return {
        name: [MonteCarloBatch(name, index) for index in range(each + (number < extra))]
        for number, name in enumerate(cases)
    }
