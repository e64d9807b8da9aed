"""Shielded loops under attack: the Monte Carlo campaign behind `ncs certify`."""

from __future__ import annotations

import json
import math
import multiprocessing
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from experiments.attack.attack_cases import Case, cases
from experiments.attack.counts_store import TallyStore
from experiments.attack.monte_carlo_batch import MODES, SETTLED, Block, Campaign, run_block
from experiments.attack.safety_counts import Tally
from experiments.backends.progress import progress_bar
from experiments.backends.worker_init import belong_to_parent
from experiments.errors import SafetyBroken
from experiments.runs.provenance import versions
from experiments.settings.certificates import CertifySettings
from shields import Certificate
from shields.atomic_write import write_atomically

LEGEND = f"""failed: episodes that left S or the box; p <: upper end of the exact 95 % interval of its probability here;
margin: smallest 1 - sqrt(x'Mx) from step {SETTLED} on (starts are on the boundary); overridden: steps that
the shield changed or, unshielded, would have changed"""


def certify(settings: CertifySettings) -> None:
    """Runs `ncs certify`.

    Raises:
        SafetyBroken: If a shielded state left S or its box, or a proof did not hold.
        ResultsError: If the folder's tallies are damaged.
        CertificateError: If a certificate in the folder is damaged.
        OSError: If the folder cannot be written.
    """
    campaign = Campaign(
        seed=settings.seed,
        random_plants=settings.random_plants,
        envs=settings.envs,
        shielded=not settings.unshielded,
    )
    attacked = cases(campaign.seed, campaign.random_plants)
    certificates = _certificates(attacked, settings.out / "certificates")
    keys = {case: f"{campaign.key} {Certificate.load(file).checksum}" for case, file in certificates.items()}
    store = TallyStore(settings.out / "tallies.jsonl", keys)
    least = len(MODES) if campaign.shielded else 1
    blocks = _blocks(list(attacked), settings.steps / campaign.block_steps, least)
    missing = {case: deque(block for block in some if block not in store.tallies) for case, some in blocks.items()}
    start, steps = time.perf_counter(), campaign.block_steps * sum(len(some) for some in missing.values())
    _run(campaign, missing, certificates, store, settings.jobs)
    seconds = time.perf_counter() - start
    tallies = {case: sum((store.tallies[block] for block in some), Tally()) for case, some in blocks.items()}
    total = sum(tallies.values(), Tally())
    print(_table(tallies, total))
    print(LEGEND)
    if steps > 0:
        print(f"{steps:,} steps in {seconds:.0f} s: {steps / seconds / 1e6:.2f} million per second")
    document = {"settings": asdict(campaign), "versions": versions(), "total": total.document()}
    document["cases"] = {case: tally.document() for case, tally in tallies.items()}
    write_atomically(settings.out / "certify.json", json.dumps(document, indent=1) + "\n")
    if campaign.shielded and (total.exits or total.violations or total.unproved):
        raise SafetyBroken(
            f"{total.exits:,} steps outside S, {total.violations:,} outside the box, {total.unproved:,} without a proof"
        )


def _certificates(attacked: dict[str, Case], folder: Path) -> dict[str, Path]:
    """Returns a file with each case's certificate; synthesizes those that are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {}
    for name, case in tqdm(attacked.items(), desc="certificates", leave=False, disable=None):
        contract = "" if case.contract is None else f"-{case.contract.max_age}-{case.contract.quantization_step:g}"
        files[name] = folder / f"{case.plant.fingerprint[:16]}{contract}.json"
        if not files[name].exists():
            case.certificate.save(files[name])
    return files


def _blocks(names: list[str], count: float, least: int) -> dict[str, list[Block]]:
    """Returns at least so many blocks in all, and `least` of each case, as evenly as possible: earlier cases first."""
    each, extra = divmod(max(math.ceil(count), least * len(names)), len(names))
    return {name: [Block(name, index) for index in range(each + (number < extra))] for number, name in enumerate(names)}


def _run(
    campaign: Campaign, missing: dict[str, deque[Block]], certificates: dict[str, Path], store: TallyStore, jobs: int
) -> None:
    """Runs blocks in worker processes, a case in one of them as long as there are others: it learns its patterns once.

    The first failure stops the rest and is raised; tallies of finished blocks are stored.
    """
    count = sum(len(some) for some in missing.values())
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        bar = stack.enter_context(progress_bar(count * campaign.block_steps))
        waiting = deque(missing)
        pending: dict[Future, tuple[ProcessPoolExecutor, Block]] = {}
        turns: dict[ProcessPoolExecutor, Iterator[Block]] = {}

        def go_on(worker: ProcessPoolExecutor) -> None:
            block = next(turns[worker], None)
            if block is not None:
                pending[worker.submit(run_block, campaign, block, certificates[block.case])] = worker, block

        for _ in range(min(jobs, count)):
            worker = stack.enter_context(ProcessPoolExecutor(1, mp_context=context, initializer=belong_to_parent))
            turns[worker] = _turn(missing, waiting)
            go_on(worker)
        while pending:
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                worker, block = pending.pop(future)
                store.add(block, future.result())
                bar.update(campaign.block_steps)
                go_on(worker)


def _turn(missing: dict[str, deque[Block]], waiting: deque[str]) -> Iterator[Block]:
    """Yields blocks for one worker: of a case that nobody has begun, at last of the one with the most left."""
    while any(missing.values()):
        name = waiting.popleft() if waiting else max(missing, key=lambda case: len(missing[case]))
        while missing[name]:
            yield missing[name].popleft()


def _table(tallies: dict[str, Tally], total: Tally) -> str:
    """Returns the results as text."""
    head = ("case", "steps", "outside S", "outside box", "episodes", "failed", "p <", "margin", "overridden")
    rows: list[tuple[str, ...]] = [head]
    for name, tally in [*tallies.items(), ("all", total)]:
        counts = tally.steps, tally.exits, tally.violations, tally.episodes, tally.broken_episodes
        shares = f"{tally.bound:.1e}", f"{tally.margin:.1e}", f"{tally.interventions / tally.steps:.1%}"
        rows.append((name, *(f"{count:,}" for count in counts), *shares))
    widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
    lines = [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        )
        for row in rows
    ]
    rule = "-" * len(lines[0])
    return "\n".join([lines[0], rule, *lines[1:-1], rule, lines[-1]])
