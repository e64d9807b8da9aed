"""The `ncs` command.

Whatever takes time to import is imported inside `main`, where an interrupt ends the command without a traceback.
"""

from __future__ import annotations

import os
import sys

_USAGE = """usage: ncs COMMAND [OPTIONS]

Safe learning control over imperfect networks. `ncs COMMAND --help` explains
a command, `ncs --version` prints the version. The commands:
"""
_ERROR = 2
_INTERRUPTED = 130
COMMANDS = ("compare", "train", "evaluate", "sweep", "render", "synthesize", "verify", "bounds", "channel")
COMMANDS += ("requirements", "attack", "paper")
# The extra that a command needs, and the packages of an extra.
_EXTRAS = dict.fromkeys(("compare", "train", "evaluate", "sweep"), "train") | {"render": "render"}
_PACKAGES = {
    "train": ("stable_baselines3", "torch", "tensorboard", "pandas", "pyarrow", "jinja2"),
    "render": ("pygame",),
    "ray": ("ray",),
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
        command = "".join(sys.argv[1:2])
        if command == "--version":
            print(f"ncs-gym {__version__}")
        elif command in ("", "-h", "--help"):
            print(_overview())
            sys.exit(0 if command else _ERROR)
        else:
            with nullcontext() if os.environ.get("NCS_DEBUG") else warnings_as_sentences():
                settings = parse(sys.argv[1:])
                getattr(_module(command), command)(settings)
    except KeyboardInterrupt as interrupt:
        sys.exit(_complain(str(interrupt) or "interrupted", _INTERRUPTED))
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(_ERROR)
    except Exception as error:
        if os.environ.get("NCS_DEBUG"):
            raise
        from experiments.terminal import sentence_of

        sys.exit(_complain(sentence_of(error), _ERROR))


def parse(arguments: list[str]) -> object:
    """Returns the settings of the chosen command; raises ValueError if there is none of that name."""
    import tyro

    from ncs_gym.validation import shown

    command, *rest = arguments
    if command not in COMMANDS:
        raise ValueError(f"unknown command {shown(command)}; there are {', '.join(COMMANDS)}")
    _require_extra(_EXTRAS.get(command, ""))
    kind = settings_of(command)
    settings = tyro.cli(kind, prog=f"ncs {command}", args=rest, description=_description(kind))
    if getattr(settings, "engine", "local") == "ray":
        _require_extra("ray")
    return settings


def settings_of(command: str) -> type:
    """Returns the class of a command's settings."""
    return getattr(_module(command), f"{command.title()}Settings")


def _module(command: str) -> object:
    from importlib import import_module

    return import_module(f"experiments.commands.{command}")


def _require_extra(extra: str) -> None:
    """Raises ModuleNotFoundError unless the packages of an extra are installed; it says what to install."""
    from importlib.util import find_spec

    from ncs_gym.installation import install_command

    missing = [name for name in _PACKAGES.get(extra, ()) if find_spec(name) is None]
    if missing:
        raise ModuleNotFoundError(f"this command needs {', '.join(missing)}: {install_command(extra)}")


def _overview() -> str:
    """Returns the commands with the first sentence about their settings, read without importing what they need."""
    import ast
    from pathlib import Path

    from experiments.terminal import wrapped

    lines, indent = [_USAGE], max(map(len, COMMANDS)) + 4
    for name in COMMANDS:
        module = ast.parse((Path(__file__).parent / "commands" / f"{name}.py").read_text("utf-8"))
        settings = next(node for node in module.body if isinstance(node, ast.ClassDef))
        does = (ast.get_docstring(settings) or "").partition("\n\n")[0]
        lines.append(wrapped(" ".join(does.split()), label=f"  {name}", indent=indent))
    return "\n".join(lines)


def _description(settings: type) -> str:
    """Returns what the docstring of settings says of their command, in lines of the terminal's width."""
    from inspect import getdoc

    from experiments.terminal import wrapped

    text = (getdoc(settings) or "").partition("\n\nAttributes:")[0]
    return "\n\n".join(wrapped(" ".join(paragraph.split())) for paragraph in text.split("\n\n"))


def _complain(sentence: str, code: int) -> int:
    """Prints an error and returns the exit code."""
    from experiments.terminal import say

    say(f"ncs: {sentence}", indent=5)
    return code


if __name__ == "__main__":
    main()
