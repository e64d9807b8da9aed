"""Plants that many tests share.

What takes long is imported by the fixtures: the process that only hands tests out to others needs none of it.
"""

from __future__ import annotations

import fcntl
import gc
import os
import shutil
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest import mock

# One thread per process, as in `ncs`: tests run side by side, and on small matrices waiting threads only burn time.
# Read when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

# Nor does it walk through what is being imported, of which nothing is garbage.
gc.set_threshold(100_000, 50, 100)

if TYPE_CHECKING:
    from ncs_gym import LinearPlant
    from shields import Certificate

# Gymnasium's checker tries every render mode: no windows while tests run.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

SLOWEST = 25


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of a test with `cases(n)` n cases stay in `make test`, far from each other; the others are slow."""
    tests: dict[str, list[pytest.Item]] = defaultdict(list)
    for item in items:
        if item.get_closest_marker("cases") and not item.get_closest_marker("slow"):
            tests[item.nodeid.partition("[")[0]].append(item)
    for cases in tests.values():
        kept = cases[0].get_closest_marker("cases").args[0]
        # Multiples of the golden ratio modulo 1 are spread evenly, however many there are.
        for _, case in sorted(enumerate(cases), key=lambda each: each[0] * 0.618034 % 1.0)[kept:]:
            case.add_marker("slow")


def pytest_collection_finish() -> None:
    """What is imported by now stays: the collector of garbage does not walk through it again and again."""
    gc.freeze()


def pytest_configure(config: pytest.Config) -> None:
    """Processor times are listed by the process that prints, which hears of every worker's tests."""
    config.pluginmanager.register(ProcessorTimes(), "processor-times")


class ProcessorTimes:
    """Processor time of each test, its fixtures and its child processes; a busy machine hardly changes it."""

    def __init__(self) -> None:
        self.by_test: dict[str, float] = defaultdict(float)
        self.reported = 0.0

    def pytest_collection_finish(self) -> None:
        """Tests are about to begin."""
        self.reported = processor_seconds()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Puts the time since the report before into a report, which travels from worker to controller."""
        report = yield
        now = processor_seconds()
        report.processor_seconds, self.reported = now - self.reported, now
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Adds up the reports of set-up, call and tear-down."""
        self.by_test[report.nodeid] += getattr(report, "processor_seconds", 0.0)  # a crashed worker tells none

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Prints the slowest tests and files, and the sum."""
        if not self.by_test:
            return
        by_file: defaultdict[str, float] = defaultdict(float)
        for test, seconds in self.by_test.items():
            by_file[test.partition("::")[0]] += seconds
        for title, spent in (("files", by_file), ("tests and all", self.by_test)):
            terminalreporter.section(f"processor time [s], the {SLOWEST} slowest {title}")
            for name, seconds in sorted(spent.items(), key=lambda each: -each[1])[:SLOWEST]:
                terminalreporter.write_line(f"{seconds:8.1f}  {name}")
        terminalreporter.write_line(f"{sum(self.by_test.values()):8.1f}  all {len(self.by_test):,} tests")
        terminalreporter.write_line(f"{processor_seconds():8.1f}  with imports and the collection of tests")


def processor_seconds() -> float:
    """Processor time of this process and of the ended processes that it started [s]."""
    return sum(os.times()[:4])


@pytest.fixture(scope="session")
def plant() -> LinearPlant:
    """The plant of the case study."""
    from ncs_gym import truck_trailer

    return truck_trailer()


@pytest.fixture(scope="session")
def loaded() -> LinearPlant:
    """The plant of the cruise."""
    from ncs_gym import truck_trailer

    return truck_trailer(mass=4000.0)


@pytest.fixture(scope="session")
def certificate(loaded: LinearPlant) -> Certificate:
    """A certificate for the cruise."""
    from tests.certificates import certificate_of

    return certificate_of(loaded)


@pytest.fixture(autouse=True)
def _nothing_is_left_to_chance() -> Iterator[None]:
    """What a test draws without a seed of its own is the same in every run: seeds 0, 1, ... in the order of asking."""
    from gymnasium.utils import seeding

    seeds, seeded = count(), seeding.np_random
    with mock.patch.object(seeding, "np_random", lambda seed=None: seeded(next(seeds) if seed is None else seed)):
        yield


@pytest.fixture
def without_workers() -> Iterator[None]:
    """Commands start no worker processes, which would have to import everything."""
    from tests.workers import no_worker_processes

    with no_worker_processes():
        yield


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """Returns the folder of a name; whichever worker is first fills it, the others wait and find it filled."""
    own = tmp_path_factory.getbasetemp()
    return partial(_folder_of, own.parent if "PYTEST_XDIST_WORKER" in os.environ else own)


def _folder_of(place: Path, name: str, make: Callable[[Path], None]) -> Path:
    folder, done = place / name, place / f"{name}.done"
    with (place / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            done.touch()
    return folder


@pytest.fixture(scope="session", autouse=True)
def _nothing_synthesized_twice(request: pytest.FixtureRequest) -> None:
    """Certificates are synthesized once for a state of the source."""
    from tests.certificates import keep_certificates, source_digest

    if (cache := getattr(request.config, "cache", None)) is not None:
        keep_certificates(partial(_folder_of, cache.mkdir(f"certificates-{source_digest()}")))
