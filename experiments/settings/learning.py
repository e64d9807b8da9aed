"""Settings of the commands that train agents or evaluate them, and of what executes their runs."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Self

import tyro

from agents.hyperparams import DEFAULTS, tuned_hyperparams, tuned_steps, with_changes
from agents.loop import LagrangianSettings
from experiments.settings.arguments import (
    Assignments,
    OptionalStepCount,
    StepCount,
    id_alone,
    require_horizon,
    require_limits,
)
from ncs_gym.validation import shown

_ADDRESS = re.compile(r"local|auto|[\w.-]+:\d{1,5}|\[[0-9a-fA-F:]+\]:\d{1,5}")


@dataclass(frozen=True, kw_only=True)
class BackendSettings:
    """Where training runs are executed; their results do not depend on it.

    Attributes:
        engine: "local" uses processes of this machine, "ray" a Ray cluster (docs/scaling.md).
        jobs: Worker processes of the engine "local".
        ray_address: Of the engine "ray": "local" starts a Ray, "auto" and HOST:PORT join one of which this is a node.
    """

    engine: Literal["local", "ray"] = "local"
    jobs: int = 2
    ray_address: str = "local"

    def __post_init__(self) -> None:
        require_limits(self, jobs=1)
        if not _ADDRESS.fullmatch(self.ray_address):
            raise ValueError(f"--ray-address must be local, auto or HOST:PORT, got {self.ray_address!r}")
        if self.engine == "local" and self.ray_address != "local":
            raise ValueError("--ray-address is a setting of --engine ray")


# Training steps where none belong to tuned hyperparameters.
_DEFAULT_STEPS = 150_000
Algorithm = Literal["PPO", "A2C", "SAC", "TD3", "TRPO", "TQC", "CrossQ"]
Mode = Literal["project", "lookahead", "switch", "boundary"]


@dataclass(frozen=True, kw_only=True)
class LearningSettings(BackendSettings):
    """Settings that the commands that train share.

    Attributes:
        env: Id of an environment with a plant; module:id imports the module first.
        seed: Seed of the experiment, >= 0.
        steps: Training steps per run, in whole rollouts; by default those tuned for the environment, or 150,000.
        episodes: Evaluation episodes per run.
        algo: Learning algorithm; TRPO, TQC and CrossQ need sb3-contrib.
        mode: What the shield applies in place of an unsafe action (docs/shield.md).
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        intervention_penalty: Taken from the reward per intervention, in arms with "+penalty".
        violation_penalty: Taken from the reward per violating step, in the arm "penalized".
        certificate: Certificate file to use instead of synthesizing one.
        safe_set: What a synthesized certificate keeps.
        between_samples: Times per step at which the safe box counts (docs/shield.md); by default the plant's own.
        channel: Changes of the environment's channel: loss, burst_length (mean number of packets lost in a row), delay,
            jitter, send_period, quantization_step, max_consecutive_losses.
        hyperparams: Hyperparameters in the words of stable-baselines3, such as gamma=0.99 or
            'policy_kwargs={"net_arch": [64]}'; others are tuned for the environment, or the default.
        lagrangian: How the arm "lagrangian" adapts its penalty per violating step; no option of the command line.
        smoke: Run a short version to see that everything works, by default in a folder with -smoke in its name.
        force: Replace results of other settings in the output folder.
    """

    env: str = "ncs_gym/TruckTrailerCruise-v0"
    seed: int = 0
    steps: OptionalStepCount = None
    episodes: int = 200
    algo: Algorithm = "PPO"
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
    smoke: bool = False
    force: bool = False

    @property
    def all_hyperparams(self) -> dict[str, Any]:
        """All hyperparameters of the algorithm: those given, those tuned, the defaults."""
        given, env_id = self.hyperparams, id_alone(self.env)
        tuned = None if given.keys() >= DEFAULTS[self.algo].keys() else tuned_hyperparams(env_id, self.algo)
        found = with_changes(with_changes(DEFAULTS[self.algo], tuned or {}), given)
        return {name: value for name, value in found.items() if name != "n_timesteps"}

    @property
    def training_steps(self) -> int:
        """Training steps per run: those given, or those that belong to the hyperparameters.

        Raises:
            ValueError: If the hyperparameter `n_timesteps` is no number of steps.
        """
        if self.steps is not None:
            return self.steps
        steps = self.hyperparams.get("n_timesteps", tuned_steps(id_alone(self.env), self.algo) or _DEFAULT_STEPS)
        if type(steps) not in (int, float) or not 1 <= steps < 1e15 or steps != int(steps):
            raise ValueError(f"n_timesteps must be a whole number >= 1, got {shown(steps)}")
        return int(steps)

    @property
    def agent_line(self) -> str:
        """One line with all hyperparameters of the algorithm and where they come from."""
        found, given = self.all_hyperparams, self.hyperparams.keys() - {"n_timesteps"}
        is_tuned = tuned_hyperparams(id_alone(self.env), self.algo) is not None
        source = f"hyperparameters tuned for {id_alone(self.env)}" if is_tuned else "default hyperparameters"
        if given == found.keys():
            source = "hyperparameters as given"
        elif given:
            source += f", as given {', '.join(name for name in found if name in given)}"
        return f"{self.algo}, {source}: " + ", ".join(f"{name}={value}" for name, value in found.items())

    @property
    def completed(self) -> Self:
        """The same settings with the steps and all hyperparameters given, for settings.json."""
        return replace(self, steps=self.training_steps, hyperparams=self.all_hyperparams)

    def __post_init__(self) -> None:
        BackendSettings.__post_init__(self)
        counts = {"seeds": 1, "steps": 1, "episodes": 1, "seed": 0}
        require_limits(self, **counts, intervention_penalty=0, violation_penalty=0)
        arms = getattr(self, "arm", ""), *getattr(self, "arms", ()), *getattr(self, "baselines", ())
        require_horizon(self, self.mode, *arms)


@dataclass(frozen=True, kw_only=True)
class CompareSettings(LearningSettings):
    """Trains agents with and without the shield and compares violations, return and interventions.

    Synthesizes and exactly verifies a certificate, trains paired runs (equal seeds), evaluates each on the same
    episodes, prints a table and leaves summary.json, settings.json, episodes.parquet, training.parquet, report.html,
    figures, models, TensorBoard events and the certificate. Started again with the same folder, finished runs are kept.

    Attributes:
        out: Output folder.
        seeds: Number of paired training runs per arm.
        arms: unshielded, monitor (unshielded, counts what the shield would do), penalized (a penalty per violation),
            penalized:WEIGHT, lagrangian (adapts it), shielded, shielded:MODE, lookahead, trusting (no error set), psf
            (predictive filter), also with a margin in percent, psf:20, psf:tube; shield-at-test; also with +penalty.
            Untrained: lqr, mpc, mpc:20, random, K-x_hat, zero-input, untrained, pretrained, alone or behind a filter,
            lqr+shielded (docs/experiments.md).
        baselines: Arms that are listed below the others and not drawn.
        scenarios: Other evaluations: worst-case-disturbance, worse-channel, ideal-channel, attacked,
            attacked-on-an-ideal-channel, gaussian (docs/experiments.md).
        tuned_arms: Whether arms are trained with what was tuned for each by itself (`benchmarks.learning`); no option
            of the command line.
        noise: "gaussian" may exceed the certificate's bounds: prints the bound on the probability of an exit.
    """

    out: Path = Path("runs/compare")
    seeds: int = 3
    arms: tuple[str, ...] = ("unshielded", "penalized", "trusting", "shielded")
    baselines: tuple[str, ...] = (
        "zero input",
        "K x_hat",
        "untrained",
        "lqr",
        "lqr+trusting",
        "lqr+shielded",
    )
    scenarios: tuple[str, ...] = ("as trained",)
    tuned_arms: tyro.conf.Suppress[bool] = False
    noise: Literal["truncated", "gaussian"] = "truncated"


@dataclass(frozen=True, kw_only=True)
class TrainSettings(LearningSettings):
    """Trains one agent, evaluates it, and saves it with everything needed to use it.

    Started again with the same folder, an interrupted training goes on from its last checkpoint; --force begins anew.

    Attributes:
        out: Output folder.
        arm: Arm that the agent is trained in; see the arms of `ncs compare`.
    """

    out: Path = Path("runs/train")
    arm: str = "shielded"


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings:
    """Evaluates a trained agent, behind a shield or not, on any channel.

    Attributes:
        model: Folder of a trained agent, such as models/shielded-0 in the output of `ncs compare`, or the output of
            `ncs train`; or "pretrained", for the agent of --env that comes with the package.
        env: Id of the environment the agent was trained in; module:id, to import the module that registers it.
        shield: Mode of the shield, by default that of the agent's training; "none" for no shield; "monitor" changes
            nothing and counts what it would have done.
        horizon: Longest plan of mode "lookahead" [steps]; by default that of the agent's training, otherwise 6.
        episodes: Number of evaluation episodes.
        seed: Seed of the episodes.
        certificate: Certificate file to use instead of that of the training, or of synthesizing one.
        between_samples: Times per step at which the safe box counts, 1 for the sampling instants; by default the
            plant's own.
        channel: Changes of the channel that the agent was trained with, by the names that `ncs compare` lists.
        smoke: Evaluate a few episodes only, to see that everything works.
        out: File for the summary (JSON).
    """

    model: tyro.conf.Positional[Path]
    env: str | None = None
    shield: Literal["as-trained", "none", "monitor", "project", "lookahead", "switch", "boundary"] = "as-trained"
    horizon: int | None = None
    episodes: int = 200
    seed: int = 0
    certificate: Path | None = None
    between_samples: int | None = None
    channel: Assignments = field(default_factory=dict)
    smoke: bool = False
    out: Path | None = None

    def __post_init__(self) -> None:
        require_limits(self, episodes=1, seed=0)
        if self.shield != "as-trained":  # otherwise the agent knows
            require_horizon(self, self.shield)


@dataclass(frozen=True, kw_only=True)
class SweepSettings(LearningSettings):
    """Compares arms over a grid of channels: how safety, return and interventions depend on the channel.

    Every point of the grid is a comparison of its own with the same seeds. Leaves episodes.parquet, summary.json,
    settings.json, a heatmap of the violating episodes, and the models. Started again with the same folder, finished
    runs are kept.

    Attributes:
        out: Output folder; created if it does not exist.
        seeds: Number of paired training runs per arm and channel.
        steps: Training steps per run, rounded up to whole rollouts.
        episodes: Evaluation episodes per run.
        arms: Arms of the comparison; see `ncs compare`.
        losses: Loss probabilities of the grid.
        delays: Delays of the grid [steps].
        quantization_steps: Quantization steps of the grid; the environment's own if none is given.
        burst_lengths: Mean numbers of packets lost in a row; 0 stands for independent losses.
        mass_factors: Factors of the mass in the environment's process, the certificate being that of the model (factor
            1); for environments whose process has a mass.
        downlink_losses: Loss probabilities of commands, for environments with a downlink; the environment's own if none
            is given. The heatmap then shows losses of samples against losses of commands. Where none are lost, inputs
            are committed for the delay only.
    """

    out: Path = Path("runs/sweep")
    seeds: int = 1
    steps: StepCount = 50_000
    episodes: int = 100
    arms: tuple[str, ...] = ("unshielded", "shielded")
    losses: tuple[float, ...] = (0.0, 0.3, 0.6)
    delays: tuple[int, ...] = (0, 2, 4)
    quantization_steps: tuple[float, ...] = ()
    burst_lengths: tuple[float, ...] = (0.0,)
    mass_factors: tuple[float, ...] = ()
    downlink_losses: tuple[float, ...] = ()
