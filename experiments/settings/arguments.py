"""Arguments in forms that the parser does not know, `--channel loss=0.5 delay=3` and `--steps 1e5`, and checks."""

from __future__ import annotations

import hashlib
import json
import re
from decimal import Decimal, InvalidOperation
from math import inf
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
from cloudpickle import dumps
from tyro.constructors import PrimitiveConstructorSpec

from ncs_gym.reading import read_file
from ncs_gym.validation import shown
from shields.runtime.safety_filter import LONGEST_HORIZON


def _assignments(texts: list[str]) -> dict[str, Any]:
    """Returns the values by name, each a JSON value or a word such as `lin_0.003`."""
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (equals and name.isidentifier()):
            raise ValueError(f"expected NAME=VALUE, such as gamma=0.99, got {shown(text)}")
        if name in found:
            raise ValueError(f"{name} is given twice")
        found[name] = _value(name, value)
    return found


def _value(name: str, text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        if not re.fullmatch(r"[\w.+-]+", text):
            raise ValueError(
                f"expected {name}=VALUE with a word or a JSON value, such as 0.99, true or '{{\"net_arch\": [64]}}', "
                f"got {shown(text)}"
            ) from None
        return text


Assignments = Annotated[
    dict[str, Any],
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="[NAME=VALUE [NAME=VALUE ...]]",
        instance_from_str=_assignments,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda values: [f"{name}={json.dumps(value)}" for name, value in values.items()],
    ),
]


def id_alone(env_id: str) -> str:
    """Returns the id of "module:id", by which the environment is registered."""
    return env_id.rpartition(":")[2]


def registration_of(env_id: str) -> str:
    """Returns the SHA-256 of what an id is registered with, empty for none: a module may register it otherwise later.

    Functions and classes of a module count by their names: its source is another matter (`module_digest`).
    """
    spec = gym.registry.get(id_alone(env_id))
    if spec is None:
        return ""
    kwargs = dict(spec.kwargs)
    if isinstance(plant := kwargs.get("plant"), str):  # a file, which may be another one later
        kwargs["plant"] = read_file(Path(plant))
    return hashlib.sha256(dumps([sorted(kwargs.items()), spec.max_episode_steps])).hexdigest()


# Counts are below this, so that no exponent makes an endless number.
_LIMIT = Decimal("1e15")


def _step_count(texts: list[str]) -> int:
    """Returns the whole number that the only text stands for exactly."""
    try:
        number = Decimal(texts[0])
    except InvalidOperation:
        number = Decimal("NaN")
    if not (number.is_finite() and -_LIMIT < number < _LIMIT and number == int(number)):
        raise ValueError(f"expected a whole number below 1e15, such as 100000 or 1e5, got {shown(texts[0])}")
    return int(number)


def _argument(metavar: str) -> PrimitiveConstructorSpec[int | None]:
    """Returns how the parser reads and shows a number of steps, or None if the metavar has that, too."""
    optional = "None" in metavar
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda texts: None if optional and texts == ["None"] else _step_count(texts),
        is_instance=lambda value: type(value) is int or (optional and value is None),
        str_from_instance=lambda value: [str(value)],
    )


StepCount = Annotated[int, _argument("INT")]
OptionalStepCount = Annotated[int | None, _argument("{None}|INT")]


def require_limits(settings: Any, **limits: float | tuple[float, float]) -> None:
    """Raises unless settings keep their limits, the least value or that and the largest; None keeps all.

    Raises:
        ValueError: If one does not, or is infinite or NaN.
    """
    for name, limit in limits.items():
        low, high = limit if isinstance(limit, tuple) else (limit, inf)
        value = getattr(settings, name, None)
        if value is not None and not (low <= value <= high and value < inf):
            at_most = f" and at most {high:g}" if high < inf else ""
            raise ValueError(f"--{name.replace('_', '-')} must be at least {low:g}{at_most}, got {value}")


def require_horizon(settings: Any, *modes: str | None) -> None:
    """Raises unless a horizon, if there is one, is in range and for one of these modes or arms.

    Raises:
        ValueError: If it does not.
    """
    require_limits(settings, horizon=(1, LONGEST_HORIZON))
    if settings.horizon is not None and not any("lookahead" in (mode or "") for mode in modes):
        raise ValueError(f"--horizon {settings.horizon} is for mode lookahead, which is not asked for")
