"""The errors that experiments raise."""

from __future__ import annotations


class OtherResultsError(ValueError):
    """An output folder holds results of other settings, which would be replaced."""


class RunError(RuntimeError):
    """A run failed, or its worker died; the message names it, the cause is its own error."""

    @classmethod
    def of(cls, name: str, error: BaseException) -> RunError:
        """Returns the error of a run by its name; only unexpected errors show their type."""
        if isinstance(error, (ValueError, OSError, ImportError)):
            return cls(f"run {name}: {error}")
        return cls(f"run {name}: {type(error).__name__}: {error} (NCS_DEBUG=1 shows the traceback)")


class RunStopped(RuntimeError):
    """A training run gave up because another run failed or the user interrupted."""


class ClusterError(RuntimeError):
    """The cluster cannot be joined, or a node has other versions than the driver."""
