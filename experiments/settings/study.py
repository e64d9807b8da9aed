"""Settings of `ncs sweep` and `ncs study`, which repeat the comparison on other channels and in other environments."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.baselines.margins import MARGINS
from experiments.settings.backend import BackendSettings
from experiments.settings.learning import Algorithm, Baselines, LearningSettings, Scenarios
from experiments.settings.steps import StepCount, require_least

# Environments in which the network decides.
NETWORK_ENVS = ("ncs_gym/CSTR-v0", "ncs_gym/Convoy-v0", "ncs_gym/LaneKeeping-v0")
# What the shield is compared with and needs no training, margins in percent: a regulator alone, with a governor of its
# references, and behind every filter. The weights of each are tuned by themselves (benchmarks/tune_baselines.py).
_MARGINS = ("", *(f":{margin}" for margin in MARGINS))
REGULATED_ARMS = (
    "lqr",
    *(f"governor{margin}" for margin in _MARGINS),
    *(f"lqr+{name}{margin}" for name in ("psf", "trusting", "trusting:lookahead") for margin in _MARGINS),
    "lqr+psf:tube",
    "lqr+shielded",
    "lqr+lookahead",
)


@dataclass(frozen=True, kw_only=True)
class SweepSettings(BackendSettings, LearningSettings):
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

    def __post_init__(self) -> None:
        """Raises ValueError if a value is out of range."""
        LearningSettings.__post_init__(self)
        BackendSettings.__post_init__(self)


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
        safe_set: What shields keep: the ellipsoid, which the filters beside them have too, or the polytope that other
            commands take.
        channel_episodes: Episodes per arm and combination of impairments; 0 leaves them out.
        page: Also write the page of Markdown to this file, its figures into the folder images beside it, all tables
            and their numbers into the files with the endings .txt and .json.
        quote: Pages in which the marked tables are replaced by those of this study.
        smoke: Run a short version, whatever else is asked for, to see that everything works; if `--out` is not given,
            in a folder of its own, with -smoke at the end of its name.
        force: Replace finished results of other settings in the output folder, which otherwise is refused.
    """

    config: Path | None = None
    out: Path = Path("runs/study")
    envs: tuple[str, ...] = NETWORK_ENVS
    seed: int = 0
    seeds: int = 5
    budget: float = 1.0
    episodes: int = 100
    algo: Algorithm = "PPO"
    arms: tuple[str, ...] = ("unshielded", "penalized:10", "lagrangian", "trusting:20", "shielded", "lookahead")
    baselines: Baselines = REGULATED_ARMS
    scenarios: Scenarios = ("ideal-channel", "worse-channel", "attacked", "attacked-on-an-ideal-channel")
    safe_set: Literal["polytope", "ellipsoid"] = "ellipsoid"
    channel_episodes: int = 100
    page: Path | None = None
    quote: tuple[Path, ...] = ()
    smoke: bool = False
    force: bool = False

    def __post_init__(self) -> None:
        """Raises ValueError if a value is out of range."""
        BackendSettings.__post_init__(self)
        require_least(self, seeds=1, episodes=1, seed=0, channel_episodes=0)
        if not 0.0 < self.budget <= 1.0:
            raise ValueError(f"--budget must be in (0, 1], got {self.budget}")
        if not self.envs or len(set(map(short_name, self.envs))) != len(self.envs):
            raise ValueError(f"--envs must be different ones, at least one, got {' '.join(self.envs) or 'none'}")


def short_name(env_id: str) -> str:
    """Returns an environment's id without its namespace and module, as in names of folders."""
    return env_id.rpartition(":")[2].rpartition("/")[2]
