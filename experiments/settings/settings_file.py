"""The settings of a command as JSON values, as its files keep them."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from experiments.settings.arguments import id_alone
from experiments.settings.learning import BackendSettings

# Settings that results do not depend on.
_INCIDENTAL = {*BackendSettings.__dataclass_fields__, "out", "force", "smoke"}


def lasting_settings(settings: Any) -> dict[str, Any]:
    """Returns the settings of a command that results depend on, JSON values; of "module:id" the id alone."""
    values = json.loads(json.dumps(asdict(settings), default=str))
    if isinstance(values.get("env"), str):
        values["env"] = id_alone(values["env"])
    return {name: value for name, value in values.items() if name not in _INCIDENTAL}
