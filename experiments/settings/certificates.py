"""Settings of the commands that train nothing: about certificates, networks, the paper, and drawing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from experiments.settings.arguments import StepCount, require_horizon, require_limits
from ncs_gym import ChannelContract


@dataclass(frozen=True, kw_only=True)
class SynthesizeSettings:
    """Synthesizes a certificate for an environment's plant, verifies it exactly and saves it.

    Attributes:
        env: Id of an environment with a plant of its own; module:id first imports the module, which registers one of
            your own (`ncs_gym.register_plant`). By default ncs_gym/TruckTrailerCruise-v0.
        plant: File of a plant that `LinearPlant.save` wrote, in place of an environment's.
        safe_set: What a shield with this certificate keeps: the ellipsoid, or the largest polytope that the same gain
            keeps in the safe box, which leaves the policy more room. By default the polytope.
        between_samples: Times per step at which the safe box counts, for a claim at all times; by default the plant's
            own; 1 for the sampling instants alone (docs/shield.md).
        time_limit: Seconds of the processor's time after which the best certificate so far is verified and saved, and
            says so; None for no limit: then the search ends by counted work, on every machine alike.
        out: File for the certificate (JSON).
        max_age: Largest measurement age of the channel contract [steps]; by default the environment's contract, none
            for the plant of a file.
        quantization_step: Coarsest quantization that the channel contract allows; by default the environment's, none
            for the plant of a file.
        seed: Not used, since the synthesis is deterministic; every command takes it.
    """

    env: str | None = None
    plant: Path | None = None
    safe_set: Literal["polytope", "ellipsoid"] | None = None
    between_samples: int | None = None
    time_limit: float | None = 60.0
    out: Path = Path("certificate.json")
    max_age: int | None = None
    quantization_step: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        _refuse_both(self.env, self.plant)


@dataclass(frozen=True, kw_only=True)
class VerifySettings:
    """Verifies a certificate in exact rational arithmetic against the plant it was made for.

    Attributes:
        file: File of the certificate (JSON).
        env: Id of an environment with a plant of its own, or module:id; without it, the one whose plant has the
            certificate's fingerprint.
        plant: File of a plant that `LinearPlant.save` wrote, in place of an environment's.
        out: File for the verdicts (JSON).
        seed: Not used, since the verification is deterministic; every command takes it.
    """

    file: tyro.conf.Positional[Path]
    env: str | None = None
    plant: Path | None = None
    out: Path | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        _refuse_both(self.env, self.plant)


@dataclass(frozen=True, kw_only=True)
class ExportCSettings:
    """Writes a safety filter in C99 for a board, with test vectors that check it (docs/deployment.md).

    Attributes:
        file: File of the certificate (JSON): with a polytope, under a channel contract.
        plant: File of the plant that `LinearPlant.save` wrote, or id of an environment with a plant of its own.
        out: Output folder.
        single: Write the rows of the safe set as float, which needs less memory and is faster on a board that computes
            in single precision; the estimate stays double.
        seed: Not used, since what is written is always the same; every command takes it.
    """

    file: tyro.conf.Positional[Path]
    plant: str
    out: Path = Path("filter")
    single: Annotated[bool, tyro.conf.arg(name="float")] = False
    seed: int = 0


def changed_contract(
    contract: ChannelContract | None, max_age: int | None, quantization_step: float | None
) -> ChannelContract | None:
    """Returns a channel contract with what is given, None for what stays.

    Raises:
        ValueError: If a value is out of range, or there is a quantization step and no age.
    """
    if max_age is None and quantization_step is None:
        return contract
    if max_age is None:
        if contract is None:
            raise ValueError("--quantization-step belongs to a contract of the channel: give --max-age, too")
        max_age = contract.max_age
    if quantization_step is None:
        quantization_step = 0.0 if contract is None else contract.quantization_step
    return ChannelContract(max_age, quantization_step)


def _refuse_both(env: str | None, plant: Path | None) -> None:
    if env is not None and plant is not None:
        raise ValueError("give either --env or --plant, not both")


@dataclass(frozen=True, kw_only=True)
class AttackSettings:
    """Attacks shielded loops with worst-case disturbances and agents, and counts states outside the safe set or box.

    Every environment is attacked on its own channel and on those that use its contract up. Disturbances push the next
    state farthest out, first errors and sensor noise have full size, and agents are random or hostile. Ends with exit
    code 1 if a guaranteed state is outside.

    Attributes:
        env: Id of the only environment to attack; module:id first imports the module, which registers one of your own.
            By default all registered ones.
        steps: Simulated steps in all, at least 8 episodes of each environment and channel.
        mode: Mode of the shield; "monitor" only watches. In mode lookahead states may leave the safe set.
        safe_set: What the shields keep; by default the polytope, where there is one.
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        out: File for the counts (JSON).
        seed: Seed of the attack, >= 0.
        smoke: Attack one environment a little, to see that everything works.
    """

    env: str | None = None
    steps: StepCount = 1_000_000
    mode: Literal["project", "lookahead", "switch", "boundary", "monitor"] = "project"
    safe_set: Literal["polytope", "ellipsoid"] | None = None
    horizon: int | None = None
    out: Path | None = None
    seed: int = 0
    smoke: bool = False

    def __post_init__(self) -> None:
        require_limits(self, steps=1, seed=0)
        require_horizon(self, self.mode)


@dataclass(frozen=True, kw_only=True)
class AuditSettings:
    """Checks the claims of the paper (Liu et al.) one by one, from its own printed numbers.

    Attributes:
        json: Print JSON instead of the table.
        out: File for the rows (JSON).
        seed: Not used, since the audit is deterministic; every command takes it.
    """

    json: bool = False
    out: Path | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class ReproduceSettings:
    """Simulates Section 5 of Liu et al.: printed (K, M), certified (K, M), and OP's at the nearest feasible bounds.

    Simulates random initial states in each safe set with all four network impairments; prints a table and leaves
    figures and summary.json.

    Attributes:
        out: Output folder.
        starts: Number of random initial states per design.
        steps: Steps of each simulation.
        force: Replace finished results of other settings in the output folder, which otherwise is refused.
        seed: Seed of initial states, disturbances and channel, the same for all designs.
    """

    out: Path = Path("runs/reproduce")
    starts: int = 100
    steps: StepCount = 200
    force: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        require_limits(self, starts=1, steps=1, seed=0)


@dataclass(frozen=True, kw_only=True)
class RequirementsSettings:
    """Finds under which contracts of the network a plant is certifiable: how old and how coarse its samples may be.

    Prints what share of the safe box a certificate keeps, - where none was found (which does not prove that there is
    none).

    Attributes:
        env: Id of an environment with a plant of its own, or module:id, which first imports the module. By default
            ncs_gym/CartPole-v0.
        plant: File of a plant that `LinearPlant.save` wrote, in place of an environment's.
        ages: Largest ages of the newest sample when an input takes effect [steps]; by default up to 32, and the
            environment's.
        resolutions: Quantization steps, in the units of the measurements, 0 for none; by default the environment's.
        out: File for the table with its certificates (JSON).
        seed: Not used, since the search is deterministic; every command takes it.
    """

    env: str | None = None
    plant: Path | None = None
    ages: tuple[int, ...] = ()
    resolutions: tuple[float, ...] = ()
    out: Path | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        _refuse_both(self.env, self.plant)


@dataclass(frozen=True, kw_only=True)
class ChannelSettings:
    """Reads recorded packets, and says how often each channel contract would have been broken.

    Attributes:
        file: A table with the columns sent and received in seconds, received empty where a packet was lost, or the
            output of Linux `ping -D` (docs/requirements.md has recipes for others).
        sampling_period: Duration of a control step [s]; by default that of --env or --plant, or the time between
            packets.
        env: Id of an environment whose contract is compared with the record.
        certificate: File of a certificate whose contract is compared with the record, in place of an environment's.
        plant: File of the plant that it is for (`LinearPlant.save`); alone it gives the sampling period.
        committed_ahead: Steps by which inputs are committed ahead behind a downlink, of --certificate, whose contract
            counts them, too: samples may be so many steps less old (docs/contracts.md).
        out: File for the numbers (JSON).
    """

    file: tyro.conf.Positional[Path]
    sampling_period: float | None = None
    env: str | None = None
    certificate: Path | None = None
    plant: Path | None = None
    committed_ahead: int = 0
    out: Path | None = None

    def __post_init__(self) -> None:
        require_limits(self, committed_ahead=0)
        if self.committed_ahead and self.certificate is None:
            raise ValueError("--committed-ahead is of --certificate: an environment knows its own")
        if (self.certificate and not self.plant) or (self.env and self.plant):
            raise ValueError("give --certificate and --plant, or --env, whose contract and certificate are known")
        period = self.sampling_period
        if not (period is None or 0.0 < period < math.inf):
            raise ValueError(f"--sampling-period must be a number > 0, got {period}")


@dataclass(frozen=True, kw_only=True)
class BoundsSettings:
    """Reads a record of a plant, and says what bounds of its disturbances the record proves, and what it does not.

    Attributes:
        file: A table (CSV, or Parquet where pyarrow is installed) with the plant's inputs and outputs by name as
            columns and a row per step: outputs as sampled, then the input that acted, which may be empty in the last
            row. An output that is not a state is y1, y2, ... by its number. Further columns are not read.
        env: Id of an environment with the plant, or module:id, which first imports the module.
        plant: File of the plant (`LinearPlant.save`), in place of an environment's. Its disturbance says along which
            directions to seek: E of Through(E, ...), else every state.
        sensor: Half-widths of the noise of each output, as of a data sheet; by default the plant's own.
        out: File for the numbers (JSON).
        seed: Not used, since nothing is drawn; every command takes it.
    """

    file: tyro.conf.Positional[Path]
    env: str | None = None
    plant: Path | None = None
    sensor: tuple[float, ...] = ()
    out: Path | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        _refuse_both(self.env, self.plant)
        if self.env is None and self.plant is None:
            raise ValueError("give the plant of the record: --plant FILE or --env ID")


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """Draws an episode of a policy, as an animation or its last frame (docs/rendering.md).

    Attributes:
        env: Id of an environment with a plant of its own; module:id first imports the module, which registers one of
            your own (`ncs_gym.register_plant`).
        out: File to write: .gif, or .png for the last frame alone.
        policy: "lqr", "mpc", "zero", "random", "pretrained" (the small agent of the package), or the folder of a
            trained agent.
        shield: Mode of the shield; "none" for no shield.
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        side_by_side: Draw the same episode without a shield at the left, with it at the right.
        certificate: Certificate file to use instead of synthesizing one.
        seed: Seed of the episode (of both, side by side) and of the random policy.
        steps: Largest number of steps.
        fps: Frames per second; one frame per step.
        scale: Pixels of a frame per unit of its layout of 640 by 480; by default 2, sharp on dense screens, and
            1 for a .gif, whose file would be several times as large.
        smoke: Draw a few steps only, to see that everything works; into episode-smoke.gif unless `--out` differs.
    """

    env: str = "ncs_gym/TruckTrailerCruise-v0"
    out: Path = Path("episode.gif")
    policy: str = "lqr"
    shield: Literal["project", "lookahead", "switch", "boundary", "monitor", "none"] = "project"
    horizon: int | None = None
    side_by_side: bool = False
    certificate: Path | None = None
    seed: int = 0
    steps: StepCount = 200
    fps: int = 10
    scale: int | None = None
    smoke: bool = False

    def __post_init__(self) -> None:
        require_horizon(self, self.shield)
        require_limits(self, seed=0, steps=1, fps=(1, 50), scale=(1, 4))
        if self.side_by_side and self.shield == "none":
            raise ValueError('--side-by-side compares with a shield: choose a --shield other than "none"')
