"""The shield as a Gymnasium wrapper, and what it has in common with that of vector environments."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot
from typing import Any, Generic, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import Autoreset, MaxAndSkipObservation, RepeatAction, StickyAction

from ncs_gym import Annotation, BrokenContractWarning, Channel, NCSEnv, NCSVectorEnv
from ncs_gym.envs.loop import Belief
from ncs_gym.envs.spaces import nearest_action, read_action
from ncs_gym.network.contract import warn_of_broken_contract
from ncs_gym.validation import as_number, setting, shown, warn_caller
from shields.certificate import Certificate
from shields.packaged_certificates import certificate_for
from shields.runtime.decisions import NO_PLAN
from shields.runtime.guarantee import LoopObservation, LostGuarantee
from shields.runtime.monitored_filter import MonitoredFilter
from shields.runtime.safety_filter import SafetyFilter, plan_horizon
from shields.runtime.starts import StartKnown, starts_known

E = TypeVar("E", NCSEnv, NCSVectorEnv)

# What changes, repeats or swallows actions between the shield and the plant.
REFUSED = (gym.ActionWrapper, RepeatAction, StickyAction, MaxAndSkipObservation, Autoreset)

# What the clock reads while a step is under way: after an exception nothing is proved until the next reset.
INTERRUPTED = (-1, -1)


class BaseShield(RecordConstructorArgs, Generic[E]):
    """What the shields have in common: their settings, and that what they wrap stays what they were made for."""

    certificate: Certificate = setting("certificate")
    filter: SafetyFilter = setting("filter")
    mode: str = setting("mode", "_filter.mode")
    horizon: int | None = setting("horizon", "_filter.horizon")
    on_unproved: str = setting("on_unproved", "_lost.on_unproved")
    channel: Channel = setting("channel", "_inner.channel")

    @property
    def penalty(self) -> float:
        """Subtracted from the reward per intervention; it may be changed while an agent is trained."""
        return self._penalty

    @penalty.setter
    def penalty(self, value: float) -> None:
        self._penalty = as_number(value, "penalty", low=0.0)
        self._saved_kwargs["penalty"] = self._penalty  # for the spec

    # Class of the innermost environment, base class of the wrappers around it, and those that may not be inside.
    _wanted: type[E]
    _wrappers: Any
    _refused: tuple[type, ...]
    env: Any

    def _make(
        self, env: Any, certificate: Any, mode: str, penalty: float, horizon: int | None, on_unproved: str
    ) -> None:
        """Records the settings, and makes the filter for the environment inside."""
        if isinstance(certificate, os.PathLike):
            certificate = os.fspath(certificate)
        if not (certificate is None or isinstance(certificate, Certificate | Mapping | str)):
            wanted = "a Certificate, its document or path, or None"
            raise ValueError(f"certificate must be {wanted}, got {shown(certificate)}")
        recorded = certificate.document if isinstance(certificate, Certificate) else certificate
        plan_horizon(mode, horizon)
        given = {"mode": mode, "penalty": penalty, "on_unproved": on_unproved}
        given["horizon"] = None if horizon is None else int(horizon)  # a spec is JSON
        RecordConstructorArgs.__init__(self, certificate=recorded, **given)
        read = None if certificate is None else Certificate.read(certificate)
        inner = self._inner = self._environment_in(env)
        for space in ("action_space", "single_action_space"):
            if getattr(env, space, None) != getattr(inner, space, None):
                raise ValueError(f"a wrapper inside the shield changes the action space to {getattr(env, space)}")
        self.penalty = penalty
        self._wrappers.__init__(self, env)
        self._lost = LostGuarantee(on_unproved, getattr(inner, "num_envs", 1))
        self._certificate = certificate_for(inner.plant, inner.certificate_contract) if read is None else read
        self._filter = SafetyFilter(self._certificate, inner.plant, mode, horizon)
        self._input_delay = inner.downlink_protocol.input_delay
        self._channels: set[Channel] = set()
        self._made_for = inner.loop
        if (promised := self._certificate.contract) is not None and inner.certificate_contract is None:
            warn_caller(
                "the certificate assumes a contract of the channel, and the environment was made without one, so that "
                f"its estimator keeps other error sets: give it contract={promised}",
                BrokenContractWarning,
            )

    def _environment_in(self, env: Any) -> E:
        """Returns the innermost environment after looking at every wrapper around it.

        Raises:
            ValueError: If a wrapper changes or repeats actions, or the innermost environment is of another class.
        """
        layer = env
        while isinstance(layer, self._wrappers):
            if isinstance(layer, BaseShield):
                raise ValueError(f"the environment has a {type(layer).__name__} already: leave one out")
            if isinstance(layer, self._refused):
                raise ValueError(
                    f"the shield must be inside {type(layer).__name__}, which changes or repeats actions: wrap the "
                    "shield around the environment first"
                )
            layer = layer.env
        if not isinstance(layer, self._wanted):
            wanted = self._wanted.__name__
            raise ValueError(f"the shield needs an {wanted} inside, got {type(layer).__name__}")
        return layer

    def _require_same(self) -> None:
        now = self._environment_in(self.env)
        for name, is_same in (("environment", now is self._inner), ("loop", now.loop is self._made_for)):
            if not is_same:
                why = f"the {name} is not the one that the shield was made for"
                raise ValueError(f"{why}: wrap the environment in a shield of its own")

    def _look_at(self, channels: set[Channel]) -> None:
        """Warns the caller of channels of the present episodes that are new and break the contract."""
        for channel in channels - self._channels:
            warn_of_broken_contract(self._certificate.contract, channel, self._input_delay)
        self._channels = channels

    def _annotate(self, proposed: np.ndarray | None, interventions: int, plan: np.ndarray, *, intervened: bool) -> None:
        """Tells the picture of the step that follows, or of a reset, what the shield does in it."""
        self._inner.annotate(
            Annotation(
                safe_set=self._certificate.safe_set,
                label=self._filter.mode,
                proposed=proposed,
                intervened=intervened,
                interventions=interventions,
                protects=self._filter.mode != "monitor",
                plan=plan.copy() if self._filter.mode == "lookahead" else None,
            )
        )


@dataclass(slots=True)
class _Episode:
    """What changes from step to step.

    Attributes:
        clock: The episodes and steps of the environment so far; None before the first reset.
        interventions: Of this episode.
        proved: Number of states of this episode, the first included, that were proved safe.
    """

    clock: tuple[int, int] | None = None
    interventions: int = 0
    proved: int = 0


class SafetyShield(BaseShield[NCSEnv], gym.Wrapper):
    """Overrides an action whenever the safe set could be left (docs/shield.md).

    The action passes unchanged if every state the estimate allows stays in S; otherwise "project" applies the closest
    input that keeps it there, "switch" (and "project" where there is none) the certified u = K x_hat. S is the
    certificate's safe set: its polytope, or its ellipsoid if it has none. From a start in S the true state then stays
    in S for ever, for any policy, disturbance and channel within the assumptions; `info["shield_guaranteed"]` says
    whether they still hold as far as can be seen. "boundary" trusts the agent only where no input at all could leave S.
    "monitor" never changes the action and counts what "switch" would have done.

    Wrap it directly around what `gym.make` returns; wrappers that change or repeat actions go outside it.

    ## Info (added to the environment's, at reset too)
    | key | shape or type | unit | meaning |
    |---|---|---|---|
    | `shield_intervened` | bool | - | whether it overrode the action; in mode "monitor" whether "switch" would have |
    | `input_proposed` | `(m,)` | of the inputs | the agent's input; zeros at reset |
    | `shield_correction` | float | of the inputs | Euclidean norm of `input_committed` - `input_proposed` |
    | `shield_margin` | float | - | how far inside S the next state stays (`Decision.margin`); at reset for u = 0 |
    | `shield_guaranteed` | bool | - | whether x in S is proved now (in mode "lookahead": x in the box, to stay) |
    | `shield_reason` | str | - | why it is not; empty while it is |
    | `episode_interventions` | int | steps | number of steps of this episode with `shield_intervened` |
    | `episode_guaranteed` | float | - | share of the states of this episode, the first included, proved as now |
    | `shield_plan_length` | int | steps | in mode "lookahead" only: number of inputs stored for later steps |

    In mode "lookahead" an input passes too if a certified plan that begins with it keeps the state in the box until it
    is in S; `shield_guaranteed` then says whether the state is proved to be in the box now and to stay there.

    Where the plant models another process, that is proved of the process only if `plant.remainder.is_proved`; else it
    rests on the assumption that sampling found the largest remainder (docs/beyond_linear.md).

    Args:
        env: An `NCSEnv`, possibly wrapped.
        certificate: A certificate, its `document`, or the path of its file; None takes the one that
            `shields.certificate_for` has for the environment's plant and contract. A spec holds the document, so that
            it is JSON.
        mode: "project", "lookahead", "switch", "boundary" or "monitor"; see `SafetyFilter`.
        penalty: Subtracted from the reward per intervention counted, >= 0.
        horizon: Longest plan of mode "lookahead", in steps; see `SafetyFilter`.
        on_unproved: What reset and step do, once per episode and reason, where x in S is not proved: "warn" with a
            `GuaranteeLostWarning`, "raise" a `GuaranteeLostError` after the step, "ignore" if you read the infos.

    Raises:
        CertificateError: If the certificate does not verify for the environment's plant.
        Infeasible: If none is given and none is found.
        ValueError: If the environment is not an `NCSEnv`, an inner wrapper changes or repeats actions, or a setting
            is wrong.
    """

    _wanted, _wrappers, _refused = NCSEnv, gym.Wrapper, REFUSED

    def __init__(
        self,
        env: gym.Env,
        certificate: Certificate | Mapping[str, Any] | str | os.PathLike[str] | None = None,
        mode: str = "project",
        penalty: float = 0.0,
        horizon: int | None = None,
        on_unproved: str = "warn",
    ) -> None:
        self._make(env, certificate, mode, penalty, horizon, on_unproved)
        self._look_at({self._inner.channel})
        self._monitored = MonitoredFilter(self._filter, self._inner.downlink_protocol)
        self._episode = _Episode()
        self._start: Any = None
        self._known: tuple[StartKnown, ...] = ()
        self._is_drawn = env.unwrapped.render_mode is not None

    @np.errstate(all="ignore")
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode; see `NCSEnv.reset`.

        Raises:
            ValueError: If what is wrapped is not any more what the shield was made for.
            GuaranteeLostError: If x in S is not proved and that is to be raised; the episode has begun then.
        """
        if self._is_drawn:
            self._annotate(None, 0, NO_PLAN, intervened=False)
        observation, info = self.env.reset(seed=seed, options=options)
        self._require_same()
        self._look_at({self._inner.episode_channel})
        now, clock, known, start = self._episode, self._read_clock(), self._inner.belief, self._inner.start
        report, errors = self._observed(known), self._monitored.errors
        ahead = self._inner.estimates_ahead()[:-1]
        earlier = [LoopObservation(mean, errors.one(known.table, number), False) for mean, number in ahead]
        if start is not self._start:  # decided exactly, which takes longer than a step; starts are read-only
            self._start, self._known = start, starts_known(self._filter, start, self._input_delay)
        self._monitored.begin(report, self._known, clock[1] == 0, earlier=earlier)
        now.interventions = now.proved = 0
        u = np.zeros(self._filter.plant.m)
        margin = self._filter.margin(report.estimate, report.errors, u)
        now.clock = clock
        info = info | self._info(u, u, margin, intervened=False)
        self._lost.begin()
        self._lost.tell_of(info["shield_reason"])
        return observation, info

    @np.errstate(all="ignore")
    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Applies the action, or what the shield puts in its place.

        Raises:
            ValueError: If the action is not finite or wrongly shaped; nothing has moved then.
            gymnasium.error.ResetNeeded: If there was no reset.
            GuaranteeLostError: If x in S is not proved and that is to be raised; the step has been taken then.
        """
        now = self._episode
        if now.clock is None:
            raise gym.error.ResetNeeded("call reset before the first step")
        action, proposed = read_action(self._filter.plant, action)  # what is tested is what is handed on
        (episode, step), now.clock = now.clock, INTERRUPTED
        decision = self._monitored.decide(proposed)
        if decision.intervened and self._filter.mode != "monitor":
            action = nearest_action(decision.input, self._filter.plant)
        if self._is_drawn:
            count = now.interventions + decision.intervened
            self._annotate(proposed, count, decision.plan, intervened=decision.intervened)
        observation, reward, terminated, truncated, info = self.env.step(action)
        clock, known = self._read_clock(), self._inner.belief
        moved_once = clock == (episode, step + 1)
        self._monitored.advance(known.applied, moved_once, self._observed(known), known.committed)
        now.interventions += decision.intervened
        now.clock = clock
        info = info | self._info(proposed, decision.input, decision.margin, intervened=decision.intervened)
        self._lost.tell_of(info["shield_reason"])
        return observation, float(reward) - self.penalty * decision.intervened, terminated, truncated, info

    def _observed(self, known: Belief) -> LoopObservation:
        errors = self._monitored.errors.one(known.table, known.number)
        stays = known.table.is_certified(known.number)
        seen = known.estimate, errors, known.alarm, known.age, known.damaged
        return LoopObservation(*seen, stays, known.outside)

    def _read_clock(self) -> tuple[int, int]:
        return self._inner.episodes, self._inner.steps

    def _info(self, proposed: np.ndarray, applied: np.ndarray, margin: float, *, intervened: bool) -> dict[str, Any]:
        reason, now = self._monitored.reason, self._episode
        now.proved += not reason
        ahead = {}
        if self._filter.mode == "lookahead":
            ahead["shield_plan_length"] = self._monitored.plan_length
        return ahead | {
            "shield_intervened": intervened,
            "input_proposed": proposed.copy(),
            "shield_correction": hypot(*(applied - proposed).tolist()) if intervened else 0.0,
            "shield_margin": margin,
            "shield_guaranteed": not reason,
            "shield_reason": reason,
            "episode_interventions": now.interventions,
            "episode_guaranteed": now.proved / (self._inner.steps + 1),
        }
