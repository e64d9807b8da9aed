"""Settings of the commands that train nothing: about certificates, networks, the paper, and drawing."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from experiments.settings.arguments import Assignments, StepCount, require_horizon, require_limits
from experiments.settings.learning import BackendSettings
from ncs_gym import ChannelContract
from ncs_gym.uncertainty.truncated_gaussian import SMALLEST_DELTA


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


# Episodes of a batch, at least.
FEWEST_ENVS = 4


@dataclass(frozen=True, kw_only=True)
class AttackSettings(BackendSettings):
    """Attacks shielded control loops within the assumptions, and counts the states that leave the safe set or box.

    The plants are those of the registered environments (--env attacks those with other environments inside) and random
    ones, behind every kind of channel. Disturbances push
    the next state farthest out, initial states and first estimation errors lie on the boundaries of their sets, sensor
    noise has full size in random directions, and agents are random or hostile.

    Attributes:
        steps: Budget, by default one of about two minutes; the campaign whose results the documentation reports has
            1e9, of which 1e8 take twenty minutes. Whole batches of `envs` episodes are run as long as they fit. Where
            it does not allow one per attack case and mode of the shield, batches are smaller, and cases are left out if
            they get too small. Batches of a folder keep their size when steps are added.
        out: Output folder; an interrupted campaign continues where it stopped, and one with more steps adds to it.
        random_plants: Number of random plants, each behind four kinds of channels.
        envs: Number of episodes in a batch, simulated side by side.
        mode: Mode of the shield; by default project, switch and boundary in turn. The claim of lookahead is the box:
            states may leave S, and half of the episodes are drawn from all of the box.
        safe_set: What the shields keep; see `ncs synthesize`. By default the polytope, where there is one.
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        unshielded: Let the shield only watch, to see what happens without it.
        noise: "truncated" is the worst noise within the bounds; "gaussian" noise has none: it is drawn, next to
            the worst of the other disturbances, and the bound on the probability of an exit is printed.
        delta: Level at which the certificates' ellipsoids hold for a draw of Gaussian noise, in place of the plants'.
        env: Id of the only environment to attack, behind its own channel and those that use its contract up, or every
            kind of channel without one; module:id first imports the module, which registers one of your own. By default
            all of the above.
        plant: File of the only plant to attack, which `LinearPlant.save` wrote: behind channels that use its contract
            up, or every kind of channel without one.
        max_age: Largest measurement age of the contract of --plant [steps]; no contract by default.
        quantization_step: Coarsest quantization that the contract of --plant allows.
        channel: Only kind of channel to attack, by its name in the table: "on request", say; all by default.
        force: Replace the finished results of another campaign in the output folder, which otherwise is refused.
        seed: Seed of the campaign, >= 0.
        smoke: Run a short version, to see that everything works: the registered environments behind their own channels,
            unless others are asked for, and no random plants; in runs/attack-smoke unless `--out` differs.
    """

    steps: float = 5e6
    out: Path = Path("runs/attack")
    random_plants: int = 4
    envs: int = 4096
    mode: Literal["project", "lookahead", "switch", "boundary"] | None = None
    safe_set: Literal["polytope", "ellipsoid"] | None = None
    horizon: int | None = None
    unshielded: bool = False
    noise: Literal["truncated", "gaussian"] = "truncated"
    delta: float | None = None
    env: str | None = None
    plant: Path | None = None
    max_age: int | None = None
    quantization_step: float | None = None
    channel: str | None = None
    force: bool = False
    seed: int = 0
    smoke: bool = False

    def __post_init__(self) -> None:
        BackendSettings.__post_init__(self)
        _refuse_both(self.env, self.plant)
        if self.plant is None and (self.max_age is not None or self.quantization_step is not None):
            raise ValueError("--max-age and --quantization-step belong to --plant: environments have contracts already")
        if not 1.0 <= self.steps < 1e15:
            raise ValueError(f"--steps must be at least 1 and below 1e15, got {self.steps:g}")
        require_limits(self, random_plants=0, envs=FEWEST_ENVS, seed=0, delta=(SMALLEST_DELTA, 0.5))
        if self.unshielded and self.mode is not None:
            raise ValueError(f"give either --mode {self.mode} or --unshielded, not both")
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
        file: A table with the named columns sent and received (sent_ms, ...), the output of ping or fping, a list of
            round trips, a log of `ncs loop`, or the JSON of irtt (docs/requirements.md).
        sampling_period: Duration of a control step [s]; by default that of --env or --plant, or the time between
            packets.
        ping_period: Time between packets whose file does not say when they were sent, as of ping without -D [s]; by
            default that of ping's summary, or 1.
        ignore: Names of columns of the table that are not looked at.
        env: Id of an environment whose contract is compared with the record.
        certificate: File of a certificate whose contract is compared with the record, in place of an environment's.
        plant: File of the plant that it is for (`LinearPlant.save`); alone it gives the sampling period.
        committed_ahead: Steps by which inputs are committed ahead behind a downlink, of --certificate, whose contract
            counts them, too: samples may be so many steps less old (docs/contracts.md).
        out: File for the numbers (JSON).
    """

    file: tyro.conf.Positional[Path]
    sampling_period: float | None = None
    ping_period: float | None = None
    ignore: tuple[str, ...] = ()
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
class RenderSettings:
    """Draws an episode of a policy, as an animation or its last frame (docs/rendering.md).

    Attributes:
        env: Id of an environment with a plant of its own; module:id first imports the module, which registers one of
            your own (`ncs_gym.register_plant`).
        out: File to write: .gif, .mp4, or .png for the last frame alone.
        log: Folder of the logs of `ncs loop`: draws the last steps of its newest episode, of the plant that `--env`
            names, into a .png.
        policy: "greedy" (toward the task's target as hard as it can, gently to rest where it has none), "zero",
            "random", a regulator ("lqr", "governor", "mpc"), "pretrained" (the small agent that comes with the
            package), the folder of a trained agent, or a zip that `model.save` of stable-baselines3 wrote.
        vec_normalize: For such a zip: its statistics, as `ncs evaluate` takes them.
        shield: Mode of the shield; "none" for no shield.
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        side_by_side: Draw the same episode without a shield at the left, with it at the right.
        certificate: Certificate file to use instead of synthesizing one.
        seed: Seed of the episode (of both, side by side) and of the random policy.
        steps: Largest number of steps.
        fps: Frames per second; one frame per step.
        scale: Pixels of a frame per unit of its layout of 640 by 480; by default 2, sharp on dense screens, and
            1 for a .gif, whose file would be several times as large.
        width: Width of the animation [pixels]; by default as drawn.
        smoke: Draw a few steps only, to see that everything works; into episode-smoke.gif unless `--out` differs.
    """

    env: str = "ncs_gym/TruckTrailerCruise-v0"
    out: Path = Path("episode.gif")
    log: Path | None = None
    policy: str = "greedy"
    vec_normalize: Path | None = None
    shield: Literal["project", "lookahead", "switch", "boundary", "monitor", "none"] = "project"
    horizon: int | None = None
    side_by_side: bool = False
    certificate: Path | None = None
    seed: int = 0
    steps: StepCount = 200
    fps: int = 10
    scale: int | None = None
    width: int | None = None
    smoke: bool = False

    def __post_init__(self) -> None:
        require_horizon(self, self.shield)
        require_limits(self, seed=0, steps=1, fps=(1, 50), scale=(1, 4), width=160)
        if self.side_by_side and self.shield == "none":
            raise ValueError('--side-by-side compares with a shield: choose a --shield other than "none"')


@dataclass(frozen=True, kw_only=True)
class LoopSettings:
    """Runs a control loop over UDP: plant, network and controller as processes, in real time (docs/network_loop.md).

    Attributes:
        env: Id of an environment with a plant of its own; module:id first imports the module.
        channel: Changes of what the network does to samples and echoes, by the names that `ncs compare` lists, such as
            loss=0.3 burst_length=2 max_consecutive_losses=3; by default the environment's channel.
        downlink: Changes of what it does to commands; by default the environment's downlink, or else like its channel.
        policy: "push" (the largest input one way, then the other), "greedy", "zero", "random", a regulator ("lqr",
            "governor", "mpc"), the folder of a trained agent, or a zip that `model.save` of stable-baselines3 wrote.
        vec_normalize: For such a zip: its statistics, as `ncs evaluate` takes them.
        shield: Mode of the shield.
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        certificate: Certificate file to use instead of synthesizing one; both machines need the same.
        steps: Steps of the controller.
        speed: How much faster than the plant's own time the loop runs; below 1 for slow machines.
        room: Steps by which samples and commands may be later than the network makes them, because the processes that
            send and receive them are: the certificate counts them on both ways.
        ask_age: Age from which the controller asks for a sample, where samples are on request; by default it never
            does, and those are sent that the contract needs.
        mischief: Share of lost datagrams that arrive corrupted, and probability that a datagram is duplicated,
            replayed or forged.
        worst: Lose all the datagrams in a row that the channel's promise allows, whenever one is lost.
        seed: Of network, disturbance and controller.
        role: What runs here: "all", or "plant" (with the network) and "controller" on two machines.
        restarted: The plant has moved already: the controller claims nothing until samples tell where it is.
        host: Name or address of the controller's machine.
        port: Its UDP port; the two after it are used by the network.
        key_file: File with the shared key, at least 16 bytes, needed on two machines; drawn anew otherwise.
        out: Folder of the logs.
        live: Show the loop in the terminal while it runs: "auto" where there is one.
        smoke: A few steps only, to see that everything works.
    """

    env: str = "ncs_gym/CartPole-v0"
    channel: Assignments = field(default_factory=dict)
    downlink: Assignments = field(default_factory=dict)
    policy: str = "push"
    vec_normalize: Path | None = None
    shield: Literal["project", "lookahead", "switch", "boundary", "monitor"] = "project"
    horizon: int | None = None
    certificate: Path | None = None
    steps: StepCount = 3000
    speed: float = 1.0
    room: int = 1
    ask_age: int | None = None
    mischief: float = 0.05
    worst: bool = False
    seed: int = 0
    role: Literal["all", "plant", "controller"] = "all"
    restarted: bool = False
    host: str = "127.0.0.1"
    port: int = 47600
    key_file: Path | None = None
    out: Path = Path("runs/loop")
    live: Literal["auto", "yes", "no"] = "auto"
    smoke: bool = False

    def __post_init__(self) -> None:
        require_horizon(self, self.shield)
        require_limits(self, steps=1, room=(0, 100), ask_age=0, mischief=(0, 1), port=(1, 65533))
        if not 0.0 < self.speed < math.inf:
            raise ValueError(f"--speed must be positive, got {self.speed}")
        if self.role != "all" and self.key_file is None:
            raise ValueError("on two machines give both the same --key-file, as `head -c 32 /dev/urandom > FILE` makes")
