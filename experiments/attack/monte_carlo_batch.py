"""A batch of episodes under attack; its counts are a pure function of its settings."""

from __future__ import annotations

import zlib
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from experiments.attack.attack_cases import attack_cases
from experiments.attack.safety_counts import SafetyCounts
from experiments.attack.worst_case import GaussianVectorEnv, HostileAgents, WorstCaseVectorEnv
from experiments.runs.provenance import json_digest, versions
from ncs_gym.registration import EPISODE_STEPS
from shields import Certificate, VectorSafetyShield

# Modes of the shield, one per batch in turn.
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
    """

    seed: int
    random_plants: int
    envs: int
    shielded: bool
    gaussian: bool = False
    delta: float | None = None
    env: str | None = None

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
    root = np.linalg.inv(np.linalg.cholesky(shield.certificate.L))
    seeds = np.random.SeedSequence([campaign.seed, zlib.crc32(batch.case.encode()), batch.index])
    seed, policy_seed = seeds.generate_state(2, np.uint64).tolist()
    _, info = shield.reset(seed=seed >> 1)
    rng = np.random.default_rng(policy_seed)
    agents = HostileAgents(campaign.envs, shield.filter.plant, shield.certificate, rng)
    exits = violations = interventions = 0
    unproved = campaign.envs - np.count_nonzero(info["shield_guaranteed"])
    broken, level = np.zeros(campaign.envs, np.bool_), 0.0
    for step in range(EPISODE_STEPS):
        *_, info = shield.step(agents.act(info["estimate"]))
        squares = np.square(root @ info["state"].T).sum(axis=0)
        outside_set, outside_box = ~(squares <= 1.0), info["cost"] != 0.0
        exits += np.count_nonzero(outside_set)
        violations += np.count_nonzero(outside_box)
        interventions += np.count_nonzero(info["shield_intervened"])
        unproved += campaign.envs - np.count_nonzero(info["shield_guaranteed"])
        broken |= outside_set | outside_box
        if step >= SETTLING_STEPS:
            level = max(level, float(np.nan_to_num(squares, nan=np.inf).max()))
    return SafetyCounts(
        steps=campaign.batch_steps,
        episodes=campaign.envs,
        exits=int(exits),
        violations=int(violations),
        broken_episodes=int(broken.sum()),
        interventions=int(interventions),
        unproved=int(unproved),
        level=level**0.5,
    )


@lru_cache(maxsize=1)  # a shield's tables may take a hundred megabytes
def _shields(campaign: Campaign, case: str, certificate: Path) -> dict[str, VectorSafetyShield]:
    """Returns the shields of all modes around the same environments.

    Raises:
        CertificateError: If the certificate is damaged or does not verify for the case's plant.
    """
    cases = attack_cases(campaign.seed, campaign.random_plants, campaign.env)
    chosen, loaded = cases[case].with_delta(campaign.delta), Certificate.load(certificate)
    settings = {"plant": chosen.plant, "channel": chosen.channel, "contract": chosen.contract}
    kind = GaussianVectorEnv if campaign.gaussian else WorstCaseVectorEnv
    env = kind(campaign.envs, loaded, **settings)
    modes = SHIELD_MODES if campaign.shielded else ("monitor",)
    return {mode: VectorSafetyShield(env, loaded, mode) for mode in modes}
