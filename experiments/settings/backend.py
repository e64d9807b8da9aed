"""Settings of the backend that executes the training runs of an experiment."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from typing import Literal

from experiments.settings.steps import require_least

# Address that starts a Ray cluster of its own on this machine.
OWN_CLUSTER = "local"
_ADDRESS = re.compile(r"local|auto|[\w.-]+:\d{1,5}|\[[0-9a-fA-F:]+\]:\d{1,5}")


@dataclass(frozen=True, kw_only=True)
class BackendSettings:
    """Where training runs are executed; their results do not depend on it.

    Attributes:
        engine: "local" uses processes of this machine, "ray" a Ray cluster (docs/scaling.md).
        jobs: Number of worker processes of the engine "local".
        ray_address: "local" starts a Ray on this machine for as long as it is needed, "auto" joins the one that runs
            here, HOST:PORT joins the cluster whose head that is; this machine has to be one of its nodes.
        ray_wait: Seconds to wait for a node that is large enough for a run: for clusters that grow on demand.
        cpus_per_run: Processor cores that Ray reserves for a run.
        gpus_per_run: Graphics cards that Ray reserves for a run.
    """

    engine: Literal["local", "ray"] = "local"
    jobs: int = 2
    ray_address: str = OWN_CLUSTER
    ray_wait: float = 0.0
    cpus_per_run: float = 1.0
    gpus_per_run: float = 0.0

    def __post_init__(self) -> None:
        """Raises ValueError if a value is out of range or belongs to another engine."""
        require_least(self, jobs=1, ray_wait=0, cpus_per_run=0.0001)
        if not _ADDRESS.fullmatch(self.ray_address):
            raise ValueError(f"--ray-address must be local, auto or HOST:PORT, got {self.ray_address!r}")
        whole = self.gpus_per_run <= 1.0 or self.gpus_per_run.is_integer()
        if not 0.0 <= self.gpus_per_run < float("inf") or not whole:
            raise ValueError(f"--gpus-per-run must be in [0, 1] or a whole number, got {self.gpus_per_run}")
        if self.engine == "local":
            for field in fields(BackendSettings)[2:]:
                if getattr(self, field.name) != field.default:
                    raise ValueError(f"--{field.name.replace('_', '-')} is a setting of --engine ray")
