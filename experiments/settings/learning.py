"""Settings of the commands that train agents or evaluate them, and of what executes their runs."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, Self

import tyro

from agents.hyperparams import DEFAULTS, read_hyperparams, tuned_hyperparams, tuned_steps, with_changes
from agents.loop import LagrangianSettings
from experiments.baselines import MARGINS
from experiments.settings.arguments import (
    Assignments,
    OptionalStepCount,
    StepCount,
    id_alone,
    require_horizon,
    require_limits,
)
from ncs_gym.validation import shown

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
        require_limits(self, jobs=(1, MOST_JOBS), ray_wait=0, cpus_per_run=0.0001)
        if not _ADDRESS.fullmatch(self.ray_address):
            raise ValueError(f"--ray-address must be local, auto or HOST:PORT, got {self.ray_address!r}")
        whole = self.gpus_per_run <= 1.0 or self.gpus_per_run.is_integer()
        if not 0.0 <= self.gpus_per_run < float("inf") or not whole:
            raise ValueError(f"--gpus-per-run must be in [0, 1] or a whole number, got {self.gpus_per_run}")
        if self.engine == "local":
            for field in fields(BackendSettings)[2:]:
                if getattr(self, field.name) != field.default:
                    raise ValueError(f"--{field.name.replace('_', '-')} is a setting of --engine ray")


# Whatever a file of settings says, there are no more worker processes, runs per arm and episodes per run.
MOST_JOBS, MOST_SEEDS, MOST_EPISODES = 1024, 10_000, 1_000_000
# Training steps where none belong to tuned hyperparameters.
_DEFAULT_STEPS = 150_000
Algorithm = Literal["PPO", "A2C", "SAC", "TD3", "TRPO", "TQC", "CrossQ"]
Mode = Literal["project", "lookahead", "switch", "boundary"]


@dataclass(frozen=True, kw_only=True)
class LearningSettings(BackendSettings):
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
        between_samples: Times per step at which the safe box counts, for a claim at all times; by default the plant's
            own; 1 for the sampling instants alone (docs/shield.md).
        channel: Changes of the environment's channel: loss, burst_length (mean number of packets lost in a row), delay,
            jitter and send_period [steps], quantization_step, max_consecutive_losses.
        hyperparams: Hyperparameters of the learning algorithm, by their names in stable-baselines3: gamma=0.99
            n_steps=64 "policy_kwargs=dict(net_arch=[64, 64])". What is not given is tuned for the environment
            (agents/tuned), or the default.
        conf_file: File of hyperparameters by environment, YAML or JSON, like those of rl-zoo3.
        lagrangian: How the arm "lagrangian" adapts its penalty per violating step.
        smoke: Run a short version, whatever else is asked for, to see that everything works; unless `--out`
            names another folder than the usual one, in that with -smoke at the end of its name.
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
    between_samples: int | None = None
    channel: Assignments = field(default_factory=dict)
    hyperparams: Assignments = field(default_factory=dict)
    conf_file: Path | None = None
    lagrangian: LagrangianSettings = field(default_factory=LagrangianSettings)
    smoke: bool = False
    force: bool = False

    @property
    def all_hyperparams(self) -> dict[str, Any]:
        """All hyperparameters of the algorithm: those given, those of the file, those tuned, the defaults.

        Raises:
            ValueError: If the file is damaged, or has none for the environment.
            OSError: If the file cannot be read.
        """
        given, env_id = self._given_hyperparams, id_alone(self.env)
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
        steps = self._given_hyperparams.get("n_timesteps", tuned_steps(id_alone(self.env), self.algo) or _DEFAULT_STEPS)
        if type(steps) not in (int, float) or not 1 <= steps < 1e15 or steps != int(steps):
            raise ValueError(f"n_timesteps must be a whole number >= 1, got {shown(steps)}")
        return int(steps)

    @property
    def agent_line(self) -> str:
        """One line with all hyperparameters of the algorithm and where they come from."""
        found, given = self.all_hyperparams, self._given_hyperparams.keys() - {"n_timesteps"}
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
        return replace(self, steps=self.training_steps, hyperparams=self.all_hyperparams, conf_file=None)

    @property
    def _given_hyperparams(self) -> dict[str, Any]:
        """Hyperparameters of the command line, and those of the file."""
        of_file = {} if self.conf_file is None else read_hyperparams(self.conf_file, id_alone(self.env))
        return with_changes(of_file, self.hyperparams)

    def __post_init__(self) -> None:
        BackendSettings.__post_init__(self)
        counts = {"seeds": (1, MOST_SEEDS), "steps": 1, "episodes": (1, MOST_EPISODES), "seed": 0}
        require_limits(self, **counts, intervention_penalty=0, violation_penalty=0)
        arms = getattr(self, "arm", ""), *getattr(self, "arms", ()), *getattr(self, "baselines", ())
        require_horizon(self, self.mode, *arms)


@dataclass(frozen=True, kw_only=True)
class CompareSettings(LearningSettings):
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
            intervention, +residual adds the agent's action to that of K. Controllers that are not trained:
            proportional, lqr, governor (lqr with a reference governor, governor:20 with a margin), random, K-x_hat,
            zero-input, untrained and pretrained (the agent that comes with the package), alone or behind a filter as
            in proportional+shielded.
        baselines: Arms that are listed below the others and not drawn.
        scenarios: What policies are evaluated under besides "as trained": worst-case-disturbance, worse-channel (more
            loss, later packets, within the contract), ideal-channel, attacked (the worst disturbance, noise of full
            size, bursts of losses as long as the contract allows), attacked-on-an-ideal-channel, gaussian (noise
            without a bound).
        tuned_arms: Whether arms that were tuned by themselves (`benchmarks.learning`) are trained with what was
            found: hyperparameters of PPO, the price of a violation, settings of PPO-Lagrangian.
        noise: "gaussian" draws noise that may exceed the certificate's bounds, and prints the bound on the probability
            of leaving the safe set beside the episodes that left it.
    """

    out: Path = Path("runs/compare")
    seeds: int = 3
    arms: tuple[str, ...] = ("unshielded", "penalized", "trusting", "shielded")
    baselines: tuple[str, ...] = (
        "zero input",
        "K x_hat",
        "untrained",
        "proportional",
        "proportional+trusting",
        "proportional+shielded",
    )
    scenarios: tuple[str, ...] = ("as trained",)
    tuned_arms: bool = False
    noise: Literal["truncated", "gaussian"] = "truncated"


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
        vec_normalize: For a zip: the file that `VecNormalize.save` of stable-baselines3 wrote, of which numbers alone
            are read; "none" if the agent saw observations as they are and a file of that kind lies beside it.
        shield: Mode of the shield, by default that of the agent's training, which a zip does not tell: none then;
            "none" for no shield; "monitor" changes nothing and counts what it would have done.
        horizon: Longest plan of mode "lookahead" [steps]; by default that of the agent's training, otherwise 6.
        episodes: Number of evaluation episodes.
        seed: Seed of the episodes.
        certificate: Certificate file to use instead of that of the training, or of synthesizing one.
        between_samples: Times per step at which the safe box counts, 1 for the sampling instants; by default the
            plant's own.
        channel: Changes of the channel that the agent was trained with (of an agent in a ZIP file, of that of the id),
            by the names that `ncs compare` lists.
        smoke: Evaluate a few episodes only, to see that everything works.
        out: File for the summary (JSON).
    """

    model: tyro.conf.Positional[Path]
    env: str | None = None
    vec_normalize: Path | None = None
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
        require_limits(self, episodes=(1, MOST_EPISODES), seed=0)
        if self.shield != "as-trained":  # otherwise the agent knows
            require_horizon(self, self.shield)


# Environments in which the network decides.
NETWORK_ENVS = ("ncs_gym/CSTR-v0", "ncs_gym/Convoy-v0", "ncs_gym/LaneKeeping-v0")
# What the shield is compared with and needs no training, margins in percent: a regulator alone, with a governor of its
# references, or behind a filter, and model predictive control. The weights of each are tuned by themselves
# (`benchmarks.learning`).
_MARGINS = ("", *(f":{margin}" for margin in MARGINS))
REGULATED_ARMS = (
    "lqr",
    *(f"governor{margin}" for margin in _MARGINS),
    *(f"mpc{margin}" for margin in ("", ":20", ":40", ":50")),
    *(f"lqr+{name}{margin}" for name in ("psf", "trusting", "trusting:lookahead") for margin in _MARGINS),
    "lqr+psf:tube",
    "lqr+shielded",
    "lqr+lookahead",
)


# Agents, each trained with what was tuned for it by itself.
TRAINED_ARMS = ("unshielded", "penalized", "lagrangian", "trusting:20", "shielded", "lookahead")


@dataclass(frozen=True, kw_only=True)
class SweepSettings(LearningSettings):
    """Compares arms over a grid of channels: how safety, return and interventions depend on the channel.

    Every point of the grid is a comparison of its own with the same seeds. Leaves episodes.parquet, summary.json,
    settings.json, report.html with heatmaps, and the models. Started again with the same folder, finished runs are
    kept.

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
            is given. The heatmaps then show losses of samples against losses of commands. Where none are lost, inputs
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


@dataclass(frozen=True, kw_only=True)
class StudySettings(BackendSettings):
    """Compares arms in several environments and under several scenarios, with the statistics to judge them by.

    Every environment is a comparison of its own (`ncs compare`) in a folder below the output folder, with the settings
    of that command; then linear controllers and trained agents are attacked with every impairment of the channel on and
    off. Leaves report.html, a page of Markdown (docs/results.md is one) beside all tables (results.txt), figures,
    summary.json and episodes.parquet. Started again with the same folder, finished runs are kept: a long study can be
    run in parts.

    Attributes:
        config: Settings file (settings.json) of an earlier study; its settings hold where none are given here.
        out: Output folder; created if it does not exist.
        envs: Ids of the environments; the first one comes first in the report.
        seed: Seed of the study, >= 0.
        seeds: Number of paired training runs per arm and environment.
        budget: Fraction of the training steps of each environment, in (0, 1].
        episodes: Evaluation episodes per run and scenario.
        algo: Learning algorithm.
        arms: Trained arms; see `ncs compare`.
        baselines: Arms in which nothing is trained.
        scenarios: What policies are evaluated under besides "as trained".
        safe_set: What shields keep, and the filters beside them end in: the polytope, or the ellipsoid inside it.
        channel_episodes: Episodes per arm and combination of impairments; 0 leaves them out.
        page: Also write the page of Markdown to this file, its figures into the folder images beside it, all tables
            and their numbers into the files with the endings .txt and .json.
        quote: Pages in which the marked tables are replaced by those of this study.
        smoke: Run a short version, whatever else is asked for, to see that everything works; unless `--out`
            names another folder than the usual one, in that with -smoke at the end of its name.
        force: Replace finished results of other settings in the output folder, which otherwise is refused.
    """

    config: Path | None = None
    out: Path = Path("runs/study")
    envs: tuple[str, ...] = NETWORK_ENVS
    seed: int = 0
    seeds: int = 5
    budget: float = 1.0
    episodes: int = 50
    algo: Algorithm = "PPO"
    arms: tuple[str, ...] = TRAINED_ARMS
    baselines: tuple[str, ...] = REGULATED_ARMS
    scenarios: tuple[str, ...] = ("ideal-channel", "worse-channel", "attacked", "attacked-on-an-ideal-channel")
    safe_set: Literal["polytope", "ellipsoid"] = "polytope"
    channel_episodes: int = 25
    page: Path | None = None
    quote: tuple[Path, ...] = ()
    smoke: bool = False
    force: bool = False

    def __post_init__(self) -> None:
        BackendSettings.__post_init__(self)
        counts = {"seeds": (1, MOST_SEEDS), "episodes": (1, MOST_EPISODES), "channel_episodes": (0, MOST_EPISODES)}
        require_limits(self, **counts, seed=0)
        if not 0.0 < self.budget <= 1.0:
            raise ValueError(f"--budget must be in (0, 1], got {self.budget}")
        if not self.envs or len(set(map(short_name, self.envs))) != len(self.envs):
            raise ValueError(f"--envs must be ids that differ, at least one, got {' '.join(self.envs) or 'none'}")


def short_name(env_id: str) -> str:
    """Returns an environment's id without its namespace and module, as in names of folders."""
    return id_alone(env_id).rpartition("/")[2]
