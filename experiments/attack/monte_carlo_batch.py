"""A batch of episodes under attack; its counts are a pure function of its settings."""

from __future__ import annotations

import zlib
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments.attack.attack_cases import attack_cases
from experiments.attack.safety_counts import SafetyCounts
from experiments.attack.worst_case import GaussianVectorEnv, HostileAgents, WorstCaseVectorEnv, starts_in_box
from experiments.runs.provenance import json_digest, versions
from ncs_gym import NCSVectorEnv
from ncs_gym.registration import EPISODE_STEPS
from shields import Certificate, VectorSafetyShield

# Modes of the shield, one per batch in turn, where none is chosen.
SHIELD_MODES = ("project", "switch", "boundary")
# Episodes start on the boundary of S; the largest level is taken from this step on.
SETTLING_STEPS = 20


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """Settings that all batches share.

    Attributes:
        seed: Seed of the campaign; all batches derive their seeds from it.
        random_plants: Number of random plants.
        envs: Number of environments in a batch, each of which runs one episode.
        shielded: Whether the shield acts; otherwise it only watches.
        gaussian: Whether noise is Gaussian, without a bound; otherwise it is the worst within the bounds.
        delta: Replaces the plants' own level at which Gaussian noise is inside the bounds; None keeps it.
        env: Id, or "module:id", of the only environment to attack; None for all.
        mode: Only mode of the shield; None for `SHIELD_MODES`.
        horizon: Longest plan of mode "lookahead" [steps]; None in other modes.
    """

    seed: int
    random_plants: int
    envs: int
    shielded: bool
    gaussian: bool = False
    delta: float | None = None
    env: str | None = None
    mode: str | None = None
    horizon: int | None = None

    @property
    def looks_ahead(self) -> bool:
        """Whether the shield is that of mode "lookahead", whose claim is the safe box."""
        return self.mode == "lookahead"

    @property
    def kinds_of_batches(self) -> int:
        """Number of kinds of batches, which take turns."""
        if self.looks_ahead:
            return 2
        return len(SHIELD_MODES) if self.shielded and self.mode is None else 1

    @property
    def key(self) -> str:
        """SHA-256 of everything that the counts depend on except the certificates and the channels."""
        given = {name: value for name, value in asdict(self).items() if value is not None}
        return json_digest(given | {"versions": versions()})

    @property
    def batch_steps(self) -> int:
        """Number of steps in a batch."""
        return self.envs * EPISODE_STEPS


@dataclass(frozen=True)
class MonteCarloBatch:
    """A batch of episodes of one attack case.

    Attributes:
        case: Name of the attack case.
        index: Number of the batch within its case, from 0 on.
    """

    case: str
    index: int


def run_batch(campaign: Campaign, batch: MonteCarloBatch, certificate: Path) -> SafetyCounts:
    """Returns the counts of a batch, the same in any process and after any other batch.

    Args:
        campaign: Settings of the campaign.
        batch: The batch.
        certificate: File with the certificate of the batch's case.

    Raises:
        CertificateError: If the certificate is damaged or does not verify for the case's plant.
    """
    shields = list(_shields(campaign, batch.case, certificate).values())
    shield = shields[batch.index % len(shields)]
    plant = shield.filter.plant
    root = np.linalg.inv(np.linalg.cholesky(shield.certificate.L))
    seeds = np.random.SeedSequence([campaign.seed, zlib.crc32(batch.case.encode()), batch.index])
    seed, policy_seed = seeds.generate_state(2, np.uint64).tolist()
    rng = np.random.default_rng(policy_seed)
    info = _begin(campaign, shield, seed >> 1, rng)
    agents = HostileAgents(campaign.envs, plant, shield.certificate, rng)
    outside_starts = np.count_nonzero(_squares(root, info) > 1.0)
    exits = violations = interventions = planned = 0
    unproved = campaign.envs - np.count_nonzero(info["shield_guaranteed"])
    broken, level = np.zeros(campaign.envs, np.bool_), 0.0
    for step in range(EPISODE_STEPS):
        *_, info = shield.step(agents.act(info["estimate"]))
        squares = _squares(root, info)
        outside_set, outside_box = ~(squares <= 1.0), info["cost"] != 0.0
        exits += np.count_nonzero(outside_set)
        violations += np.count_nonzero(outside_box)
        interventions += np.count_nonzero(info["shield_intervened"])
        unproved += campaign.envs - np.count_nonzero(info["shield_guaranteed"])
        planned += np.count_nonzero(info.get("shield_plan_length", 0))
        broken |= outside_box | (outside_set & (not campaign.looks_ahead))
        if step >= SETTLING_STEPS:
            reached = info["constraint_values"] + 1.0 if campaign.looks_ahead else np.sqrt(squares)
            level = max(level, float(np.nan_to_num(reached, nan=np.inf).max()))
    return SafetyCounts(
        steps=campaign.batch_steps,
        episodes=campaign.envs,
        exits=int(exits),
        violations=int(violations),
        broken_episodes=int(broken.sum()),
        interventions=int(interventions),
        unproved=int(unproved),
        level=level,
        planned=int(planned),
        outside_starts=int(outside_starts),
    )


def _begin(campaign: Campaign, shield: VectorSafetyShield, seed: int, rng: np.random.Generator) -> dict[str, Any]:
    """Starts the episodes of a batch and returns their infos.

    In mode "lookahead" half of the starts are drawn from the box; those for which no first plan is certified, of which
    nothing is claimed, are replaced by others on the boundary of the set that episodes start in.
    """
    if not campaign.looks_ahead:
        return shield.reset(seed=seed)[1]
    plant, certificate, count = shield.filter.plant, shield.certificate, campaign.envs
    _, info = shield.reset(seed=seed, options={"state": starts_in_box(rng, plant, certificate, count)})
    if not info["shield_guaranteed"].all():
        env = shield.env.unwrapped
        assert isinstance(env, NCSVectorEnv)
        states = (1.0 - 1e-9) * env.single.initial_set.sample_boundary(rng, count)
        _, info = shield.reset(options={"state": states, "reset_mask": ~info["shield_guaranteed"]})
    return info


def _squares(root: np.ndarray, info: dict[str, Any]) -> np.ndarray:
    """Returns x'Mx of the true states, shape (N,)."""
    return np.square(root @ info["state"].T).sum(axis=0)


@lru_cache(maxsize=1)  # a shield's tables may take a hundred megabytes
def _shields(campaign: Campaign, case: str, certificate: Path) -> dict[str, VectorSafetyShield]:
    """Returns the shields of all kinds of batches: those of S around the same environments, one for each mode.

    In mode "lookahead" disturbances push out of S in every other batch, and towards the box in between.

    Raises:
        CertificateError: If the certificate is damaged or does not verify for the case's plant.
    """
    cases = attack_cases(campaign.seed, campaign.random_plants, campaign.env)
    chosen, loaded = cases[case].with_delta(campaign.delta), Certificate.load(certificate)
    settings = {name: getattr(chosen, name) for name in ("plant", "channel", "contract", "process", "downlink")}
    kind = GaussianVectorEnv if campaign.gaussian else WorstCaseVectorEnv
    env = kind(campaign.envs, loaded, **settings)
    if campaign.looks_ahead:
        other = env if campaign.gaussian else WorstCaseVectorEnv(campaign.envs, loaded, pushes_to_box=True, **settings)
        envs = {"to the box": other, "out of S": env}
        return {
            name: VectorSafetyShield(each, loaded, "lookahead", horizon=campaign.horizon) for name, each in envs.items()
        }
    modes = (campaign.mode,) if campaign.mode else SHIELD_MODES if campaign.shielded else ("monitor",)
    return {mode: VectorSafetyShield(env, loaded, mode) for mode in modes}
