"""What the pictures of an episode show, as data: the present step, the recent path and the recent packets."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from ncs_gym.network.channel import Packet
from ncs_gym.network.packet_loss_and_delay import ChannelState
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.tasks import SetpointTracking, SpeedTracking, Task

# Number of steps of the path and of the packets that a frame shows.
RECENT_STEPS = 40


class ConvexSet(Protocol):
    """What is drawn of a safe set."""

    def support(self, direction: Any, /) -> Any:
        """Returns max of a'x over the set for directions a, shape (count, n)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Annotation:
    """What a shield knows about the step that was taken, to be shown in its picture.

    Attributes:
        safe_set: The set that the shield keeps the state in.
        label: The shield's mode, written in the header.
        proposed: The input the agent proposed, shape (m,) [physical units]; None at reset.
        intervened: Whether the shield replaces the proposed input.
        interventions: Number of interventions in this episode, this step included.
        protects: Whether the shield's input is applied; False for a shield that only monitors.
        plan: Inputs that the shield has in store for the steps after this one, shape (k, m) [physical units]; None for
            a shield that stores none.
    """

    safe_set: ConvexSet
    label: str
    proposed: np.ndarray | None = None
    intervened: bool = False
    interventions: int = 0
    protects: bool = True
    plan: np.ndarray | None = None


class PacketRecord(NamedTuple):
    """The step at which a packet was sent, and that at which it arrives; None if it is lost."""

    stamp: int
    arrival: int | None


class TrackedOutput(NamedTuple):
    """The quantity that a tracking task is about, now, and the range of its reference; all in one unit."""

    name: str
    unit: str
    value: float
    target: float
    low: float
    high: float


class EpisodeRecord:
    """The recent past of one episode; what draws a frame reads nothing else.

    Attributes:
        step: Steps taken in this episode.
        info: The info of the newest step.
        state, estimate: The true state and the estimate, shape (n,).
        violated: Whether a limit was broken in the step that led here.
        intervened: Whether a shield that protects replaced the input that led here.
        path: The recent states, oldest first, each of shape (n,).
        interventions: Whether the shield replaced the input that led to each of these states.
        packets: The recent packets, oldest first.
        annotation: What the shield knows about the step that led here; None without a shield.
    """

    def __init__(self, plant: LinearPlant, task: Task) -> None:
        self.plant, self._task = plant, task

    def begin(self, info: Mapping[str, Any], task_state: Any, note: Annotation | None = None) -> None:
        """Starts an episode, with the info of its reset."""
        self.step = 0
        self.path: deque[np.ndarray] = deque(maxlen=RECENT_STEPS)
        self.interventions: deque[bool] = deque(maxlen=RECENT_STEPS)
        self.packets: deque[PacketRecord] = deque(maxlen=RECENT_STEPS)
        self._store(info, task_state, note)

    def add(
        self, info: Mapping[str, Any], task_state: Any, sent: tuple[int, Any] | None, note: Annotation | None = None
    ) -> None:
        """Adds a step, with its info and what became of its sample; None where none is sent."""
        self.step += 1
        self._store(info, task_state, note)
        if sent is not None:
            self.packets.append(PacketRecord(*sent))

    def _store(self, info: Mapping[str, Any], task_state: Any, note: Annotation | None) -> None:
        self.info, self._task_state = deepcopy(dict(info)), task_state
        self.state, self.estimate, self.violated = self.info["state"], self.info["estimate"], bool(info["cost"] > 0.0)
        self.annotation = note
        self.intervened = note is not None and note.intervened and note.protects
        self.path.append(self.state)
        self.interventions.append(note is not None and note.intervened)

    @property
    def planned_states(self) -> np.ndarray:
        """Where the inputs in the shield's store lead from the estimate, undisturbed, shape (k + 1, n)."""
        plan, states = self.annotation and self.annotation.plan, [self.estimate]
        for u in () if plan is None else plan:
            states.append(self.plant.A @ states[-1] + self.plant.B @ u)
        return np.array(states)

    @property
    def tracked(self) -> TrackedOutput | None:
        """The quantity that the task tracks; None if it does not track a single quantity."""
        task, plant = self._task, self.plant
        if isinstance(task, SpeedTracking):
            value, target = self._task_state.tolist()
            return TrackedOutput("speed", "m/s", value, target, 0.0, task.fastest)
        if not isinstance(task, SetpointTracking):
            return None
        first = int(np.argmax(task.output))
        is_state = np.array_equal(task.output, np.eye(plant.n)[first])
        name, unit = (plant.state_names[first], plant.state_units[first]) if is_state else ("output", "")
        numbers = [task.output @ self.state, float(task.target(self._task_state)), -task.reach, task.reach]
        return TrackedOutput(name, unit, *(task.output @ plant.operating_state + np.array(numbers)).tolist())


def sent_at(step: int, network: ChannelState, arrived: list[Packet]) -> tuple[int, Any] | None:
    """Returns what became of the sample of a step, after the exchange of that step; None if none was sent."""
    if not network.sends_at(step):
        return None
    arrivals = {step: arrived} | network.in_flight
    return step, next((k for k, packets in arrivals.items() if step in {p.stamp for p in packets}), None)


def note_of(guard: Any, info: Mapping[str, Any]) -> Annotation | None:
    """Returns what the picture of the last step shows of a guard, given its info; None without a guard."""
    if guard is None:
        return None
    judge = guard.filter
    return Annotation(
        safe_set=judge.certificate.safe_set,
        label=judge.mode,
        proposed=info["input_proposed"] if info["episode_steps"] > 0 else None,
        intervened=bool(info["shield_intervened"]),
        interventions=int(info["episode_interventions"]),
        protects=judge.mode != "monitor",
        plan=guard.stored.copy() if judge.mode == "lookahead" else None,
    )
