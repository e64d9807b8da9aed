"""Executes the batches of a campaign in worker processes."""

from __future__ import annotations

import math
import multiprocessing
from collections import deque
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack
from pathlib import Path

from tqdm import tqdm

from experiments.attack.attack_cases import AttackCase
from experiments.attack.counts_store import CountsStore
from experiments.attack.monte_carlo_batch import Campaign, MonteCarloBatch, run_batch
from experiments.backends import initialize_worker
from experiments.backends.execution import progress_bar

# Batches of each case that are not finished.
MissingBatches = dict[str, deque[MonteCarloBatch]]


def certificate_files(cases: dict[str, AttackCase], folder: Path) -> dict[str, Path]:
    """Returns a file with the certificate of each case; certificates that are missing are synthesized.

    Raises:
        OSError: If the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = {}
    for name, case in tqdm(cases.items(), desc="certificates", leave=False, disable=None):
        contract = "" if case.contract is None else f"-{case.contract.max_age}-{case.contract.quantization_step:g}"
        files[name] = folder / f"{case.plant.fingerprint[:16]}{contract}.json"
        if not files[name].exists():
            case.certificate.save(files[name])
    return files


def split_into_batches(cases: list[str], count: float, least: int) -> dict[str, list[MonteCarloBatch]]:
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


def execute_batches(
    campaign: Campaign, missing: MissingBatches, certificates: dict[str, Path], store: CountsStore, jobs: int
) -> None:
    """Executes batches in worker processes, and stores the counts of each that is finished.

    Batches of one case go to the same worker as long as there are other cases, because a worker prepares each case
    once. The first failure stops the others and is raised.

    Args:
        campaign: Settings of the campaign.
        missing: Batches to execute; they are removed.
        certificates: File with the certificate of each case.
        store: Store of the counts.
        jobs: Number of worker processes.
    """
    count = sum(map(len, missing.values()))
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        bar = stack.enter_context(progress_bar(count * campaign.batch_steps))
        unassigned = deque(missing)
        pending: dict[Future, tuple[ProcessPoolExecutor, MonteCarloBatch]] = {}
        assigned: dict[ProcessPoolExecutor, Iterator[MonteCarloBatch]] = {}

        def submit_next(worker: ProcessPoolExecutor) -> None:
            batch = next(assigned[worker], None)
            if batch is not None:
                pending[worker.submit(run_batch, campaign, batch, certificates[batch.case])] = worker, batch

        for _ in range(min(jobs, count)):
            worker = stack.enter_context(ProcessPoolExecutor(1, mp_context=context, initializer=initialize_worker))
            assigned[worker] = _batches_of_worker(missing, unassigned)
            submit_next(worker)
        while pending:
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                worker, batch = pending.pop(future)
                store.add(batch, future.result())
                bar.update(campaign.batch_steps)
                submit_next(worker)


def _batches_of_worker(missing: MissingBatches, unassigned: deque[str]) -> Iterator[MonteCarloBatch]:
    """Yields batches for one worker: of cases that no worker has, and then of the case with most batches left."""
    while any(missing.values()):
        name = unassigned.popleft() if unassigned else max(missing, key=lambda case: len(missing[case]))
        while missing[name]:
            yield missing[name].popleft()
