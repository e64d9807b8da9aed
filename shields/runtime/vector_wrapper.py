"""The shield as a wrapper of a vector environment."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorActionWrapper, VectorEnv, VectorWrapper

from ncs_gym import LinearPlant
from ncs_gym.envs.loop import Belief
from ncs_gym.envs.spaces import nearest_action, read_actions
from ncs_gym.envs.vector_env import NCSVectorEnv
from ncs_gym.network import CommittedInputs
from ncs_gym.validation import AroundEnvironments, require_batched_infos
from shields.certificate import Certificate
from shields.runtime.decisions import NO_PLAN, Decision
from shields.runtime.guarantee import (
    CODES,
    EXPLANATIONS,
    OTHER_STEPS,
    GuaranteeMonitor,
    LoopObservation,
    MonitorState,
)
from shields.runtime.safety_filter import NumberedErrors
from shields.runtime.set_test import norms
from shields.runtime.starts import StartKnown, first_store, known_inside, starts_known
from shields.runtime.wrapper import BaseShield

# Why states are not proved safe, by code.
REASONS = np.array(EXPLANATIONS, dtype=object)


class Clock(NamedTuple):
    """How often the environments moved: episodes begun and steps in them, shape (N,) each, and steps of the vector."""

    episodes: np.ndarray
    steps: np.ndarray
    ticks: int


class VectorSafetyShield(BaseShield[NCSVectorEnv], AroundEnvironments, VectorWrapper):
    """`SafetyShield` for an `NCSVectorEnv`: the same decisions, proof and info keys, in batches.

    Every info value has N as its first axis; `shield_reason` is an array of str objects, read-only while
    all proofs hold. A step that only resets an environment counts no intervention. With SAME_STEP autoreset
    `final_info` holds the last step's values.

    Args:
        env: An `NCSVectorEnv`, possibly wrapped; not by wrappers that change actions.
        certificate: A certificate, its `document`, or the path of its file; None synthesizes one for the environment's
            plant and contract, once per process.
        mode: "project", "lookahead", "switch", "boundary" or "monitor"; see `SafetyFilter`.
        penalty: Subtracted from the reward per intervention counted, >= 0.
        horizon: Longest plan of mode "lookahead", in steps; see `SafetyFilter`.
        on_unproved: "ignore", "warn" or "raise"; see `SafetyShield`. Environments that lose the guarantee in the same
            step for the same reason are told of once.

    Raises:
        CertificateError: If the certificate does not verify for the environment's plant.
        Infeasible: If none is given and none is found.
        ValueError: If the environment is not an `NCSVectorEnv`, an inner wrapper changes actions, or a setting is
            wrong.
    """

    _wanted, _wrappers, _refused = NCSVectorEnv, VectorWrapper, (VectorActionWrapper,)

    def __init__(
        self,
        env: VectorEnv,
        certificate: Certificate | Mapping[str, Any] | str | os.PathLike[str] | None = None,
        mode: str = "project",
        penalty: float = 0.0,
        horizon: int | None = None,
        on_unproved: str = "warn",
    ) -> None:
        self._make(env, certificate, mode, penalty, horizon, on_unproved)
        inner = self._inner
        self._look_at({*inner.episode_channels})
        self._monitor = GuaranteeMonitor(self._filter, inner.downlink_protocol)
        self._start_known = starts_known(self._filter, inner.single.initial_set, self._input_delay)
        count, nothing = self.num_envs, np.zeros(self.num_envs, np.bool_)
        self._schedule = (
            None
            if inner.downlink_protocol.channel is None
            else CommittedInputs(self._input_delay, (inner.plant.m, count))
        )
        broken, wait = np.full(count, CODES[OTHER_STEPS]), np.zeros(count, np.int64)
        self._state = MonitorState(broken, nothing, nothing, nothing, wait)
        self._interventions, self._proved = np.zeros((2, count), np.int64)
        # Plans stored in mode "lookahead", NaN beyond their ends.
        self._stored = np.full((self._filter.lookahead.horizon, inner.plant.m, count), np.nan)
        self._errors = NumberedErrors(self._filter)
        self._no_reason = np.full(count, "", dtype=object)
        self._no_reason.flags.writeable = False
        self._clock: Clock | None = None

    @np.errstate(all="ignore")
    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts episodes; see `NCSVectorEnv.reset`.

        Raises:
            ValueError: If what is wrapped is not any more what the shield was made for.
            GuaranteeLostError: If x in S is not proved and that is to be raised; the episodes have begun then.
        """
        before = self._clock or Clock(np.full(self.num_envs, -1), np.full(self.num_envs, -1), -1)
        if self._inner.render_mode is not None:
            self._annotate(None, 0, NO_PLAN, intervened=False)
        # gymnasium's annotation leaves out the lists that its own vector environments take.
        observation, info = self.env.reset(seed=seed, options=options)  # pyright: ignore[reportArgumentType]
        require_batched_infos(info, "VectorSafetyShield")
        self._require_same()
        self._look_at({*self._inner.episode_channels})
        now = self._read_clock()
        restarted = now.episodes != before.episodes
        unmoved = (now.steps == before.steps) & (now.ticks == before.ticks)
        self._report = self._observed(self._inner.belief)
        nothing, none = np.zeros((self._filter.plant.m, self.num_envs)), np.zeros(self.num_envs, np.bool_)
        idle = Decision(nothing, none, none, none, self._idle_margins(np.arange(self.num_envs)), none)
        kept = idle._replace(proved=self._state.inside)  # environments left alone keep what is proved of them
        kept_state = self._monitor.advance(self._state, kept, unmoved, ~none, self._report)
        self._state = kept_state._replace(wait=np.maximum(kept_state.wait, self._state.wait))  # no step has passed
        self._stored[..., ~unmoved] = np.nan
        self._start(restarted, now.steps == 0)
        self._clock = now
        idle = idle._replace(plan=self._stored)
        own = self._info(idle, idle.input, self._state, self._interventions, self._report.age)
        self._proved = np.where(restarted, own["shield_guaranteed"], self._proved)
        info = info | own | {"episode_guaranteed": self._proved / (now.steps + 1)}
        self._lost.tell()
        return observation, info

    @np.errstate(all="ignore")
    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Applies the actions, or what the shield puts in the place of some.

        Raises:
            ValueError: If an action is not finite or the shape is wrong; nothing has moved then.
            gymnasium.error.ResetNeeded: If there was no reset.
            GuaranteeLostError: If x in S is not proved and that is to be raised; the step has been taken then.
        """
        if self._clock is None:
            raise gym.error.ResetNeeded("call reset before the first step")
        actions, proposed = read_actions(self._filter.plant, actions, self.num_envs)
        before, self._clock = self._clock, self._clock._replace(ticks=-2)  # after an exception nothing is proved
        decided = self._filter.decide_columns(self._report.estimate, self._report.errors, proposed, self._stored)
        if self._filter.mode != "monitor" and np.count_nonzero(decided.intervened):
            actions = overridden(actions, decided, self._filter.plant)
        if self._inner.render_mode is not None:
            e = self._inner.rendered_env
            plan, acted = decided.plan[..., e], bool(decided.intervened[e])
            plan = plan[~np.isnan(plan[:, 0])] if len(plan) else plan
            self._annotate(proposed[:, e].copy(), int(self._interventions[e]) + acted, plan, intervened=acted)
        observation, rewards, terminated, truncated, info = self.env.step(actions)
        now, state = self._read_clock(), self._state
        restarted, moved_once = _moved(before, now)
        some_restarted = np.count_nonzero(restarted) > 0
        if some_restarted:
            self._look_at({*self._inner.episode_channels})
        known = self._inner.belief
        self._report = self._observed(known)
        due = None if self._schedule is None else self._schedule.due(decided.input)
        same_input, on_time = _as_decided(known, decided.input, due)
        self._state = self._monitor.advance(state, decided, moved_once, same_input, self._report, on_time)
        self._interventions = self._interventions + decided.intervened
        added, charged, self._stored = {}, decided.intervened, decided.plan.copy()
        if len(self._stored):  # what is stored was certified for the states that follow
            self._stored[..., ~(moved_once & same_input & on_time)] = np.nan
        if some_restarted:
            charged = charged & ~restarted
            if (ended := self._inner.ended) is not None:  # SAME_STEP: the step ended episodes before it began the next
                final = info.get("final_info", {})
                added["final_info"] = self._final_info(
                    final, ended, state, decided, proposed, moved_once, due, before.steps
                )
                charged = decided.intervened.copy()
            self._start(restarted, moved_once)
            decided.input[:, restarted], proposed[:, restarted], decided.intervened[restarted] = 0.0, 0.0, False
            decided.margin[restarted] = self._idle_margins(np.flatnonzero(restarted))
            self._proved = np.where(restarted, 0, self._proved)
        self._clock = now
        if self.penalty:
            rewards = rewards - self.penalty * charged
        decided = decided._replace(plan=self._stored)
        own = self._info(decided, proposed, self._state, self._interventions, self._report.age)
        self._proved = self._proved + own["shield_guaranteed"]
        info = info | added | own | {"episode_guaranteed": self._proved / (now.steps + 1)}
        self._lost.tell()
        return observation, rewards, terminated, truncated, info

    def _observed(self, known: Belief) -> LoopObservation:
        errors = self._errors.many(known.table, known.number)
        seen = np.ascontiguousarray(known.estimate), errors, known.alarm, known.age, known.damaged
        return LoopObservation(*seen, known.table.certified.take(known.number), known.outside)

    def _start(self, restarted: np.ndarray, begun: np.ndarray) -> None:
        """Begins anew where episodes began, `begun` where nothing has moved since; shape (N,) each."""
        self._lost.begin(restarted)
        known, starts = [self._start_known] * self.num_envs, self._inner.starts
        for e in np.flatnonzero(restarted & ~np.isnan(starts[:, 0])).tolist():
            known[e] = starts_known(self._filter, starts[e], self._input_delay)
        is_safe = np.array([each[-1].in_safe_set for each in known])
        if len(self._stored):
            self._stored[..., restarted] = np.nan
            for e in np.flatnonzero(restarted).tolist():
                estimate, errors = self._report.estimate[:, e].copy(), self._report.errors.single(e)
                plan, is_safe[e] = first_store(self._filter, estimate, errors, known[e][-1])
                self._stored[: len(plan), :, e] = plan
        started = self._monitor.start(is_safe, begun, self._report)
        both = zip(started, self._state, strict=True)
        self._state = MonitorState(*(np.where(restarted, new, old) for new, old in both))
        if self._schedule is not None:
            self._schedule.start(restarted)
            self._cover(np.flatnonzero(restarted), known)
        self._interventions = np.where(restarted, 0, self._interventions)

    def _cover(self, chosen: np.ndarray, known: list[tuple[StartKnown, ...]]) -> None:
        """Takes in what is known of the steps before the first decisions take effect, where episodes began."""
        earlier, no_alarm = [], np.zeros(len(chosen), np.bool_)
        for ahead, (means, numbers) in enumerate(self._inner.estimates_ahead(chosen)[:-1]):
            errors = self._errors.many(self._inner.belief.table, numbers)
            inside = [
                known_inside(self._filter, known[e][ahead], means[:, k].copy(), errors.single(k))
                for k, e in enumerate(chosen.tolist())
            ]
            earlier.append((np.array(inside, np.bool_), LoopObservation(means, errors, no_alarm)))
        covered = self._monitor.cover(MonitorState(*(array[chosen] for array in self._state)), earlier)
        for kept, new in zip(self._state, covered, strict=True):
            kept[chosen] = new

    def _final_info(
        self,
        info: dict[str, Any],
        ended: tuple[np.ndarray, Belief],
        state: MonitorState,
        decided: Decision,
        proposed: np.ndarray,
        moved_once: np.ndarray,
        due: np.ndarray | None,
        steps: np.ndarray,
    ) -> dict[str, Any]:
        """Returns final_info with the shield's keys of the last steps of episodes that ended (SAME_STEP)."""
        final, (is_done, known) = dict(info), ended
        done = np.flatnonzero(is_done)
        errors = self._errors.many(known.table, known.number[done])
        known = known._replace(applied=known.applied[:, done], committed=known.committed[:, done])
        seen = known.estimate[:, done], errors, known.alarm[done], known.age[done], known.damaged[done]
        report = LoopObservation(*seen, known.table.certified[known.number[done]], known.outside[done])
        state = MonitorState(*(array[done] for array in state))
        decided = Decision(*(array[..., done] for array in decided))
        same_input, on_time = _as_decided(known, decided.input, None if due is None else due[:, done])
        state = self._monitor.advance(state, decided, moved_once[done], same_input, report, on_time)
        own = self._info(decided, proposed[:, done], state, self._interventions[done], report.age, done)
        proved = self._proved[done] + own["shield_guaranteed"]
        own["episode_guaranteed"] = proved / (steps[done] + 2)
        for key, value in own.items():
            final[key] = np.full((self.num_envs, *value.shape[1:]), "" if value.dtype == object else 0, value.dtype)
            final[key][done], final[f"_{key}"] = value, is_done.copy()
        return final

    def _idle_margins(self, chosen: np.ndarray) -> np.ndarray:
        """Returns the margins of no input in some environments, shape (len(chosen),)."""
        sets = self._filter.test.reachable(self._report.estimate[:, chosen], self._report.errors.of(chosen))
        return sets.margins(np.zeros((self._filter.plant.m, len(chosen))))[1]

    def _read_clock(self) -> Clock:
        inner = self._inner
        return Clock(inner.episodes.copy(), inner.steps.copy(), inner.ticks)

    def _info(
        self,
        decided: Decision,
        proposed: np.ndarray,
        state: MonitorState,
        interventions: np.ndarray,
        ages: np.ndarray,
        chosen: np.ndarray | None = None,
    ) -> dict[str, Any]:
        """Returns the shield's keys, new arrays, for steps that applied these decisions, in all or some environments.

        Where the guarantee is lost, that is noted.
        """
        reasons = self._monitor.reasons(state, ages)
        doubted = np.count_nonzero(reasons) > 0
        if doubted:
            self._lost.note(reasons, np.arange(self.num_envs) if chosen is None else chosen)
        ahead = {}
        if len(self._stored):
            ahead["shield_plan_length"] = np.count_nonzero(~np.isnan(decided.plan[:, 0]), axis=0)
        return ahead | {
            "shield_intervened": decided.intervened,
            "input_proposed": proposed.T,
            "shield_correction": norms(decided.input - proposed),
            "shield_margin": decided.margin,
            "shield_guaranteed": reasons == 0,
            "shield_reason": REASONS[reasons] if doubted else self._no_reason[: len(reasons)],
            "episode_interventions": interventions.copy(),
        }


def _moved(before: Clock, now: Clock) -> tuple[np.ndarray, np.ndarray]:
    """Returns where a new episode began, and which environments moved just one step (to its start, where it began)."""
    restarted, once = now.episodes != before.episodes, now.steps == before.steps + 1
    if np.count_nonzero(restarted):
        to_start = (now.steps == 0) & (now.episodes == before.episodes + 1)
        once = np.where(restarted, to_start, once)
    return restarted, once & (now.ticks == before.ticks + 1)


def _as_decided(known: Belief, decided: np.ndarray, due: np.ndarray | None) -> tuple[np.ndarray, Any]:
    """Returns where the input taken is the one decided and, behind a downlink, the one applied the one that was due.

    Args:
        known: Of the innermost environment, after the step.
        decided: Inputs decided in this step, shape (m, N).
        due: Inputs decided for this step, shape (m, N); None without a downlink, where True stands for the second.
    """
    if due is None:
        return (known.applied == decided).all(axis=0), True
    return (known.committed == decided).all(axis=0), (known.applied == due).all(axis=0)


def overridden(actions: Any, decided: Decision, plant: LinearPlant) -> np.ndarray:
    """Returns the actions, shape (N, m), with those that stand for the inputs decided where the shield intervened."""
    numbers = np.asarray(actions)
    numbers = numbers.astype(np.float32 if numbers.dtype == np.float32 else np.float64)
    chosen = np.flatnonzero(decided.intervened)
    numbers[chosen] = nearest_action(decided.input[:, chosen].T, plant)
    return numbers
