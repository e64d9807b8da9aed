"""A batch of episodes under attack; its counts are a pure function of its settings."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments.attack.attack_cases import AttackCase, attack_cases, plant_cases
from experiments.attack.safety_counts import SETTLING_STEPS, SafetyCounts
from experiments.attack.worst_case import (
    GaussianVectorEnv,
    HostileAgents,
    HostileRequests,
    WorstCaseVectorEnv,
    starts_in_box,
    starts_in_set,
)
from experiments.runs.provenance import versions
from experiments.settings import AttackSettings, BackendSettings
from experiments.settings.certificates import changed_contract
from ncs_gym import NCSVectorEnv
from ncs_gym.registration import EPISODE_STEPS
from shields import Certificate, VectorSafetyShield
from shields.json_documents import digest

# Modes of the shield, one per batch in turn, where none is chosen.
_SHIELD_MODES = ("project", "switch", "boundary")
# Settings that the counts of a batch do not depend on; the plant of a file is known by its certificate.
_NOT_COUNTED = {*BackendSettings.__dataclass_fields__, "steps", "out", "force", "plant", "smoke"}


def cases_of(settings: AttackSettings) -> dict[str, AttackCase]:
    """Returns what is attacked, by name; raises ValueError if there is no such environment, plant or channel."""
    if settings.plant is None:
        found = attack_cases(settings.seed, settings.random_plants, settings.env)
    else:
        found = plant_cases(settings.plant, changed_contract(None, settings.max_age, settings.quantization_step))
    kinds = {name: name.rpartition(", ")[2] for name in found}
    if settings.channel is not None:
        if settings.channel not in kinds.values():
            raise ValueError(f"channel must be one of {sorted(set(kinds.values()))}, got {settings.channel!r}")
        found = {name: case for name, case in found.items() if kinds[name] == settings.channel}
    return {name: case.with_delta(settings.delta) for name, case in found.items()}


def kinds_of_batches(settings: AttackSettings) -> tuple[str, ...]:
    """Returns the kinds of batches, which take turns: modes of the shield, or where nature pushes "lookahead"."""
    if settings.mode == "lookahead":
        return ("to the box", "out of S")
    return ("monitor",) if settings.unshielded else (settings.mode,) if settings.mode else _SHIELD_MODES


@dataclass(frozen=True)
class MonteCarloBatch:
    """A batch of episodes of one attack case, a run like any other.

    Attributes:
        settings: Settings of the attack.
        case: Name of the attack case.
        index: Number of the batch within its case, from 0 on.
        certificate: Certificate of the case.
    """

    settings: AttackSettings
    case: str
    index: int
    certificate: Certificate

    parts = ("attack",)
    unit = "step"
    result_type = SafetyCounts
    leaves = ()

    @property
    def name(self) -> str:
        """Name of the batch in messages and, with hyphens, of its file."""
        return f"{self.case}-{self.index}"

    @property
    def key(self) -> str:
        """SHA-256 of everything that the counts depend on: settings, the case and versions of packages."""
        attacked = cases_of(self.settings)[self.case]
        channels = f"{attacked.channel} {attacked.downlink}"  # what a module registers may change
        settings = {name: value for name, value in vars(self.settings).items() if name not in _NOT_COUNTED}
        return digest([settings, versions(), self.case, self.index, self.certificate.checksum, channels])

    @property
    def total_steps(self) -> int:
        """Number of steps in the batch."""
        return self.settings.envs * EPISODE_STEPS

    def execute(self, on_progress: Callable[[int], None], log_folder: Path | None = None) -> SafetyCounts:
        """Returns the counts, the same in any process and after any other batch.

        Raises:
            CertificateError: If the certificate does not verify for the case's plant.
        """
        settings, envs, looks_ahead = self.settings, self.settings.envs, self.settings.mode == "lookahead"
        kinds = kinds_of_batches(settings)
        shield = _shields(settings, self.case, self.certificate)[kinds[self.index % len(kinds)]]
        plant, safe_set = shield.filter.plant, shield.filter.certificate.safe_set
        seeds = np.random.SeedSequence([settings.seed, zlib.crc32(self.case.encode()), self.index])
        seed, policy_seed = seeds.generate_state(2, np.uint64).tolist()
        rng = np.random.default_rng(policy_seed)
        info = _begin(settings, shield, seed >> 1, rng)
        agents = HostileAgents(envs, plant, shield.certificate, rng)
        attacked, env = cases_of(settings)[self.case], shield.env.unwrapped
        assert isinstance(env, NCSVectorEnv)
        requests = HostileRequests(envs, shield.certificate, rng) if attacked.channel.on_request else None
        counts = SafetyCounts(
            steps=self.total_steps,
            episodes=envs,
            unproved=int(np.count_nonzero(~info["shield_guaranteed"])),
            outside_starts=int(np.count_nonzero(safe_set.gauge(info["state"]) > 1.0)),
        )
        kept, broken = np.ones(envs, np.bool_), np.zeros(envs, np.bool_)
        for step in range(EPISODE_STEPS):
            if requests is not None:
                env.request(requests.ask(info))
            *_, info = shield.step(agents.act(info["estimate"]))
            claimed, kept = _claimed_and_kept(info, kept)
            if settings.unshielded:  # nothing is claimed, and everything counted
                claimed[:] = True
            levels, outside_box = safe_set.gauge(info["state"]), info["cost"] != 0.0
            outside_set = ~(levels <= 1.0)
            reached = info["constraint_values"].max(axis=1) + 1.0 if looks_ahead else levels  # the claim limits it to 1
            counts += SafetyCounts(
                exits=int(np.count_nonzero(claimed & outside_set)),
                violations=int(np.count_nonzero(claimed & outside_box)),
                interventions=int(np.count_nonzero(info["shield_intervened"])),
                unproved=int(np.count_nonzero(kept & ~info["shield_guaranteed"])),
                planned=int(np.count_nonzero(info.get("shield_plan_length", 0))),
                forced=int(np.count_nonzero(info["request_forced"])),
                overdue=int(attacked.keeps_contract * np.count_nonzero(info["contract_broken"])),
                lapsed=int(np.count_nonzero(~claimed)),
                lapsed_violations=int(np.count_nonzero(~claimed & outside_box)),
            )
            broken |= claimed & (outside_box | (outside_set & (not looks_ahead)))
            if step >= SETTLING_STEPS:
                level = float(np.nan_to_num(reached, nan=np.inf).max(initial=0.0, where=claimed))
                counts += SafetyCounts(level=level)
            on_progress(envs)
        return counts + SafetyCounts(broken_episodes=int(broken.sum()), packets=int(info["packets"].sum()))


def _claimed_and_kept(info: dict[str, Any], kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns of which states safety is claimed now, and in which episodes all contracts were kept so far.

    The present state is the result of an earlier decision: it does not rest on the age of the newest sample now, but on
    the input that the actuator applied. After a broken contract what the shield says itself is claimed.
    """
    kept = kept & ~info["downlink_broken"]
    return kept | info["shield_guaranteed"], kept & ~info["contract_broken"]


def _begin(settings: AttackSettings, shield: VectorSafetyShield, seed: int, rng: np.random.Generator) -> dict[str, Any]:
    """Starts the episodes of a batch, on the boundary of the safe set, and returns their infos.

    In mode "lookahead" half of the starts are drawn from the box; those for which no first plan is certified, of which
    nothing is claimed, are replaced by others on the boundary of the set that episodes start in.
    """
    plant, certificate, count = shield.filter.plant, shield.certificate, settings.envs
    if settings.mode != "lookahead":
        polytope, env = certificate.polytope, shield.env.unwrapped
        assert isinstance(env, NCSVectorEnv)
        if polytope is None or env.single.downlink is not None:  # behind a downlink the first inputs are zero
            return shield.reset(seed=seed)[1]
        return shield.reset(seed=seed, options={"state": starts_in_set(rng, certificate, count)})[1]
    _, info = shield.reset(seed=seed, options={"state": starts_in_box(rng, plant, certificate, count)})
    if not info["shield_guaranteed"].all():
        env = shield.env.unwrapped
        assert isinstance(env, NCSVectorEnv)
        states = (1.0 - 1e-9) * env.single.initial_set.sample_boundary(rng, count)
        _, info = shield.reset(options={"state": states, "reset_mask": ~info["shield_guaranteed"]})
    return info


@lru_cache(maxsize=1)  # a shield's tables may take a hundred megabytes
def _shields(settings: AttackSettings, case: str, certificate: Certificate) -> dict[str, VectorSafetyShield]:
    """Returns the shields of all kinds of batches, around the same environments where nature is the same."""
    attacked = vars(cases_of(settings)[case])
    is_gaussian, kinds = settings.noise == "gaussian", kinds_of_batches(settings)
    env = (GaussianVectorEnv if is_gaussian else WorstCaseVectorEnv)(settings.envs, certificate, **attacked)
    if settings.mode != "lookahead":
        return {mode: VectorSafetyShield(env, certificate, mode, on_unproved="ignore") for mode in kinds}
    other = env if is_gaussian else WorstCaseVectorEnv(settings.envs, certificate, pushes_to_box=True, **attacked)
    planning = {"mode": "lookahead", "horizon": settings.horizon, "on_unproved": "ignore"}
    shields = (VectorSafetyShield(each, certificate, **planning) for each in (other, env))
    return dict(zip(kinds, shields, strict=True))
