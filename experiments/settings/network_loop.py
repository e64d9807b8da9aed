"""Settings of the command that runs a control loop over a network."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from experiments.settings.arguments import Assignments, StepCount, require_horizon


@dataclass(frozen=True, kw_only=True)
class LoopSettings:
    """Runs a control loop over UDP: plant, network and controller as processes, in real time (docs/network_loop.md).

    Attributes:
        env: Id of an environment with a plant of its own; module:id first imports the module.
        channel: Changes of what the network does to samples and echoes, by the names that `ncs compare` lists, such as
            loss=0.3 burst_length=2 max_consecutive_losses=3; by default the environment's channel.
        downlink: Changes of what it does to commands; by default the environment's downlink, or else like its channel.
        policy: "push" (the largest input one way, then the other), "greedy", "zero", "random", a regulator ("lqr",
            "governor", "mpc"), or the folder of a trained agent.
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
        """Raises ValueError if a setting is out of range."""
        require_horizon(self.horizon, self.shield)
        if self.steps < 1:
            raise ValueError(f"--steps must be at least 1, got {self.steps}")
        if not 0.0 < self.speed < float("inf"):
            raise ValueError(f"--speed must be positive, got {self.speed}")
        if not 0 <= self.room <= 100:
            raise ValueError(f"--room must be between 0 and 100 steps, got {self.room}")
        if self.ask_age is not None and self.ask_age < 0:
            raise ValueError(f"--ask-age must be at least 0 steps, got {self.ask_age}")
        if not 0.0 <= self.mischief <= 1.0:
            raise ValueError(f"--mischief must be a probability, got {self.mischief}")
        if not 1 <= self.port <= 65533:
            raise ValueError(f"--port must be between 1 and 65533, got {self.port}")
        if self.role != "all" and self.key_file is None:
            raise ValueError("on two machines give both the same --key-file, as `head -c 32 /dev/urandom > FILE` makes")
