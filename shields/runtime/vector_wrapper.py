"""The shield as a wrapper of a vector environment."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorActionWrapper, VectorEnv, VectorWrapper
from ncs_gym.estimation.gain_table import GainTable

from ncs_gym.envs.vector_env import NCSVectorEnv
from ncs_gym.plants.linear_plant import SIMULATED_REACH
from ncs_gym.validation import as_number, as_numbers, shown
from shields.certificate import Certificate
from shields.runtime import guarantee as proof
from shields.runtime.filter import MARGIN, SafetyFilter
from shields.runtime.guarantee import starts_inside
from shields.runtime.routine import (
    BROKEN,
    CERTIFIED,
    CORRECTION,
    COUNTS,
    INSIDE,
    INTERVENTIONS,
    KNOWN,
    MARKS,
    TOLD,
    TOTAL,
    follow,
)
from shields.runtime.tracking import OTHER_STEPS, Ground, Knowledge, compare_clocks, count_interventions, number, track
from shields.runtime.vector_filter import Decisions, VectorFilter, overridden
from shields.runtime.wrapper import certificate_for

# Reasons by code, see `tracking`.
WHY = np.array(
    [
        "",
        proof.ALARM,
        proof.OTHER_INPUT,
        proof.OTHER_STEPS,
        proof.LARGE_ERROR,
        proof.FAR_OUT,
        proof.UNUSABLE,
        proof.NO_ERROR_SET,
        proof.NOT_KNOWN_INSIDE,
    ],
    dtype=object,
)


class Clock(NamedTuple):
    """How often the environments moved: episodes begun and steps in them, shape (N,) each, and steps of the vector."""

    episodes: np.ndarray
    steps: np.ndarray
    ticks: int


class VectorSafetyShield(VectorWrapper, RecordConstructorArgs):
    """`SafetyShield` for an `NCSVectorEnv`: the same decisions, proof and info keys, in batches.

    Every info value has N as its first axis; `shield_reason` is an array of str objects, read-only while
    all proofs hold. A step that only resets an environment counts no intervention. With SAME_STEP autoreset
    `final_info` holds the last step's values.

    Args:
        env: An `NCSVectorEnv`, possibly wrapped; not by wrappers that change actions.
        certificate: None synthesizes one for the environment's plant and contract, once per process.
        mode: "project", "switch", "boundary" or "monitor"; see `SafetyFilter`.
        penalty: Subtracted from the reward per intervention counted, >= 0.

    Raises:
        CertificateError: If the certificate does not verify for the environment's plant.
        Infeasible: If none is given and none is found.
        ValueError: If the environment is not an `NCSVectorEnv`, an inner wrapper changes actions, or a setting is
            wrong.
    """

    def __init__(
        self,
        env: VectorEnv,
        certificate: Certificate | None = None,
        mode: str = "project",
        penalty: float = 0.0,
    ) -> None:
        RecordConstructorArgs.__init__(self, certificate=certificate, mode=mode, penalty=penalty)
        self._inner = inner = _environment_behind(env)
        VectorWrapper.__init__(self, env)
        self.penalty = as_number(penalty, "penalty", low=0.0)
        if certificate is not None and not isinstance(certificate, Certificate):
            raise ValueError(f"certificate must be a Certificate or None, got {shown(certificate)}")
        self.certificate = certificate_for(inner.plant, inner.contract) if certificate is None else certificate
        self.filter = SafetyFilter(self.certificate, inner.plant, mode)
        self._batch = VectorFilter(self.filter)
        self._starts_inside = starts_inside(self.certificate, inner.single.initial_set)
        test = self.filter.test
        self._ground = Ground(
            test.root,
            test.own_columns,
            SIMULATED_REACH * inner.plant.half_widths,
            test.rounding,
            MARGIN,
            self.certificate.Sigma is not None,
        )
        self._bounds = np.array([self._ground.columns, self._ground.reach])
        count, self._inner = self.num_envs, inner
        self._counts, self._marks = np.zeros((COUNTS, count), np.int64), np.zeros((MARKS, count), np.bool_)
        self._counts[BROKEN] = OTHER_STEPS
        self._knowledge = Knowledge(self._counts[BROKEN], self._marks[INSIDE], self._marks[CERTIFIED])
        self._known, self._interventions = self._marks[KNOWN], self._counts[INTERVENTIONS]
        self._table, self._numbers = None, np.zeros(0, np.int64)
        self._reason = np.full(count, OTHER_STEPS)
        self._some_wrong = True
        self._no_reason = np.full(count, "", dtype=object)
        self._no_reason.flags.writeable = False
        # What the clock reads while a step is under way: if it raises, the next does not follow from what is known.
        self._interrupted = Clock(np.full(count, -1), np.full(count, -1, np.int32), -2)
        self._clock: Clock | None = None

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts episodes; see `NCSVectorEnv.reset`."""
        before, self._clock = self._clock or self._interrupted, self._clock and self._interrupted
        try:
            # gymnasium's annotation leaves out the lists that its own vector environments take.
            observation, info = self.env.reset(seed=seed, options=options)  # pyright: ignore[reportArgumentType]
        except ValueError:
            if self._clock and all(np.array_equal(*pair) for pair in zip(before, self._read_clock(), strict=True)):
                self._clock = before  # refused before anything moved
            raise
        now = self._read_clock()
        restarted = now.episodes != before.episodes
        unmoved = (now.steps == before.steps) & (now.ticks == before.ticks)
        self._interventions[restarted] = 0
        self._observe(info, restarted, np.where(restarted, now.steps == 0, unmoved), None)
        self._clock = now
        return observation, info | self._idle_info(restarted, None)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Applies the actions, or what the shield puts in the place of some.

        Raises:
            ValueError: If an action is not finite or the shape is wrong; nothing has moved then.
            gymnasium.error.ResetNeeded: If there was no reset.
        """
        if self._clock is None:
            raise gym.error.ResetNeeded("call reset before the first step")
        proposed = self._inner.inputs_of(actions)
        decisions = self._batch.decide(self._estimate, self._shape_number, proposed)
        if self.filter.mode != "monitor" and np.count_nonzero(decisions.intervened):
            actions = overridden(actions, decisions, self.filter.plant.u_max)
        before, self._clock = self._clock, self._interrupted
        observation, rewards, terminated, truncated, info = self.env.step(actions)
        told, guaranteed = np.empty((TOLD, self.num_envs)), np.empty(self.num_envs, np.bool_)
        wrong = self._follow(before, info, decisions, proposed, told, guaranteed)
        if wrong < 0:
            return self._restarted((observation, rewards, terminated, truncated, info), before, decisions, proposed)
        self._some_wrong, self._clock = wrong > 0, Clock(before.episodes, before.steps, self._inner.ticks)
        rewards = rewards - self.penalty * decisions.intervened if self.penalty else rewards
        added = {
            "shield_intervened": decisions.intervened,
            "input_proposed": proposed.T,
            "shield_correction": told[CORRECTION],
            "shield_margin": decisions.margin,
            "shield_guaranteed": guaranteed,
            "shield_reason": WHY[self._reason] if self._some_wrong else self._no_reason,
            "episode_interventions": told[TOTAL].view(np.int64),
        }
        return observation, rewards, terminated, truncated, info | added

    def _follow(
        self,
        before: Clock,
        info: dict[str, Any],
        decisions: Decisions,
        proposed: np.ndarray,
        told: np.ndarray,
        guaranteed: np.ndarray,
    ) -> int:
        """Takes in a step that began no episode; see `routine.follow`."""
        inner, ground = self._inner, self._ground
        table, nodes = inner.patterns
        if table is not self._table:
            return -1
        self._make_room(table)
        return follow(
            ground.root,
            self._bounds,
            self._batch.book.widest,
            ground.rounding,
            ground.margin,
            ground.has_errors,
            self._batch.book.seen,
            self._numbers,
            nodes,
            inner.episodes,
            inner.steps,
            before.episodes,
            before.steps,
            inner.ticks == before.ticks + 1,
            self._counts,
            self._marks,
            decisions.inputs,
            proposed,
            decisions.intervened,
            decisions.passed,
            decisions.fallback,
            self._rows(info, "input"),
            self._rows(info, "estimate"),
            self._alarms(info),
            self._shape_number,
            self._estimate,
            self._reason,
            told,
            guaranteed,
        )

    def _rows(self, info: dict[str, Any], key: str) -> np.ndarray:
        """Returns what `_reported` does, not always a copy."""
        value = info.get(key)
        size = self.filter.plant.n if key == "estimate" else self.filter.plant.m
        if type(value) is np.ndarray and value.dtype == np.float64 and value.shape == (self.num_envs, size):
            rows = value.T
            if rows.flags.c_contiguous:
                return rows
        return self._reported(info, key, np.nan)

    def _restarted(self, stepped: tuple, before: Clock, decisions: Decisions, proposed: np.ndarray) -> tuple:
        """Returns what `step` does where some episodes began, given what the environment's step returned."""
        observation, rewards, terminated, truncated, info = stepped
        now, (restarted, moved_once) = self._read_clock(), np.empty((2, self.num_envs), np.bool_)
        next_tick = now.ticks == before.ticks + 1
        clocks = now.episodes, now.steps, before.episodes, before.steps
        some_restarted = compare_clocks(*clocks, next_tick, restarted, moved_once) > 0
        added, charged = {}, decisions.intervened
        if some_restarted and "final_info" in info:  # SAME_STEP: the step ended an episode before it began the next
            added["final_info"] = self._final_info(info, decisions, proposed, moved_once)
        elif some_restarted:
            charged = charged & ~restarted
        rewards = rewards - self.penalty * charged if self.penalty else rewards
        correction = np.empty(self.num_envs)
        count_interventions(decisions.intervened, decisions.inputs, proposed, self._interventions, correction)
        self._interventions[restarted] = 0
        self._observe(info, restarted, moved_once, decisions)
        self._clock = now
        if some_restarted:
            added |= self._idle_info(restarted, (decisions, proposed, correction))
        else:
            added |= self._info(decisions, proposed, correction)
        return observation, rewards, terminated, truncated, info | added

    def _observe(
        self, info: dict[str, Any], restarted: np.ndarray, moved_once: np.ndarray, decisions: Decisions | None
    ) -> None:
        """Takes in what the environment reports, and moves the proofs on."""
        self._estimate = self._reported(info, "estimate", np.nan)
        self._shape_number = self._numbers_of_shapes()
        self._reason = self._proved(info, restarted, moved_once, decisions)

    def _proved(
        self,
        info: dict[str, Any],
        restarted: np.ndarray,
        moved_once: np.ndarray,
        decisions: Decisions | None,
        knowledge: Knowledge | None = None,
    ) -> np.ndarray:
        """Returns why each proof does not hold, as codes, shape (N,), and changes `knowledge`."""
        knowledge = self._knowledge if knowledge is None else knowledge
        count, m = self.num_envs, self.filter.plant.m
        decided = decisions
        if decided is None:
            nothing = np.zeros(count, np.bool_)
            decided = Decisions(np.zeros((m, count)), nothing, knowledge.inside, knowledge.inside, nothing, nothing)
        reason = np.empty(count, np.int64)
        inputs = decided.inputs if decisions is None else self._reported(info, "input", np.nan)
        wrong = track(
            self._ground,
            self._batch.book.seen,
            self._shape_number,
            knowledge,
            restarted,
            moved_once,
            decided.inputs,
            decided.passed,
            decided.fallback,
            self._known_starts(restarted),
            inputs,
            self._estimate,
            self._alarms(info),
            reason,
        )
        self._some_wrong = wrong > 0
        return reason

    def _alarms(self, info: dict[str, Any]) -> np.ndarray:
        """Returns which alarms are reported, shape (N,); all if the shape or kind is wrong."""
        value = info.get("assumption_violated")
        if type(value) is np.ndarray and value.dtype == np.bool_ and value.shape == (self.num_envs,):
            return np.ascontiguousarray(value)
        return self._reported(info, "assumption_violated", 1.0) != 0.0

    def _reported(self, info: dict[str, Any], key: str, unusable: float) -> np.ndarray:
        """Returns a copy of an info with the environment as last axis, all `unusable` if its shape or kind is wrong."""
        plant, count = self.filter.plant, self.num_envs
        shape = {"estimate": (count, plant.n), "input": (count, plant.m)}.get(key, (count,))
        value = as_numbers(info.get(key))
        return np.full(shape[::-1], unusable) if value is None or value.shape != shape else np.array(value.T, order="C")

    def _known_starts(self, restarted: np.ndarray) -> np.ndarray:
        """Returns whether all possible starts of the present episodes lie in S, shape (N,)."""
        if np.count_nonzero(restarted):  # a tenth of the time of `any`
            self._known[restarted] = self._starts_inside
            starts = self._inner.starts
            for e in np.flatnonzero(restarted & ~np.isnan(starts[:, 0])).tolist():
                self._known[e] = starts_inside(self.certificate, starts[e])
        return self._known

    def _numbers_of_shapes(self) -> np.ndarray:
        """Returns the index in the book of each environment's error shape, shape (N,)."""
        table, nodes = self._inner.patterns
        if table is not self._table:
            self._table, self._numbers = table, np.full(len(table), -1)
        self._make_room(table)
        numbers = np.empty(self.num_envs, np.int64)
        if number(self._numbers, nodes, numbers) < 0:
            n = self.filter.plant.n
            for node in np.unique(nodes[numbers < 0]).tolist():
                self._numbers[node] = self._batch.book.number(table.shapes[:, node].reshape(n, n).copy())
            number(self._numbers, nodes, numbers)
        return numbers

    def _make_room(self, table: GainTable) -> None:
        """Makes the list of numbers at least as long as the table."""
        if len(table) > len(self._numbers):
            self._numbers = np.append(self._numbers, np.full(len(table), -1))

    def _read_clock(self) -> Clock:
        """Returns how often the environments moved until now."""
        inner = self._inner
        return Clock(inner.episodes.copy(), inner.steps.copy(), inner.ticks)

    def _info(self, decisions: Decisions, proposed: np.ndarray, correction: np.ndarray) -> dict[str, Any]:
        """Returns the shield's keys for the step that applied these decisions."""
        return {
            "shield_intervened": decisions.intervened,
            "input_proposed": proposed.T,
            "shield_correction": correction,
            "shield_margin": decisions.margin,
            "shield_guaranteed": self._reason == 0,
            "shield_reason": WHY[self._reason] if self._some_wrong else self._no_reason,
            "episode_interventions": self._interventions.copy(),
        }

    def _idle_info(
        self, restarted: np.ndarray, done: tuple[Decisions, np.ndarray, np.ndarray] | None
    ) -> dict[str, Any]:
        """Returns the shield's keys where episodes just began; elsewhere those of what was done, nothing if None."""
        count, m = self.num_envs, self.filter.plant.m
        nothing = np.zeros(count, np.bool_)
        margins = self._batch.margins(self._estimate, self._shape_number)
        idle = Decisions(np.zeros((m, count)), nothing, nothing, nothing, margins, nothing)
        info = self._info(idle, np.zeros((m, count)), np.zeros(count))
        if done is None:
            return info
        stepped = self._info(*done)
        return {
            key: np.where(restarted.reshape(-1, *[1] * (value.ndim - 1)), info[key], value)
            for key, value in stepped.items()
        }

    def _final_info(
        self,
        info: dict[str, Any],
        decisions: Decisions,
        proposed: np.ndarray,
        moved_once: np.ndarray,
    ) -> dict[str, Any]:
        """Returns final_info with the shield's keys of the last steps of episodes that ended (SAME_STEP)."""
        final, n = dict(info["final_info"]), self.filter.plant.n
        done = info["_final_info"]
        kept = self._estimate, self._shape_number, self._interventions, self._reason, self._some_wrong
        book = self._batch.book
        self._estimate = self._reported(final, "estimate", np.nan)
        shapes = [book.number(final["error_shape"][e].reshape(n, n).copy()) for e in np.flatnonzero(done).tolist()]
        self._shape_number = np.zeros(self.num_envs, np.int64)
        self._shape_number[done] = shapes
        knowledge = Knowledge(*(array.copy() for array in self._knowledge))
        never = np.zeros(self.num_envs, np.bool_)
        self._reason = self._proved(final, never, moved_once, decisions, knowledge)
        self._interventions = self._interventions + decisions.intervened
        correction = np.linalg.norm(decisions.inputs - proposed, axis=0)
        for key, value in self._info(decisions, proposed, correction).items():
            final[key], final[f"_{key}"] = value, done.copy()
        self._estimate, self._shape_number, self._interventions, self._reason, self._some_wrong = kept
        return final


def _environment_behind(env: VectorEnv) -> NCSVectorEnv:
    """Returns the innermost environment after looking at every wrapper around it."""
    layer = env
    while isinstance(layer, VectorWrapper):
        if isinstance(layer, (VectorActionWrapper, VectorSafetyShield)):
            raise ValueError(
                f"the shield must be inside {type(layer).__name__}, which changes actions: wrap the shield around the "
                "environment first"
            )
        layer = layer.env
    if not isinstance(layer, NCSVectorEnv):
        raise ValueError(
            f"the shield needs an NCSVectorEnv inside, got {type(layer).__name__}: for gymnasium's sync and async "
            "vector environments give make_vec(..., wrappers=[SafetyShield])"
        )
    if env.single_action_space != layer.single_action_space:
        raise ValueError(f"a wrapper inside the shield changes the action space to {env.single_action_space}")
    return layer
