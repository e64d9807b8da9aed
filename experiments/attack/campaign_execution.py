"""Executes the batches of a campaign in worker processes."""

from __future__ import annotations

import multiprocessing
import warnings
from collections import deque
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack
from pathlib import Path

from experiments.attack.campaign import Campaign
from experiments.attack.counts_store import CountsStore
from experiments.attack.monte_carlo_batch import MonteCarloBatch, run_batch
from experiments.attack.safety_counts import SafetyCounts
from experiments.backends import initialize_worker
from experiments.backends.execution import progress_bar
from experiments.warning_sentences import warnings_sent

# Batches of each case that are not finished.
_MissingBatches = dict[str, deque[MonteCarloBatch]]


def execute_batches(
    campaign: Campaign, missing: _MissingBatches, certificates: dict[str, Path], store: CountsStore, jobs: int
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
                pending[worker.submit(_counts_and_warnings, campaign, batch, certificates[batch.case])] = worker, batch

        for _ in range(min(jobs, count)):
            worker = stack.enter_context(ProcessPoolExecutor(1, mp_context=context, initializer=initialize_worker))
            assigned[worker] = _batches_of_worker(missing, unassigned)
            submit_next(worker)
        while pending:
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                worker, batch = pending.pop(future)
                counts, texts = future.result()
                for text in texts:
                    warnings.warn(text, stacklevel=1)
                store.add(batch, counts)
                bar.update(campaign.batch_steps)
                submit_next(worker)


def _counts_and_warnings(
    campaign: Campaign, batch: MonteCarloBatch, certificate: Path
) -> tuple[SafetyCounts, list[str]]:
    """Executes a batch in a worker process, whose warnings belong above the progress bar of this one."""
    texts: list[str] = []
    with warnings_sent(texts.append):
        return run_batch(campaign, batch, certificate), texts


def _batches_of_worker(missing: _MissingBatches, unassigned: deque[str]) -> Iterator[MonteCarloBatch]:
    """Yields batches for one worker: of cases that no worker has, and then of the case with most batches left."""
    while any(missing.values()):
        name = unassigned.popleft() if unassigned else max(missing, key=lambda case: len(missing[case]))
        while missing[name]:
            yield missing[name].popleft()
