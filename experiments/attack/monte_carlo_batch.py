"""A batch of episodes under attack; its counts are a pure function of its settings."""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.attack.campaign import SHIELD_MODES, Campaign
from experiments.attack.safety_counts import SafetyCounts
from experiments.attack.worst_case import (
    GaussianVectorEnv,
    HostileAgents,
    HostileRequests,
    WorstCaseVectorEnv,
    starts_in_box,
)
from ncs_gym import NCSVectorEnv
from ncs_gym.registration import EPISODE_STEPS
from shields import Certificate, VectorSafetyShield
from shields.json_documents import digest

# Episodes start on the boundary of S; the largest level is taken from this step on.
SETTLING_STEPS = 20


@dataclass(frozen=True)
class MonteCarloBatch:
    """A batch of episodes of one attack case, a run like any other.

    Attributes:
        campaign: Settings of the campaign.
        case: Name of the attack case.
        index: Number of the batch within its case, from 0 on.
        certificate: Certificate of the case.
    """

    campaign: Campaign
    case: str
    index: int
    certificate: Certificate

    parts = ("attack",)
    result_type = SafetyCounts
    leaves = ()

    @property
    def name(self) -> str:
        """Name of the batch in file names, progress lines and messages."""
        return re.sub(r"[^\w.+-]+", "-", f"{self.case}-{self.index}")

    @property
    def key(self) -> str:
        """SHA-256 of everything that the counts depend on: the campaign, the case and versions of packages."""
        attacked = self.campaign.cases()[self.case]
        channels = f"{attacked.channel} {attacked.downlink}"  # what a module registers may change
        return digest([self.campaign.key, self.case, self.index, self.certificate.checksum, channels])

    @property
    def total_steps(self) -> int:
        """Number of steps in the batch."""
        return self.campaign.batch_steps

    def execute(self, on_progress: Callable[[int], None], log_folder: Path | None = None) -> SafetyCounts:
        """Returns the counts, the same in any process and after any other batch.

        Args:
            on_progress: Called with the number of steps taken since its last call.
            log_folder: Not used.

        Raises:
            CertificateError: If the certificate does not verify for the case's plant.
        """
        campaign = self.campaign
        shields = list(_shields(campaign, self.case, self.certificate).values())
        shield = shields[self.index % len(shields)]
        plant, safe_set = shield.filter.plant, shield.filter.certificate.safe_set
        seeds = np.random.SeedSequence([campaign.seed, zlib.crc32(self.case.encode()), self.index])
        seed, policy_seed = seeds.generate_state(2, np.uint64).tolist()
        rng = np.random.default_rng(policy_seed)
        info = _begin(campaign, shield, seed >> 1, rng)
        agents = HostileAgents(campaign.envs, plant, shield.certificate, rng)
        attacked, env = campaign.cases()[self.case], shield.env.unwrapped
        assert isinstance(env, NCSVectorEnv)
        requests = HostileRequests(campaign.envs, shield.certificate, rng) if attacked.channel.on_request else None
        counts = SafetyCounts(
            steps=campaign.batch_steps,
            episodes=campaign.envs,
            unproved=int(np.count_nonzero(~info["shield_guaranteed"])),
            outside_starts=int(np.count_nonzero(safe_set.gauge(info["state"]) > 1.0)),
        )
        kept, broken = np.ones(campaign.envs, np.bool_), np.zeros(campaign.envs, np.bool_)
        for step in range(EPISODE_STEPS):
            if requests is not None:
                env.request(requests.ask(info))
            *_, info = shield.step(agents.act(info["estimate"]))
            claimed, kept = _claimed_and_kept(info, kept)
            if not campaign.shielded:  # nothing is claimed, and everything counted
                claimed[:] = True
            outside, reached = _outside_and_reached(campaign, info, safe_set.gauge(info["state"]))
            counts += _step_counts(info, outside, claimed, kept)
            if attacked.keeps_contract:
                counts += SafetyCounts(overdue=int(np.count_nonzero(info["contract_broken"])))
            broken |= claimed & (outside.box | (outside.safe_set & (not campaign.looks_ahead)))
            if step >= SETTLING_STEPS:
                level = float(np.nan_to_num(reached, nan=np.inf).max(initial=0.0, where=claimed))
                counts += SafetyCounts(level=level)
            on_progress(campaign.envs)
        return counts + SafetyCounts(broken_episodes=int(broken.sum()), packets=int(info["packets"].sum()))

    def require(self, result: SafetyCounts) -> None:
        """Returns if counts can be this batch's.

        Raises:
            ValueError: If a batch of so many episodes cannot have counted this.
        """
        steps, envs = self.campaign.batch_steps, self.campaign.envs
        most = dict.fromkeys(("episodes", "broken_episodes", "outside_starts"), envs) | {"level": math.inf}
        most["unproved"] = steps + envs  # which counts starts, too
        for name, count in vars(result).items():
            if not 0 <= count <= most.get(name, steps):
                raise ValueError(f"{name} of a batch cannot be {count}")
        if (result.steps, result.episodes) != (steps, envs) or result.lapsed_violations > result.lapsed:
            raise ValueError("these are no counts of a whole batch")


class _Outside(NamedTuple):
    """Which true states lie outside S and outside the safe box, arrays of shape (N,)."""

    safe_set: np.ndarray
    box: np.ndarray


def _claimed_and_kept(info: dict[str, Any], kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns of which states safety is claimed now, and in which episodes all contracts were kept so far.

    The present state is the result of an earlier decision: it does not rest on the age of the newest sample now, but on
    the input that the actuator applied. After a broken contract what the shield says itself is claimed.

    Args:
        info: What the step returned.
        kept: In which episodes all contracts were kept before the step, shape (N,).
    """
    kept = kept & ~info["downlink_broken"]
    return kept | info["shield_guaranteed"], kept & ~info["contract_broken"]


def _outside_and_reached(campaign: Campaign, info: dict[str, Any], levels: np.ndarray) -> tuple[_Outside, np.ndarray]:
    """Returns what lies outside, and the levels that the claim limits to one, (N,): in the safe set or max |c_j x|."""
    outside = _Outside(~(levels <= 1.0), info["cost"] != 0.0)
    return outside, info["constraint_values"].max(axis=1) + 1.0 if campaign.looks_ahead else levels


def _step_counts(info: dict[str, Any], outside: _Outside, claimed: np.ndarray, kept: np.ndarray) -> SafetyCounts:
    """Returns what one step adds to the counts."""
    return SafetyCounts(
        exits=int(np.count_nonzero(claimed & outside.safe_set)),
        violations=int(np.count_nonzero(claimed & outside.box)),
        interventions=int(np.count_nonzero(info["shield_intervened"])),
        unproved=int(np.count_nonzero(kept & ~info["shield_guaranteed"])),
        planned=int(np.count_nonzero(info.get("shield_plan_length", 0))),
        forced=int(np.count_nonzero(info["request_forced"])),
        lapsed=int(np.count_nonzero(~claimed)),
        lapsed_violations=int(np.count_nonzero(~claimed & outside.box)),
    )


def _begin(campaign: Campaign, shield: VectorSafetyShield, seed: int, rng: np.random.Generator) -> dict[str, Any]:
    """Starts the episodes of a batch, on the boundary of the safe set, and returns their infos.

    In mode "lookahead" half of the starts are drawn from the box; those for which no first plan is certified, of which
    nothing is claimed, are replaced by others on the boundary of the set that episodes start in.
    """
    plant, certificate, count = shield.filter.plant, shield.certificate, campaign.envs
    if not campaign.looks_ahead:
        polytope, env = certificate.polytope, shield.env.unwrapped
        assert isinstance(env, NCSVectorEnv)
        if polytope is None or env.single.downlink is not None:  # behind a downlink the first inputs are zero
            return shield.reset(seed=seed)[1]
        return shield.reset(seed=seed, options={"state": (1.0 - 1e-9) * polytope.sample_boundary(rng, count)})[1]
    _, info = shield.reset(seed=seed, options={"state": starts_in_box(rng, plant, certificate, count)})
    if not info["shield_guaranteed"].all():
        env = shield.env.unwrapped
        assert isinstance(env, NCSVectorEnv)
        states = (1.0 - 1e-9) * env.single.initial_set.sample_boundary(rng, count)
        _, info = shield.reset(options={"state": states, "reset_mask": ~info["shield_guaranteed"]})
    return info


@lru_cache(maxsize=1)  # a shield's tables may take a hundred megabytes
def _shields(campaign: Campaign, case: str, certificate: Certificate) -> dict[str, VectorSafetyShield]:
    """Returns the shields of all kinds of batches: those of S around the same environments, one for each mode.

    In mode "lookahead" disturbances push out of S in every other batch, and towards the box in between.

    Raises:
        CertificateError: If the certificate does not verify for the case's plant.
    """
    chosen = campaign.cases()[case]
    settings = {each.name: getattr(chosen, each.name) for each in fields(chosen)}
    kind = GaussianVectorEnv if campaign.gaussian else WorstCaseVectorEnv
    env = kind(campaign.envs, certificate, **settings)
    if campaign.looks_ahead:
        other = (
            env if campaign.gaussian else WorstCaseVectorEnv(campaign.envs, certificate, pushes_to_box=True, **settings)
        )
        envs = {"to the box": other, "out of S": env}
        planning = {"mode": "lookahead", "horizon": campaign.horizon, "on_unproved": "ignore"}
        return {name: VectorSafetyShield(each, certificate, **planning) for name, each in envs.items()}
    modes = (campaign.mode,) if campaign.mode else SHIELD_MODES if campaign.shielded else ("monitor",)
    return {mode: VectorSafetyShield(env, certificate, mode, on_unproved="ignore") for mode in modes}
