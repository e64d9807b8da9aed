"""`ncs certify`: attacks shielded control loops by Monte Carlo simulation with worst-case disturbances."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from experiments.analysis.text_table import text_table
from experiments.attack import MonteCarloBatch, SafetyCounts
from experiments.attack.attack_cases import AttackCase, attack_cases
from experiments.attack.campaign_execution import execute_batches
from experiments.attack.counts_store import CountsStore
from experiments.attack.gaussian_table import GAUSSIAN_LEGEND, gaussian_table, require_within
from experiments.attack.monte_carlo_batch import SETTLING_STEPS, SHIELD_MODES, Campaign
from experiments.errors import SafetyBroken
from experiments.runs import versions
from experiments.settings import CertifySettings
from shields import Certificate
from shields.atomic_write import write_atomically

_LEGEND = f"""failed: episodes that left S or the box; p <: upper end of the exact 95 % interval of their probability;
margin: smallest 1 - sqrt(x'Mx) from step {SETTLING_STEPS} on (episodes start on the boundary); overridden: steps that
the shield changed or, unshielded, would have changed"""


def certify(settings: CertifySettings) -> None:
    """Runs `ncs certify`.

    Raises:
        SafetyBroken: If a shielded state left S or its box, or a proof did not hold; with Gaussian noise, if episodes
            left S more often than the bound on their probability allows.
        ResultsError: If the stored counts are damaged.
        ValueError: If there is no environment of the given id.
        CertificateError: If a certificate in the folder is damaged.
        OSError: If the folder cannot be written.
    """
    campaign = Campaign(
        seed=settings.seed,
        random_plants=settings.random_plants,
        envs=settings.envs,
        shielded=not settings.unshielded,
        gaussian=settings.noise == "gaussian",
        delta=settings.delta,
        env=settings.env,
    )
    cases = attack_cases(campaign.seed, campaign.random_plants, campaign.env)
    cases = {name: case.with_delta(campaign.delta) for name, case in cases.items()}
    certificates = _certificate_files(cases, settings.out / "certificates")
    keys = {case: f"{campaign.key} {Certificate.load(file).checksum}" for case, file in certificates.items()}
    if campaign.env is not None:  # what a module registers may change
        keys = {case: f"{key} {cases[case].channel}" for case, key in keys.items()}
    store = CountsStore(settings.out / "tallies.jsonl", keys)
    least = len(SHIELD_MODES) if campaign.shielded else 1
    batches = _batches(list(cases), settings.steps / campaign.batch_steps, least)
    missing = {case: deque(each for each in some if each not in store.counts) for case, some in batches.items()}
    start, steps = time.perf_counter(), campaign.batch_steps * sum(map(len, missing.values()))
    execute_batches(campaign, missing, certificates, store, settings.jobs)
    seconds = time.perf_counter() - start
    counts = {case: sum((store.counts[each] for each in some), SafetyCounts()) for case, some in batches.items()}
    total = sum(counts.values(), SafetyCounts())
    print(_table(counts, total), _LEGEND, sep="\n")
    limits = {name: case.escape_probability() for name, case in cases.items()} if campaign.gaussian else {}
    if limits:
        print("", gaussian_table(counts, limits), GAUSSIAN_LEGEND, sep="\n")
    if steps > 0:
        print(f"{steps:,} steps in {seconds:.0f} s: {steps / seconds / 1e6:.2f} million per second")
    document = {"settings": asdict(campaign), "versions": versions(), "total": total.document()}
    document["cases"] = {case: each.document() for case, each in counts.items()}
    if limits:
        document["escape_probability"] = limits
    write_atomically(settings.out / "certify.json", json.dumps(document, indent=1) + "\n")
    if campaign.shielded and campaign.gaussian:
        require_within(counts, limits)
    elif campaign.shielded and (total.exits or total.violations or total.unproved):
        raise SafetyBroken(
            f"{total.exits:,} steps outside S, {total.violations:,} outside the box, {total.unproved:,} without a proof"
        )


def _certificate_files(cases: dict[str, AttackCase], folder: Path) -> dict[str, Path]:
    """Returns a file with the certificate of each case; certificates that are missing are synthesized."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {}
    for name, case in tqdm(cases.items(), desc="certificates", leave=False, disable=None):
        contract = "" if case.contract is None else f"-{case.contract.max_age}-{case.contract.quantization_step:g}"
        files[name] = folder / f"{case.plant.fingerprint[:16]}{contract}.json"
        if not files[name].exists():
            case.certificate.save(files[name])
    return files


def _batches(cases: list[str], count: float, least: int) -> dict[str, list[MonteCarloBatch]]:
    """Returns the batches of each case, as evenly as possible, earlier cases first.

    Args:
        cases: Names of the cases.
        count: Smallest number of batches in all.
        least: Smallest number of batches of each case.
    """
    each, extra = divmod(max(math.ceil(count), least * len(cases)), len(cases))
    return {
        name: [MonteCarloBatch(name, index) for index in range(each + (number < extra))]
        for number, name in enumerate(cases)
    }


def _table(counts: dict[str, SafetyCounts], total: SafetyCounts) -> str:
    """Returns the results as text."""
    rows = [["case", "steps", "outside S", "outside box", "episodes", "failed", "p <", "margin", "overridden"]]
    for name, case in [*counts.items(), ("all", total)]:
        numbers = case.steps, case.exits, case.violations, case.episodes, case.broken_episodes
        rates = f"{case.bound:.1e}", f"{case.margin:.1e}", f"{case.interventions / case.steps:.1%}"
        rows.append([name, *(f"{number:,}" for number in numbers), *rates])
    return text_table(rows, rules=(1, len(rows) - 1))
