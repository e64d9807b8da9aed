"""Settings of the commands that train agents or evaluate them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import tyro

from agents.hyperparams import DEFAULTS, read_hyperparams, tuned_hyperparams, tuned_steps, with_changes
from agents.loop import LagrangianSettings
from experiments.settings.assignments import Assignments
from experiments.settings.backend import BackendSettings
from experiments.settings.steps import OptionalStepCount, require_horizon, require_least
from ncs_gym.validation import shown

# Training steps where none belong to tuned hyperparameters.
_DEFAULT_STEPS = 150_000
Algorithm = Literal["PPO", "A2C", "SAC", "TD3", "TRPO", "TQC", "CrossQ"]
# Settings with the flags that they had before.
Baselines = Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--references"])]
Scenarios = Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--conditions"])]
Mode = Literal["project", "lookahead", "switch", "boundary"]


@dataclass(frozen=True, kw_only=True)
class LearningSettings:
    """Settings that the commands that train share.

    Attributes:
        config: Settings file (settings.json) of an earlier run; its settings hold where none are given here.
        env: Id of an environment with a plant of its own; module:id first imports the module, which registers one of
            your own (`ncs_gym.register_plant`).
        seed: Seed of the experiment, >= 0; all runs derive their seeds from it.
        steps: Training steps per run, rounded up to whole rollouts; if not given, n_timesteps of the hyperparameters,
            or 150,000.
        episodes: Evaluation episodes per run.
        algo: Learning algorithm; TRPO, TQC and CrossQ need sb3-contrib.
        mode: What the shield applies in place of an unsafe action: the closest safe input ("project"), the closest one
            after which a certified plan keeps the state in the box ("lookahead"), or the certified K x_hat ("switch";
            "boundary" applies it unless every action would be safe).
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        intervention_penalty: Subtracted from the training reward per intervention, in arms with "+penalty".
        violation_penalty: Subtracted from the training reward per violating step, in the arm "penalized".
        certificate: Certificate file to use instead of synthesizing one.
        safe_set: What the shield keeps if its certificate is synthesized: the polytope, or the ellipsoid inside it.
        channel: Changes of the environment's channel: loss, burst_length (mean number of packets lost in a row), delay,
            jitter and send_period [steps], quantization_step, max_consecutive_losses.
        hyperparams: Hyperparameters of the learning algorithm, by their names in stable-baselines3: gamma=0.99
            n_steps=64 "policy_kwargs=dict(net_arch=[64, 64])". What is not given is tuned for the environment
            (agents/tuned), or the default.
        conf_file: File of hyperparameters by environment, YAML or JSON, like those of rl-zoo3.
        lagrangian: How the arm "lagrangian" adapts its penalty per violating step.
        smoke: Run a short version, whatever else is asked for, to see that everything works; if `--out` is not given,
            in a folder of its own, with -smoke at the end of its name.
        force: Replace finished results of other settings in the output folder, which otherwise is refused.
    """

    config: Path | None = None
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
    channel: Assignments = field(default_factory=dict)
    hyperparams: Assignments = field(default_factory=dict)
    conf_file: Path | None = None
    lagrangian: LagrangianSettings = field(default_factory=LagrangianSettings)
    smoke: bool = False
    force: bool = False

    @property
    def evaluated_under(self) -> tuple[str, ...]:
        """Scenarios that policies are evaluated in, besides that of the training."""
        return ()

    @property
    def all_hyperparams(self) -> dict[str, Any]:
        """All hyperparameters of the algorithm: those given, those of the file, those tuned, the defaults.

        Raises:
            ValueError: If the file is damaged, or has none for the environment.
            OSError: If the file cannot be read.
        """
        given, env_id = self._given_hyperparams, self._env_id
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
        steps = self._given_hyperparams.get("n_timesteps", tuned_steps(self._env_id, self.algo) or _DEFAULT_STEPS)
        if type(steps) not in (int, float) or not 1 <= steps < 1e15 or steps != int(steps):
            raise ValueError(f"n_timesteps must be a whole number >= 1, got {shown(steps)}")
        return int(steps)

    @property
    def agent_line(self) -> str:
        """One line with all hyperparameters of the algorithm and where they come from."""
        found, given = self.all_hyperparams, self._given_hyperparams.keys() - {"n_timesteps"}
        is_tuned = tuned_hyperparams(self._env_id, self.algo) is not None
        source = f"hyperparameters tuned for {self._env_id}" if is_tuned else "default hyperparameters"
        if given == found.keys():
            source = "hyperparameters as given"
        elif given:
            source += f", as given {', '.join(name for name in found if name in given)}"
        return f"{self.algo}, {source}: " + ", ".join(f"{name}={value}" for name, value in found.items())

    @property
    def completed(self) -> Self:
        """The same settings with the steps and all hyperparameters given, for settings.json."""
        return replace(self, steps=self.training_steps, hyperparams=self.all_hyperparams, conf_file=None)

    @property
    def _env_id(self) -> str:
        """The id of "module:id", by which the environment is registered."""
        return self.env.rpartition(":")[2]

    @property
    def _given_hyperparams(self) -> dict[str, Any]:
        """Hyperparameters of the command line, and those of the file."""
        of_file = {} if self.conf_file is None else read_hyperparams(self.conf_file, self._env_id)
        return with_changes(of_file, self.hyperparams)

    def __post_init__(self) -> None:
        """Raises ValueError if a value is out of range."""
        require_least(self, seeds=1, steps=1, episodes=1, seed=0, intervention_penalty=0, violation_penalty=0)
        arms = getattr(self, "arm", ""), *getattr(self, "arms", ()), *getattr(self, "baselines", ())
        require_horizon(self.horizon, self.mode, *arms)


@dataclass(frozen=True, kw_only=True)
class CompareSettings(BackendSettings, LearningSettings):
    """Trains agents with and without the shield and compares violations, return and interventions.

    Synthesizes and exactly verifies a certificate, trains paired runs (equal seeds), evaluates each on the same
    episodes (common random numbers), prints a table and leaves summary.json, settings.json, episodes.parquet,
    training.parquet, report.html, figures, models, TensorBoard events and the certificate in the output folder. Started
    again with the same folder, finished runs are kept.

    Attributes:
        out: Output folder; created if it does not exist.
        seeds: Number of paired training runs per arm.
        arms: unshielded, monitor (unshielded, counts what the shield would have done), penalized (unshielded, with a
            penalty per violation), penalized:WEIGHT, lagrangian (PPO-Lagrangian adapts that penalty), shielded,
            shielded:MODE, lookahead, trusting and trusting:lookahead (certainty-equivalent: without an error set), psf
            (a nominal predictive safety filter), these also with a margin in percent as in psf:20, psf:tube.
            shield-at-test, trusting-at-test and psf-at-test are trained unshielded; +penalty costs reward per
            intervention, +residual adds the agent's action to K x_hat. Controllers that are not trained: proportional,
            lqr, governor (lqr with a reference governor, governor:20 with a margin), random, K-x_hat, zero-input and
            untrained, alone or behind a filter as in proportional+shielded.
        baselines: Arms that are listed below the others and not drawn.
        scenarios: What policies are evaluated under besides "as trained": worst-case-disturbance, worse-channel (more
            loss, later packets, within the contract), ideal-channel, attacked (the worst disturbance, noise of full
            size, bursts of losses as long as the contract allows), attacked-on-an-ideal-channel, gaussian (noise
            without a bound).
        noise: "gaussian" draws noise that the certificate's bounds do not hold for always, and prints next to the
            episodes that left the safe set the bound on their probability.
    """

    out: Path = Path("runs/compare")
    seeds: int = 3
    arms: tuple[str, ...] = ("unshielded", "penalized", "trusting", "shielded")
    baselines: Baselines = (
        "zero input",
        "K x_hat",
        "untrained",
        "proportional",
        "proportional+trusting",
        "proportional+shielded",
    )
    scenarios: Scenarios = ("as trained",)
    noise: Literal["truncated", "gaussian"] = "truncated"

    @property
    def evaluated_under(self) -> tuple[str, ...]:
        """Scenarios that policies are evaluated in, besides that of the training."""
        return self.scenarios

    def __post_init__(self) -> None:
        """Raises ValueError if a value is out of range."""
        LearningSettings.__post_init__(self)
        BackendSettings.__post_init__(self)


@dataclass(frozen=True, kw_only=True)
class TrainSettings(LearningSettings):
    """Trains one agent, evaluates it, and saves it with everything needed to use it.

    Started again with the same folder, an interrupted training goes on from its last checkpoint, and a finished one
    with more --steps from its agent; --force begins anew.

    Attributes:
        out: Output folder; created if it does not exist.
        arm: Arm that the agent is trained in; see the arms of `ncs compare`.
    """

    out: Path = Path("runs/train")
    arm: str = "shielded"


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings:
    """Evaluates a trained agent, behind a shield or not, on any channel.

    Attributes:
        model: Folder of a trained agent, such as models/shielded-0 in the output of `ncs compare`, or the output of
            `ncs train`; or the zip that `model.save` of stable-baselines3 wrote, with --env; or "pretrained", for the
            agent of --env that comes with the package.
        env: Id of the environment the agent was trained in; module:id, to import the module that registers it.
        shield: Mode of the shield, by default that of the agent's training; "none" for no shield; "monitor" changes
            nothing and counts what it would have done.
        horizon: Longest plan of mode "lookahead" [steps]; by default that of the agent's training, otherwise 6.
        episodes: Number of evaluation episodes.
        seed: Seed of the episodes.
        certificate: Certificate file to use instead of that of the training, or of synthesizing one.
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
    channel: Assignments = field(default_factory=dict)
    smoke: bool = False
    out: Path | None = None

    def __post_init__(self) -> None:
        """Raises ValueError if a value is out of range."""
        require_least(self, episodes=1, seed=0)
        if self.shield != "as-trained":  # otherwise the agent knows
            require_horizon(self.horizon, self.shield)
