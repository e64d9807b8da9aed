"""The errors that experiments raise."""

from __future__ import annotations

from agents.results import TrainingStopped


class SettingsError(ValueError):
    """A settings file is missing or damaged, or holds settings that the command does not take."""


class ResultsError(ValueError):
    """A stored result is missing, damaged or altered."""


class OtherResultsError(ValueError):
    """An output folder holds finished results of other settings, which would be replaced."""


class FolderInUseError(RuntimeError):
    """Another command is writing to the output folder."""


class RunError(RuntimeError):
    """A training run failed; the message names it, the cause is its own error."""

    @classmethod
    def of(cls, name: str, error: BaseException) -> RunError:
        """Returns the error of a run by its name; only unexpected errors show their type."""
        if isinstance(error, (ValueError, OSError, ImportError)):
            return cls(f"run {name}: {error}")
        return cls(f"run {name}: {type(error).__name__}: {error} (NCS_DEBUG=1 shows the traceback)")


class RunStopped(TrainingStopped):
    """A training run gave up because another run failed or the user interrupted."""


class ClusterError(RuntimeError):
    """The cluster cannot be reached or ended, is too small for a run, or has other versions than the driver."""
