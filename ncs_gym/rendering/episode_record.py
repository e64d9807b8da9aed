"""What the pictures of an episode show, as data: the present step, the recent path and the recent packets."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from ncs_gym.network.channel import Packet
from ncs_gym.network.packet_loss_and_delay import ChannelState
from ncs_gym.plants.description import mixed_limit
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.tasks.base_task import Task
from ncs_gym.tasks.setpoint_tracking import SetpointTracking
from ncs_gym.tasks.speed_tracking import SpeedTracking
from ncs_gym.uncertainty.ellipsoid import Ellipsoid

# Number of steps of the path and of the packets that a frame shows.
RECENT_STEPS = 40


class OutlinedSet(Protocol):
    """What is drawn of a convex set that is no ellipsoid."""

    def support(self, directions: Any, /) -> Any:
        """Returns max of a'x over the set for directions a, shape (count, n)."""

    def outline(self, pair: tuple[int, int], /) -> np.ndarray:
        """Returns corners around its projection onto two coordinates, shape (k, 2)."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Annotation:
    """What a shield knows about the step it is about to take, to be shown in the picture of that step.

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

    safe_set: Ellipsoid | OutlinedSet
    label: str
    proposed: np.ndarray | None = None
    intervened: bool = False
    interventions: int = 0
    protects: bool = True
    plan: np.ndarray | None = None


class PacketRecord(NamedTuple):
    """When a packet was sent and when it arrives.

    Attributes:
        stamp: The step at which it was sent.
        arrival: The step at which it arrives; None if it is lost.
    """

    stamp: int
    arrival: int | None


@dataclass(frozen=True, kw_only=True)
class TrackedOutput:
    """The quantity that a tracking task is about, and its reference.

    Attributes:
        name: Name of the quantity.
        unit: Unit of all four numbers.
        value: The true value now.
        target: The reference value now.
        low, high: Range of the reference values.
    """

    name: str
    unit: str
    value: float
    target: float
    low: float
    high: float


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameRecord:
    """Everything that one frame shows; what draws a frame reads nothing else.

    Attributes:
        plant: The plant that is drawn.
        step: Steps taken in this episode.
        state: The true state x, shape (n,).
        estimate: The estimate x_hat, shape (n,).
        error_shape: Shape Sigma_k of the set that holds the estimation error, shape (n, n).
        input: The input applied in the step that led here, shape (m,); None at reset.
        committed: The input decided in that step, shape (m,); behind a downlink it is applied later. None at reset.
        violations: Number of steps of this episode with a violation.
        violated: Whether the true state violated the safe box in the step that led here.
        worst: `worst_constraint_values` of that step, shape (k + q,).
        measurement_age: Steps since the newest measurement used was taken.
        missing_inputs: Number of steps of this episode in which the downlink broke and zero was applied.
        input_missing: Whether that was so in the step that led here.
        path: The recent states, oldest first, shape (T, n).
        interventions: Whether the shield replaced the input that led to each of these states, shape (T,).
        packets: The recent packets, oldest first.
        forced: Whether the contract forced a request in the step that led to each of these states, shape (T,).
        annotation: What the shield knows about the step that led here; None without a shield.
        tracked: What the task tracks; None if it does not track a single quantity.
        distance: Distance driven in this episode, if the task knows a speed [m].
    """

    plant: LinearPlant
    step: int
    state: np.ndarray
    estimate: np.ndarray
    error_shape: np.ndarray
    input: np.ndarray | None
    committed: np.ndarray | None
    violations: int
    violated: bool
    worst: np.ndarray
    measurement_age: int
    missing_inputs: int
    input_missing: bool
    path: np.ndarray
    interventions: np.ndarray
    packets: tuple[PacketRecord, ...]
    forced: np.ndarray
    annotation: Annotation | None
    tracked: TrackedOutput | None
    distance: float

    @property
    def intervened(self) -> bool:
        """Whether a shield that protects replaced the input that led here."""
        annotation = self.annotation
        return annotation is not None and annotation.intervened and annotation.protects

    @property
    def broken_elsewhere(self) -> str:
        """What the step that led here broke that its state does not show: a limit of inputs, or one between samples."""
        of_states, mixed = np.split(self.worst, [len(self.plant.box)])
        if (mixed > 0.0).any():
            return f"broken: {mixed_limit(self.plant, int(mixed.argmax()))}"
        if self.violated and (self.plant.constraint_values(self.state) <= 0.0).all():
            return f"{1.0 + of_states.max():.3f} of a limit between two samples"
        return ""

    @property
    def planned_states(self) -> np.ndarray:
        """Where the inputs in the shield's store lead from the estimate, undisturbed, shape (k + 1, n), or (0, n)."""
        plan = None if self.annotation is None else self.annotation.plan
        if plan is None or len(plan) == 0:
            return np.empty((0, self.plant.n))
        states = [self.estimate]
        for u in plan:
            states.append(self.plant.A @ states[-1] + self.plant.B @ u)
        return np.array(states)


class EpisodeRecord:
    """The recent past of one episode: extended at every step, turned into a `FrameRecord` only when a frame is drawn.

    Args:
        plant: The plant that is drawn.
        task: The task, which may track a quantity.
    """

    def __init__(self, plant: LinearPlant, task: Task) -> None:
        self._plant, self._task = plant, task
        self._next_annotation: Annotation | None = None

    def annotate(self, annotation: Annotation) -> None:
        """Stores what is to be shown with the next step or reset."""
        self._next_annotation = annotation

    def begin(self, info: Mapping[str, Any], task_state: Any) -> None:
        """Starts an episode, with the info of its reset."""
        self._step, self._distance, self._missing_inputs = 0, 0.0, 0
        self._path: deque[np.ndarray] = deque(maxlen=RECENT_STEPS)
        self._interventions = deque([False], maxlen=RECENT_STEPS)
        self._packets: deque[PacketRecord] = deque(maxlen=RECENT_STEPS)
        self._forced: deque[bool] = deque(maxlen=RECENT_STEPS)
        self._input: np.ndarray | None = None
        self._committed: np.ndarray | None = None
        note = self._next_annotation
        if note is not None and note.proposed is not None:  # nothing is at a start, also where a step led to it
            self._next_annotation = replace(note, proposed=None, intervened=False, interventions=0)
        self._store(info, task_state)

    def add(self, info: Mapping[str, Any], task_state: Any, sent: PacketRecord | None) -> None:
        """Adds a step.

        Args:
            info: The info that the environment returns for this step; its arrays are copied.
            task_state: State of the task after this step.
            sent: What became of the sample of this step; None where none is sent.
        """
        self._step += 1
        if isinstance(self._task, SpeedTracking):
            self._distance += self._plant.dt * float(task_state[0])
        self._input, self._committed = info["input"].copy(), info["input_committed"].copy()
        self._store(info, task_state)
        self._interventions.append(self._annotation is not None and self._annotation.intervened)
        if sent is not None:
            self._packets.append(sent)

    def frame(self) -> FrameRecord:
        """Returns what a frame of the present step shows."""
        state = self._path[-1]
        return FrameRecord(
            plant=self._plant,
            step=self._step,
            state=state,
            estimate=self._estimate,
            error_shape=self._error_shape,
            input=self._input,
            committed=self._committed,
            violations=self._violations,
            violated=self._violated,
            worst=self._worst,
            measurement_age=self._measurement_age,
            missing_inputs=self._missing_inputs,
            input_missing=self._input_missing,
            path=np.array(self._path),
            interventions=np.array(self._interventions),
            packets=tuple(self._packets),
            forced=np.array(self._forced),
            annotation=self._annotation,
            tracked=_tracked_output(self._task, self._plant, self._task_state, state),
            distance=self._distance,
        )

    def _store(self, info: Mapping[str, Any], task_state: Any) -> None:
        """Stores copies of what a frame shows of an info, and takes the annotation made for this step."""
        self._annotation, self._next_annotation = self._next_annotation, None
        self._path.append(info["state"].copy())
        self._estimate, self._error_shape = info["estimate"].copy(), info["error_shape"].copy()
        self._violations, self._violated = int(info["episode_violations"]), bool(info["cost"] > 0.0)
        self._worst = info["worst_constraint_values"].copy()
        self._measurement_age = int(info["measurement_age"])
        self._input_missing = bool(info["downlink_broken"])
        self._forced.append(bool(info["request_forced"]))
        self._missing_inputs += self._input_missing
        self._task_state = task_state


def sent_at(step: int, network: ChannelState, arrived: list[Packet]) -> PacketRecord | None:
    """Returns what became of the sample of a step, after the exchange of that step; None if none was sent."""
    return PacketRecord(step, _arrival(step, network.in_flight, arrived)) if network.sends_at(step) else None


def _arrival(stamp: int, in_flight: Mapping[int, list[Packet]], arrived: list[Packet]) -> int | None:
    """Returns when the packet sent at this very step arrives; None if it was lost."""
    if any(packet.stamp == stamp for packet in arrived):
        return stamp
    for step, packets in in_flight.items():
        if any(packet.stamp == stamp for packet in packets):
            return step
    return None


def _tracked_output(task: Task, plant: LinearPlant, task_state: Any, state: np.ndarray) -> TrackedOutput | None:
    """Returns the quantity that a task tracks; None for tasks that do not track a single quantity."""
    if isinstance(task, SpeedTracking):
        value, target = task_state.tolist()
        return TrackedOutput(name="speed", unit="m/s", value=value, target=target, low=0.0, high=task.fastest)
    if isinstance(task, SetpointTracking):
        used, name, unit, factor = np.flatnonzero(task.output), "output", "", 1.0
        if len(used) == 1:  # a multiple of a state, which is shown itself
            i = int(used[0])
            name, unit, factor = plant.state_names[i], plant.state_units[i], float(task.output[i])
        center = float(task.output @ plant.operating_state)
        value, target = center + float(task.output @ state), center + float(task.target(task_state))
        low, high = sorted([(center - task.reach) / factor, (center + task.reach) / factor])
        return TrackedOutput(name=name, unit=unit, value=value / factor, target=target / factor, low=low, high=high)
    return None
