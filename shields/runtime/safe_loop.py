"""Estimator, safety filter and guarantee in one object, for a control loop without Gymnasium."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from enum import Enum, auto
from typing import Any

import numpy as np

from ncs_gym import Channel, ChannelContract, Ellipsoid, LinearPlant, Packet
from ncs_gym.estimation.arrival_histories import arrival_histories
from ncs_gym.estimation.estimator import Belief, Estimator
from ncs_gym.network.channel import (
    MAX_AGE,
    DiscardedPackets,
    UnusedPacketsWarning,
    as_packet,
    require_on_request,
    warn_of_broken_contract,
)
from ncs_gym.network.downlink import AppliedInputs, Command, CommittedInputs, Echo, as_echo, downlink_protocol
from ncs_gym.network.requests import Requests
from ncs_gym.validation import (
    CopiedWhole,
    as_count,
    as_flag,
    as_numbers,
    as_vector,
    counted,
    setting,
    shown,
    warn_caller,
)
from shields.certificate import Certificate
from shields.runtime.guard import EXPLANATIONS, LATE_INPUT, NOT_CONFIRMED, OTHER_EPISODE, OTHER_INPUT, Guard
from shields.runtime.safety_filter import Decision, SafetyFilter

NOT_STARTED = "no episode is under way: call start"


class _Phase(Enum):
    STOPPED = auto()
    STARTED = auto()
    RECEIVED = auto()
    DECIDED = auto()


class SafeLoop(CopiedWhole):
    """Keeps a real plant in its safe set, whatever its controller proposes (docs/deployment.md).

    One control step is `receive`, which moves the estimate to now, your controller, and `decide`, whose input is
    applied until the next step:

        loop = SafeLoop(certificate, plant, channel)
        loop.start(x_hat0)
        while running:
            x_hat = loop.receive(packets_that_arrived())
            apply(loop.decide(controller(x_hat)).input)
            wait_for_the_next_step()

    Steps are counted from 0 at `start`; a packet carries the number of the step at which its sample was taken, and that
    of the episode.

    The guarantee is that of `SafetyShield`, under the same assumptions (docs/shield.md): `guaranteed` says whether the
    state is proved to be in the certificate's safe set S at this step, `reason` why not. The loop cannot see that the
    clock misses a step, that packets carry wrong stamps, or, unless it is told or hears `echoes`, that the actuator
    applies something else. Where `start`, `receive` or `decide` is interrupted, the loop is stopped and nothing is
    proved until the next `start`. It can be pickled between two calls; several threads may not use one loop at once.

    Behind a downlink that is late or loses commands, send `command` after each `decide`, and let an `ncs_gym.Actuator`
    apply what it holds (docs/contracts.md, "Both directions"). What is decided takes effect `input_delay` steps later;
    estimate and error shape belong to that time. Where the channel takes samples on request (docs/requests.md),
    `request` says after each `decide` whether the sample of the next step is to be taken; behind a downlink commands
    say it.

    Args:
        certificate: Verified exactly here; gives the contract and the error sets.
        plant: The plant it was made for.
        channel: Its longest delay and quantization step count, its losses do not. Older packets are discarded and
            counted; what is sent after `decide` and received at the next step is one step late.
        mode: "project", "lookahead", "switch", "boundary" or "monitor"; see `SafetyFilter`.
        horizon: Longest plan of mode "lookahead", in steps; see `SafetyFilter`.
        downlink: The channel from here to the actuator; None if what is decided is applied at once.
        downlink_contract: What is assumed of it; by default what its settings guarantee.
        on_unproved: What `start` and `receive` do, once per episode and reason, where the state is not proved safe:
            "warn" with a `GuaranteeLostWarning`, "raise" a `GuaranteeLostError`, "ignore" if you read `guaranteed`.
            When one is raised, the call has come to its end: go on with `decide`.
        echo_age: How many steps the newest echo of the actuator may be old: beyond it, and for the rest of the episode
            once an echo contradicts what was decided, nothing is proved. None if there are no echoes.

    Attributes:
        filter: Makes the decisions.
        contract: Channel contract of the certificate; None without one. Behind a downlink it counts c steps more than
            that of the channel.
        input_delay: c, the number of steps from a decision to its effect; 0 without a downlink.
        channel: The channel of the samples.

    Raises:
        CertificateError: If the certificate does not verify for the plant.
        UnstablePlantError: If the plant is not Schur stable and the certificate has no contract.
        ValueError: If a setting is of the wrong kind, or the channel rounds more coarsely than the contract allows.
    """

    filter: SafetyFilter = setting("filter")
    contract: ChannelContract | None = setting("contract")
    input_delay: int = setting("input_delay")
    channel: Channel = setting("channel", "_estimator.channel")

    def __init__(
        self,
        certificate: Certificate,
        plant: LinearPlant,
        channel: Channel,
        mode: str = "project",
        horizon: int | None = None,
        downlink: Channel | None = None,
        downlink_contract: ChannelContract | None = None,
        on_unproved: str = "warn",
        echo_age: int | None = None,
    ) -> None:
        self._filter = SafetyFilter(certificate, plant, mode, horizon)
        if not isinstance(channel, Channel):
            raise ValueError(f"channel must be a Channel (its contract is the certificate's), got {shown(channel)}")
        self._contract = certificate.contract
        histories = arrival_histories(plant, channel, self._contract)
        self._estimator = Estimator(plant, channel, histories=histories)
        protocol = downlink_protocol(downlink, downlink_contract)
        self._guard, self._decided = Guard(self._filter, protocol, on_unproved), np.zeros(plant.m)
        self._input_delay = protocol.input_delay
        warn_of_broken_contract(self._contract, channel, self._input_delay, counts_losses=True)
        self._inputs = CommittedInputs(self._input_delay, plant.m)
        self._requests = None
        if channel.on_request:
            assumed = self._contract and replace(
                self._contract, max_age=max(self._contract.max_age - self._input_delay, 0)
            )
            self._requests = Requests(channel, assumed, self._input_delay)
        self._echo_age = None if echo_age is None else as_count(echo_age, "echo_age", low=0, high=MAX_AGE)
        self._applied = AppliedInputs(self._echo_age)
        self._discarded, self._told_of = DiscardedPackets(), frozenset[str]()
        self._phase = _Phase.STOPPED

    @np.errstate(all="ignore")
    def start(self, x_hat0: Any, initial_set: Ellipsoid | np.ndarray | None = None) -> None:
        """Starts an episode at step 0; also how one is begun anew after the guarantee was lost.

        Packets of earlier episodes are discarded from now on: `episode` is the number of the new one.

        Args:
            x_hat0: First estimate, shape (n,). You claim that its error lies in `plant.initial_error`.
            initial_set: What the state is known to lie in besides, an ellipsoid or the state itself, shape (n,). It
                counts where x_hat0 alone does not prove that the state is in S (in mode "lookahead": in the box).

        Raises:
            ValueError: If an argument is not finite or does not fit the plant; nothing has changed then.
            GuaranteeLostError: If the state is not proved safe and that is to be raised; the episode has begun then.
        """
        n = self._filter.plant.n
        mean = as_vector(x_hat0, n, f"x_hat0 = ({', '.join(self._filter.plant.state_names)})")
        if initial_set is not None and not isinstance(initial_set, Ellipsoid):
            initial_set = as_vector(initial_set, n, "initial_set")
        if isinstance(initial_set, Ellipsoid) and initial_set.dim != n:
            raise ValueError(f"initial_set must have dimension {n}, got {initial_set.dim}")
        self._phase = _Phase.STOPPED
        self._estimator.reset(mean)
        self._discarded = DiscardedPackets()
        self._inputs.start()
        self._applied.start()
        if self._requests is not None:
            self._requests.begin()
        pending = self._inputs.pending
        earlier = [self._estimator.numbered(pending[:steps]) for steps in range(self._input_delay)]
        self._guard.begin(self._belief(None), initial_set, earlier)
        self._phase = _Phase.STARTED
        self._guard.lost.tell_of(self.reason)

    @np.errstate(all="ignore")
    def receive(self, packets: Iterable[Packet] = (), applied: Any = None, echoes: Iterable[Echo] = ()) -> np.ndarray:
        """Returns the estimate at this control step, shape (n,): predicted from the last one, then corrected.

        Behind a downlink it is that of the step at which the input decided next takes effect. At step 0 it is the first
        estimate, which stands for a sample of that step. Two values of a sample that was used end the guarantee of the
        episode.

        Args:
            packets: What arrived since the last call, in any order; duplicates, late ones and those of another episode
                are sorted out.
            applied: What the actuator applied since the last decision, shape (m,), if that may be something else than
                was decided for this time. If it is, the estimate follows it and the guarantee ends; if it is no finite
                input, the estimate follows the decision.
            echoes: What the actuator says that it has applied (`Actuator.echo`), where `echo_age` is given, in any
                order.

        Raises:
            RuntimeError: If `start` was not called, or nothing was decided since the last call.
            ValueError: If what is given is no packet for this plant, or there are echoes and no `echo_age`; nothing has
                changed then.
            GuaranteeLostError: If the state is not proved safe and that is to be raised; all has been received then.
        """
        try:
            given = None if isinstance(packets, Packet) else iter(packets)
        except TypeError:  # also of an array that has no dimension
            given = None
        if given is None:
            raise ValueError(
                f"packets must be a list of Packet(stamp, measurement), empty if nothing arrived, got {shown(packets)}"
            )
        arrived = [as_packet(each, self._filter.plant.p) for each in given]
        heard = [as_echo(each) for each in echoes]
        if heard and self._echo_age is None:
            raise ValueError("echoes are compared with what was decided by SafeLoop(..., echo_age=...) alone")
        phase = self._require_started()
        if phase is _Phase.RECEIVED:
            raise RuntimeError("receive was called twice in a step: hand over all packets of a step in one call")
        self._phase = _Phase.STOPPED
        if phase is _Phase.DECIDED:
            due = self._inputs.pop()
            told = due if applied is None else _as_input(applied, due.shape)
            self._applied.add(due)
            self._estimator.advance(due if told is None else told, arrived)
            self._guard.observe(self._belief(told))
        self._applied.compare(heard, self.steps, self.episode)
        before, oldest = self._discarded, self._estimator.channel.longest_delay
        self._discarded = before.with_those_of(arrived, self.steps, self.episode, oldest)
        self._phase = _Phase.RECEIVED
        if self._discarded != before:
            self._tell_of_discarded(before)
        self._guard.lost.tell_of(self.reason)
        return self.estimate

    @np.errstate(all="ignore")
    def decide(self, proposed: Any, *, ask: bool = False) -> Decision:
        """Returns what to apply from now until the next step, and why.

        Args:
            proposed: Your controller's input, shape (m,) or a number if m = 1 [physical units]; it is clipped to the
                limits, and that is what counts as proposed.
                What is no finite input is replaced by u = K x_hat, with a warning unless it is None.
            ask: Whether your controller asks for the sample of the next step, behind a downlink of c steps later, where
                samples are on request.

        Raises:
            RuntimeError: If `start` was not called, or this step was decided already.
            ValueError: If a sample is asked for of a channel that does not take samples on request.
        """
        if self._require_started() is _Phase.DECIDED:
            raise RuntimeError("decide was called twice in a step: call receive in between, with the packets that came")
        (low, high), requests = self._filter.plant.input_ends, self._requests
        if as_flag(ask, "ask"):
            requests = require_on_request(requests)
        u = _as_input(proposed, low.shape)  # what is none is decided as such
        if u is None and proposed is not None and "proposal" not in self._told_of:
            self._told_of = self._told_of | {"proposal"}
            wanted = f"decide takes one input, finite numbers of shape {low.shape}, got {shown(proposed)}"
            warn_caller(f"{wanted}; u = K x_hat is applied instead", UserWarning)
        self._phase = _Phase.STOPPED
        u = np.full_like(low, np.nan) if u is None else np.minimum(np.maximum(u, low), high)
        decision = self._guard.decide(u)
        self._decided = decision.input
        decision = decision._replace(input=decision.input.copy())  # the caller may write into it
        self._inputs.commit(decision.input)
        if requests is not None:
            requests.ask(ask)
            requests.decide(self._estimator.age)
        self._phase = _Phase.DECIDED
        return decision

    def command(self) -> Command:
        """Returns what to send to the actuator after a decision: the committed inputs of this step and the next c.

        Raises:
            RuntimeError: If nothing was decided at this step.
        """
        if self._phase is not _Phase.DECIDED:
            raise RuntimeError("call decide before command: it sends what was decided at this step")
        requests = () if self._requests is None else tuple(self._requests.decided.tolist())
        return self._inputs.command(self.steps, self.episode, requests)

    @property
    def request(self) -> bool:
        """Whether the sample of the next step is to be taken, after a decision: asked for, or needed by the contract.

        Raises:
            RuntimeError: If nothing was decided at this step.
            ValueError: If the channel does not take samples on request.
        """
        requests = require_on_request(self._requests)
        if self._phase is not _Phase.DECIDED:
            raise RuntimeError("call decide before request: it says what was decided at this step")
        return bool(requests.decided[0])

    @property
    def guaranteed(self) -> bool:
        """Whether the state is proved to be in S at this control step; in mode "lookahead": to stay in the box."""
        return not self.reason

    @property
    def reason(self) -> str:
        """Why it is not; empty while it is."""
        if self._phase is _Phase.STOPPED:
            return NOT_STARTED
        if self._applied.is_other:
            return LATE_INPUT if self._input_delay else OTHER_INPUT
        if (code := self._guard.code) or self._applied.is_confirmed(self.steps):
            return EXPLANATIONS[code]
        return OTHER_EPISODE if self._applied.hears_of_others(self.steps) else NOT_CONFIRMED

    @property
    def plan_length(self) -> int:
        """Number of inputs stored for the steps after this decision; 0 in other modes than "lookahead"."""
        return 0 if self._phase is _Phase.STOPPED else len(self._guard.stored)

    @property
    def estimate(self) -> np.ndarray:
        """x_hat at this control step, shape (n,); behind a downlink when the next decision takes effect.

        Raises:
            RuntimeError: If no episode is under way.
        """
        self._require_started()
        return self._guard.belief.estimate.copy()

    @property
    def error_shape(self) -> np.ndarray:
        """Sigma_k, shape (n, n): x_hat - x lies in E(Sigma_k), at the step of the estimate."""
        self._require_started()
        return self._guard.belief.error_shape.copy()

    @property
    def steps(self) -> int:
        """Number of this control step, which a sample taken now is stamped with."""
        return self._estimator.step

    @property
    def episode(self) -> int:
        """Number of this episode, which its packets carry; 0 after the first `start`, one more after each other one."""
        return self._estimator.episode

    @property
    def measurement_age(self) -> int:
        """Steps since the newest sample used was taken; the first estimate counts as one of step 0."""
        return self._estimator.age

    @property
    def discarded(self) -> DiscardedPackets:
        """How many packets were discarded in this episode: too late, stamped ahead, or of another episode."""
        return self._discarded

    def _tell_of_discarded(self, before: DiscardedPackets) -> None:
        oldest = self._estimator.channel.longest_delay
        texts = {
            "too_late": f"it is older than {counted(oldest, 'step')}, the longest delay of the channel of this loop",
            "ahead": f"its stamp is ahead of the loop, which is at step {self.steps}",
            "other_episode": f"its episode is not that of the loop, {self.episode}",
        }
        is_new = {name for name in texts if getattr(self._discarded, name) > getattr(before, name)}
        if self.steps <= oldest:  # they may be stragglers
            is_new.discard("other_episode")
        is_new, self._told_of = is_new - self._told_of, self._told_of | is_new
        for name in sorted(is_new):
            warn_caller(
                f"a packet was discarded: {texts[name]} (`discarded` counts such packets)", UnusedPacketsWarning
            )

    def _require_started(self) -> _Phase:
        if self._phase is _Phase.STOPPED:
            raise RuntimeError(NOT_STARTED)
        return self._phase

    def _belief(self, applied: np.ndarray | None) -> Belief:
        """Returns what is known now; `applied` is the input of the last step, None if it is not known."""
        estimator = self._estimator
        estimate, number = estimator.numbered(self._inputs.pending[: self._input_delay])
        applied = np.full(self._filter.plant.m, np.nan) if applied is None else applied
        seen = estimate, number, estimator.table, estimator.age, estimator.alarm, estimator.damaged, False
        return Belief(*seen, applied, self._decided, self.steps)


def _as_input(given: Any, shape: tuple[int, ...]) -> np.ndarray | None:
    """Returns a copy of an input, shape (m,); None if it is no finite one."""
    numbers = as_numbers(given)
    if numbers is None:
        return None
    numbers = numbers.reshape(1).copy() if numbers.ndim == 0 else numbers.copy()  # read once: others may write into it
    return numbers if numbers.shape == shape and np.isfinite(numbers).all() else None
