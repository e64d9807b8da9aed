"""The `ncs` command."""

from __future__ import annotations

import importlib
import importlib.util
import os
import signal
import sys
from pathlib import Path

ERROR = 2
INTERRUPTED = 130


def main() -> None:
    """Parses the command line and runs the command; errors become one sentence on stderr and exit code 2."""
    signal.signal(signal.SIGTERM, _interrupt)
    # Matrices are small: more threads only wait for each other. Read when numpy is imported, here and in workers.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        _require_own_agents()
        settings = _parse(sys.argv[1:])
        _run(settings)
    except KeyboardInterrupt:
        sys.exit(_complain("interrupted", INTERRUPTED))
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(ERROR)
    except Exception as error:
        if os.environ.get("NCS_DEBUG"):
            raise
        sys.exit(_complain(_sentence(error), ERROR))


TRAINING = {"train": ("stable_baselines3", "torch", "tensorboard", "pyarrow")}
# What each command runs, and the packages of extras it needs.
COMMANDS: dict[str, tuple[str, str, dict[str, tuple[str, ...]]]] = {
    "compare": ("CompareSettings", "experiments.commands.compare:compare", TRAINING),
    "train": ("TrainSettings", "experiments.commands.train:train_agent", TRAINING),
    "evaluate": ("EvaluateSettings", "experiments.commands.train:evaluate_agent", TRAINING),
    "sweep": ("SweepSettings", "experiments.commands.sweep:sweep", TRAINING),
    "render": ("RenderSettings", "experiments.commands.render:render", {"render": ("pygame",)}),
    "synthesize": ("SynthesizeSettings", "experiments.commands.synthesize:synthesize_file", {}),
    "verify": ("VerifySettings", "experiments.commands.synthesize:verify_file", {}),
    "certify": ("CertifySettings", "experiments.commands.certify:certify", {}),
    "audit": ("AuditSettings", "experiments.paper.audit:audit", {}),
    "reproduce": ("ReproduceSettings", "experiments.commands.reproduce:reproduce", {}),
}


def _parse(arguments: list[str]) -> object:
    import tyro

    from experiments.settings import certificates as proof_settings
    from experiments.settings import learning as settings
    from experiments.settings.settings_file import with_config

    kinds = vars(settings) | vars(proof_settings)

    def parsed(given: list[str]) -> object:
        return tyro.extras.subcommand_cli_from_dict(
            {name: kinds[kind] for name, (kind, _, _) in COMMANDS.items()},
            prog="ncs",
            description="Safe learning control over imperfect networks.",
            args=given,
        )

    return parsed(with_config(arguments, parsed))


def _run(chosen: object) -> None:
    from experiments.commands import require_extra

    _, target, extras = next(entry for entry in COMMANDS.values() if entry[0] == type(chosen).__name__)
    for extra, packages in extras.items():
        require_extra(extra, *packages)
    if getattr(chosen, "engine", "local") == "ray":
        require_extra("ray", "ray")
    module, _, function = target.partition(":")
    getattr(importlib.import_module(module), function)(chosen)


def _interrupt(number: int, frame: object) -> None:
    """Ends on SIGTERM as on Ctrl-C: workers are stopped, finished runs are kept."""
    raise KeyboardInterrupt


def _require_own_agents() -> None:
    """Refuses to run with another distribution's `agents` package, whose generic name ours shares."""
    spec = importlib.util.find_spec("agents")
    here = Path(__file__).resolve().parent.parent
    if spec is None or spec.origin is None or Path(spec.origin).resolve().parent.parent != here:
        raise ImportError(
            f"the package 'agents' found is not this project's ({spec.origin if spec else 'none'}): "
            "install ncs-gym in a virtual environment of its own"
        )


def _sentence(error: Exception) -> str:
    """Returns an error as one line; only the unexpected ones show their type."""
    ours = type(error).__module__.partition(".")[0] == "experiments"
    expected = ours or isinstance(error, (ValueError, OSError, ImportError))
    if isinstance(error, OSError) and error.strerror:
        text = f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    else:
        text = str(error) if expected else f"{type(error).__name__}: {error} (NCS_DEBUG=1 shows the traceback)"
    return " ".join(text.split())


def _complain(sentence: str, code: int) -> int:
    print(f"ncs: {sentence}", file=sys.stderr)
    return code


if __name__ == "__main__":
    main()
