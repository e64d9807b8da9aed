"""What a run is to those who execute it and keep its result: a training run, or a batch of an attack."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol


class Result(Protocol):
    """What a run leaves: a dataclass of numbers, texts and arrays, and the files of an agent."""

    @property
    def outcome(self) -> str:
        """What came out, in one line; empty for nothing that somebody waits for."""
        ...

    @property
    def files(self) -> Mapping[str, bytes]:
        """Contents of the agent's files by name; no field where a run leaves none."""
        ...


class Run(Protocol):
    """Settings of something that one process executes; its result is a pure function of them. Runs are pickled."""

    @property
    def parts(self) -> tuple[str, ...]:
        """What its steps belong to, for the progress bar."""
        ...

    @property
    def result_type(self) -> type:
        """Dataclass of its result."""
        ...

    @property
    def name(self) -> str:
        """Name in file names, progress lines and messages."""
        ...

    @property
    def key(self) -> str:
        """SHA-256 of everything that the result depends on."""
        ...

    @property
    def total_steps(self) -> int:
        """Number of simulated steps."""
        ...

    @property
    def leaves(self) -> tuple[str, ...]:
        """Names of the files that it leaves."""
        ...

    def execute(self, on_progress: Callable[[int], None], log_folder: Path | None = None) -> Any:
        """Returns the result; calls `on_progress` with the number of steps taken since its last call."""
        ...

    def require(self, result: Any) -> None:
        """Returns if a result of the right type, from a file say, can be the run's.

        Raises:
            ValueError: If it has a value that the run cannot have had; the message names it.
        """
        ...
