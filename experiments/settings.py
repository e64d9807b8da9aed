"""What commands share of their settings: frozen dataclasses that the parser turns into flags, and their JSON values."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass, field, replace
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from agents.hyperparams import DEFAULTS, tuned_hyperparams, tuned_steps, with_changes
from agents.loop import LagrangianSettings
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
        try:
            found[name] = json.loads(value)
        except (ValueError, RecursionError):
            found[name] = value
            if not re.fullmatch(r"[\w.+-]+", value):
                form = """a word or a JSON value, such as 0.99, true or '{"net_arch": [64]}'"""
                raise ValueError(f"expected {name}=VALUE with {form}, got {shown(value)}") from None
    return found


# Arguments in a form that the parser does not know: `--channel loss=0.5 delay=3`.
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


def require_limits(settings: Any, **limits: float | tuple[float, float]) -> None:
    """Raises ValueError unless settings keep their limits, the least value or that and the largest; None keeps all."""
    for name, limit in limits.items():
        low, high = limit if isinstance(limit, tuple) else (limit, inf)
        value = getattr(settings, name, None)
        if value is not None and not (low <= value <= high and value < inf):
            at_most = f" and at most {high:g}" if high < inf else ""
            raise ValueError(f"--{name.replace('_', '-')} must be at least {low:g}{at_most}, got {value}")


def require_horizon(settings: Any, *modes: str | None) -> None:
    """Raises ValueError unless a horizon, if there is one, is in range and for one of these modes or arms."""
    require_limits(settings, horizon=(1, LONGEST_HORIZON))
    if settings.horizon is not None and not any("lookahead" in (mode or "") for mode in modes):
        raise ValueError(f"--horizon {settings.horizon} is for mode lookahead, which is not asked for")


@dataclass(frozen=True, kw_only=True)
class PlantSettings:
    """Which plant a command is about.

    Attributes:
        env: Id of an environment with a plant of its own; module:id imports the module first, which registers one of
            yours (`ncs_gym.register_plant`).
        plant: File of a plant that `LinearPlant.save` wrote, in place of an environment's.
    """

    env: str | None = None
    plant: Path | None = None

    def __post_init__(self) -> None:
        if self.env is not None and self.plant is not None:
            raise ValueError("give either --env or --plant, not both")


@dataclass(frozen=True, kw_only=True)
class BackendSettings:
    """Where training runs are executed; their results do not depend on it.

    Attributes:
        engine: "local" uses processes of this machine, "ray" a Ray cluster.
        jobs: Worker processes of the engine "local".
        ray_address: Of the engine "ray": "local" starts a Ray, "auto" and HOST:PORT join one of which this is a node.
    """

    engine: Literal["local", "ray"] = "local"
    jobs: int = 2
    ray_address: str = "local"

    def __post_init__(self) -> None:
        require_limits(self, jobs=1)
        if self.engine == "local" and self.ray_address != "local":
            raise ValueError("--ray-address is a setting of --engine ray")


# Settings that results do not depend on.
_INCIDENTAL = {*BackendSettings.__dataclass_fields__, "out", "force", "smoke"}


def lasting_settings(settings: Any) -> dict[str, Any]:
    """Returns the settings of a command that results depend on, JSON values; of "module:id" the id alone."""
    values = json.loads(json.dumps(asdict(settings), default=str))
    if isinstance(values.get("env"), str):
        values["env"] = id_alone(values["env"])
    return {name: value for name, value in values.items() if name not in _INCIDENTAL}


# Training steps where none belong to tuned hyperparameters.
_DEFAULT_STEPS = 150_000
Algorithm = Literal["PPO", "A2C", "SAC", "TD3", "TRPO", "TQC", "CrossQ"]
Mode = Literal["project", "lookahead", "switch", "boundary"]


@dataclass(frozen=True, kw_only=True)
class LearningSettings(BackendSettings):
    """Settings that the commands that train share.

    Attributes:
        env: Id of an environment with a plant; module:id imports the module first.
        seed: Seed of the experiment.
        steps: Training steps per run, in whole rollouts; by default those tuned for the environment, or 150,000, and
            of several algorithms the most.
        episodes: Evaluation episodes per run.
        algorithms: Learning algorithms, each of which trains every arm; TRPO, TQC and CrossQ need sb3-contrib.
        mode: What the shield applies in place of an unsafe action (in the documentation under "The shield").
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        intervention_penalty: Taken from the reward per intervention, in arms with "+penalty".
        violation_penalty: Taken from the reward per violating step, in the arm "penalized".
        certificate: Certificate file to use instead of synthesizing one.
        safe_set: What a synthesized certificate keeps.
        between_samples: Times per step at which the safe box counts; by default the plant's own.
        channel: Changes of the environment's channel: loss (of bursts
            'loss={"p_good_to_bad": 0.1, "p_bad_to_good": 0.3}'), delay, jitter, send_period, quantization_step,
            max_consecutive_losses.
        hyperparams: Hyperparameters in the words of stable-baselines3, such as gamma=0.99 or
            'policy_kwargs={"net_arch": [64]}'; others are tuned for the environment, or the default.
        lagrangian: How the arm "lagrangian" adapts its penalty per violating step.
        force: Replace results of other settings in the output folder.
    """

    env: str = "ncs_gym/TruckTrailerCruise-v0"
    seed: int = 0
    steps: int | None = None
    episodes: int = 200
    algorithms: tuple[Algorithm, ...] = ("PPO",)
    mode: Mode = "project"
    horizon: int | None = None
    intervention_penalty: float = 0.1
    violation_penalty: float = 1.0
    certificate: Path | None = None
    safe_set: Literal["polytope", "ellipsoid"] = "polytope"
    between_samples: int | None = None
    channel: Assignments = field(default_factory=dict)
    hyperparams: Assignments = field(default_factory=dict)
    lagrangian: tyro.conf.Suppress[LagrangianSettings] = field(default_factory=LagrangianSettings)
    force: bool = False

    @property
    def algorithm(self) -> Algorithm:
        """The algorithm, of several the first one."""
        return self.algorithms[0]

    @property
    def all_hyperparams(self) -> dict[str, Any]:
        """All hyperparameters of the algorithm: those given, those tuned, the defaults."""
        given, defaults = self.hyperparams, DEFAULTS[self.algorithm]
        tuned = None if given.keys() >= defaults.keys() else tuned_hyperparams(id_alone(self.env), self.algorithm)
        return with_changes(with_changes(defaults, tuned or {}), given)

    @property
    def training_steps(self) -> int:
        """Training steps per run: those given, or those tuned for the environment."""
        if self.steps is not None:
            return self.steps
        return max(tuned_steps(id_alone(self.env), algorithm) or _DEFAULT_STEPS for algorithm in self.algorithms)

    @property
    def agent_line(self) -> str:
        """All hyperparameters of the algorithm and where they come from, in one line."""
        found, given = self.all_hyperparams, self.hyperparams.keys()
        is_tuned = tuned_hyperparams(id_alone(self.env), self.algorithm) is not None
        source = f"hyperparameters tuned for {id_alone(self.env)}" if is_tuned else "default hyperparameters"
        if given == found.keys():
            source = "hyperparameters as given"
        elif given:
            source += f", as given {', '.join(name for name in found if name in given)}"
        return f"{self.algorithm}, {source}: " + ", ".join(f"{name}={value}" for name, value in found.items())

    @property
    def by_algorithm(self) -> list[Self]:
        """The settings of each algorithm alone, which all train for equally many steps."""
        return [replace(self, algorithms=(name,), steps=self.training_steps) for name in self.algorithms]

    @property
    def completed(self) -> Self:
        """The same settings for settings.json, with the steps, and with all hyperparameters of a single algorithm."""
        hyperparams = self.all_hyperparams if len(self.algorithms) == 1 else self.hyperparams
        return replace(self, steps=self.training_steps, hyperparams=hyperparams)

    def __post_init__(self) -> None:
        BackendSettings.__post_init__(self)
        if not self.algorithms or len(set(self.algorithms)) != len(self.algorithms):
            raise ValueError("--algorithms must be different algorithms, at least one")
        counts = {"seeds": 1, "steps": 1, "episodes": 1, "seed": 0}
        require_limits(self, **counts, intervention_penalty=0, violation_penalty=0)
        arms = getattr(self, "arm", ""), *getattr(self, "arms", ()), *getattr(self, "baselines", ())
        require_horizon(self, self.mode, *arms)
