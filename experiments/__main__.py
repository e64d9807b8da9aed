"""The `ncs` command."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

ERROR = 2
INTERRUPTED = 130


def main() -> None:
    """Parses the command line and runs the command; errors become one sentence on stderr and exit code 2."""
    try:
        _require_own_agents()
        settings = _parse()
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


def _parse() -> object:
    import tyro

    from experiments import settings

    return tyro.extras.subcommand_cli_from_dict(
        {
            "compare": settings.CompareSettings,
            "synthesize": settings.SynthesizeSettings,
            "verify": settings.VerifySettings,
            "audit": settings.AuditSettings,
            "reproduce": settings.ReproduceSettings,
            "render": settings.RenderSettings,
        },
        prog="ncs",
        description="Safe learning control over imperfect networks.",
    )


def _run(chosen: object) -> None:
    from experiments import settings

    if isinstance(chosen, settings.CompareSettings):
        _require_extra("train", "stable_baselines3", "torch", "tensorboard", "pyarrow")
        from experiments.compare import compare as run
    elif isinstance(chosen, settings.RenderSettings):
        if chosen.policy not in ("greedy", "zero", "random"):
            _require_extra("train", "stable_baselines3", "torch")
        _require_extra("render", "pygame", *(["moviepy"] if chosen.out.suffix == ".mp4" else []))
        from experiments.render import render as run
    elif isinstance(chosen, settings.AuditSettings):
        from experiments.audit import audit as run
    elif isinstance(chosen, settings.ReproduceSettings):
        from experiments.reproduce import reproduce as run
    elif isinstance(chosen, settings.SynthesizeSettings):
        from experiments.certificates import synthesize_file as run
    else:
        from experiments.certificates import verify_file as run
    run(chosen)


def _require_own_agents() -> None:
    """Refuses to run with another distribution's `agents` package, whose generic name ours shares."""
    spec = importlib.util.find_spec("agents")
    here = Path(__file__).resolve().parent.parent
    if spec is None or spec.origin is None or Path(spec.origin).resolve().parent.parent != here:
        raise ImportError(
            f"the package 'agents' found is not this project's ({spec.origin if spec else 'none'}): "
            "install ncs-gym in a virtual environment of its own"
        )


def _require_extra(extra: str, *packages: str) -> None:
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise ModuleNotFoundError(
            f"this command needs {', '.join(missing)}: install the extra, pip install 'ncs-gym[{extra}]'"
        )


def _sentence(error: Exception) -> str:
    """Returns an error as one line; only the unexpected ones show their type."""
    expected = isinstance(error, (ValueError, OSError, ImportError))
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
