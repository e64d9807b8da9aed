"""The `ncs` command.

Whatever takes time to import is imported inside `main`, where an interrupt ends the command without a traceback.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Mapping

_USAGE = """usage: ncs COMMAND [OPTIONS]

Safe learning control over imperfect networks. `ncs COMMAND --help` explains
a command, `ncs --version` prints the version. The commands:
"""
_ERROR = 2
_INTERRUPTED = 130
# What to do about an error of the operating system.
_REMEDIES = {
    errno.EEXIST: "a file stands where a folder is needed, choose another path",
    errno.ENOTDIR: "a file stands where a folder is needed, choose another path",
    errno.EISDIR: "a folder stands where a file is needed, name the file",
    errno.ENOENT: "check the path",
    errno.EACCES: "choose a path where you may read and write",
    errno.EPERM: "choose a path where you may read and write",
    errno.EROFS: "choose a path where you may write",
    errno.ENOSPC: "make room and start the command again, which keeps what is finished",
    errno.EDQUOT: "make room and start the command again, which keeps what is finished",
}
_TRAINING = {"train": ("stable_baselines3", "torch", "tensorboard", "pandas", "pyarrow", "jinja2")}
# The settings and the function of each command, and the packages that it needs of each extra.
COMMANDS: dict[str, tuple[str, str, dict[str, tuple[str, ...]]]] = {
    "compare": ("CompareSettings", "experiments.commands.compare:compare", _TRAINING),
    "train": ("TrainSettings", "experiments.commands.train:train", _TRAINING),
    "evaluate": ("EvaluateSettings", "experiments.commands.evaluate:evaluate", _TRAINING),
    "sweep": ("SweepSettings", "experiments.commands.sweep:sweep", _TRAINING),
    "render": ("RenderSettings", "experiments.commands.render:render", {"render": ("pygame",)}),
    "synthesize": ("SynthesizeSettings", "experiments.commands.synthesize:synthesize", {}),
    "verify": ("VerifySettings", "experiments.commands.verify:verify", {}),
    "export-c": ("ExportCSettings", "experiments.commands.export_c:export_c_files", {}),
    "bounds": ("BoundsSettings", "experiments.commands.bounds:bounds", {}),
    "channel": ("ChannelSettings", "experiments.commands.channel:channel", {}),
    "requirements": ("RequirementsSettings", "experiments.commands.requirements:requirements", {}),
    "attack": ("AttackSettings", "experiments.commands.attack:attack", {}),
    "audit": ("AuditSettings", "experiments.commands.audit:audit", {}),
    "reproduce": ("ReproduceSettings", "experiments.commands.reproduce:reproduce", {}),
}


def main() -> None:
    """Parses the command line and runs the command.

    Errors become one sentence on stderr and exit code 2, warnings one sentence; NCS_DEBUG=1 shows where they come from.
    """
    try:
        import signal
        import warnings
        from contextlib import nullcontext

        from experiments.terminal import warnings_as_sentences

        signal.signal(signal.SIGTERM, signal.default_int_handler)  # it ends a command as Ctrl-C does
        # Matrices are small: more threads only wait for each other. Read when numpy is imported, here and in workers.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        with warnings.catch_warnings(action="ignore"):  # what it would say is an error here
            from ncs_gym import __version__
        from ncs_gym.installation import GENERIC_NAMES, require_own_packages

        require_own_packages(*GENERIC_NAMES)
        if sys.argv[1:] == ["--version"]:
            print(f"ncs-gym {__version__}")
            return
        settings = parse(sys.argv[1:])
        with nullcontext() if os.environ.get("NCS_DEBUG") else warnings_as_sentences():
            _run(settings)
    except KeyboardInterrupt as interrupt:
        sys.exit(_complain(str(interrupt) or "interrupted", _INTERRUPTED))
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(_ERROR)
    except Exception as error:
        if os.environ.get("NCS_DEBUG"):
            raise
        sys.exit(_complain(_sentence(error), _ERROR))


def parse(arguments: list[str]) -> object:
    """Returns the settings of the chosen command."""
    from difflib import get_close_matches

    import tyro

    from experiments import settings
    from ncs_gym.validation import shown

    kinds = {name: getattr(settings, kind) for name, (kind, _, _) in COMMANDS.items()}
    command, rest = "".join(arguments[:1]), arguments[1:]
    if command in ("", "-h", "--help"):
        print(_overview(kinds))
        sys.exit(0 if command else _ERROR)
    if command not in kinds:
        near = get_close_matches(command, kinds, 1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(kinds)}"
        raise ValueError(f"unknown command {shown(command)}; {hint}")
    kind = kinds[command]
    return tyro.cli(kind, prog=f"ncs {command}", args=rest, description=_description(kind))


def _overview(kinds: Mapping[str, type]) -> str:
    """Returns the commands, each with the first sentence about it, in lines of the terminal's width."""
    from experiments.terminal import wrapped

    indent = max(map(len, kinds)) + 4
    lines = [wrapped(_first_sentence(kind), label=f"  {name}", indent=indent) for name, kind in kinds.items()]
    return "\n".join([_USAGE, *lines])


def _first_sentence(settings: type) -> str:
    from inspect import getdoc

    return " ".join((getdoc(settings) or "").partition("\n\n")[0].split())


def _description(settings: type) -> str:
    """Returns what a command does, of the docstring of its settings, in lines of the terminal's width."""
    from inspect import getdoc

    from experiments.terminal import wrapped

    text = (getdoc(settings) or "").partition("\n\nAttributes:")[0]
    return "\n\n".join(wrapped(" ".join(paragraph.split())) for paragraph in text.split("\n\n"))


def _run(settings: object) -> None:
    from importlib import import_module

    from experiments.commands import require_extra

    _, target, extras = next(entry for entry in COMMANDS.values() if entry[0] == type(settings).__name__)
    for extra, packages in extras.items():
        require_extra(extra, *packages)
    if getattr(settings, "engine", "local") == "ray":
        require_extra("ray", "ray")
    module, _, function = target.partition(":")
    getattr(import_module(module), function)(settings)


def _sentence(error: Exception) -> str:
    """Returns an error as one line; only unexpected errors show their type.

    What it quotes of a file is shown, and means nothing to a terminal.
    """
    from ncs_gym.validation import printable

    ours = type(error).__module__.partition(".")[0] == "experiments"
    expected = ours or isinstance(error, (ValueError, OSError, ImportError))
    if isinstance(error, OSError) and error.strerror:
        text = f"{error.strerror}: {error.filename}" if error.filename else error.strerror
        text += f"; {_REMEDIES[error.errno]}" if error.errno in _REMEDIES else ""
    else:
        text = str(error) if expected else f"{type(error).__name__}: {error} (NCS_DEBUG=1 shows the traceback)"
    return printable(" ".join(text.split()))


def _complain(sentence: str, code: int) -> int:
    """Prints an error on one line, on a terminal on lines of its width, and returns the exit code."""
    text = f"ncs: {sentence}"
    if sys.stderr.isatty():
        from experiments.terminal import wrapped

        text = wrapped(text, indent=5)
    print(text, file=sys.stderr, flush=True)
    return code


if __name__ == "__main__":
    main()
