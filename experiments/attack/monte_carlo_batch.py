"""A block of episodes under attack: a pure function of its settings."""

from __future__ import annotations

import hashlib
import json
import zlib
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from experiments.attack.attack_cases import cases
from experiments.attack.safety_counts import Tally
from experiments.attack.worst_case import HostileAgents, WorstCaseVectorEnv
from experiments.runs.provenance import versions
from ncs_gym.registration import EPISODE_STEPS
from shields import Certificate, VectorSafetyShield

# Modes of the shield, in turn.
MODES = ("project", "switch", "boundary")
# Episodes start on the boundary of S; the level counts from this step on.
SETTLED = 20


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """What all blocks share.

    Attributes:
        seed: All blocks derive theirs from it.
        random_plants: How many.
        envs: Environments of a block, an episode each.
        shielded: Whether the shield acts; otherwise it only watches.
    """

    seed: int
    random_plants: int
    envs: int
    shielded: bool

    @property
    def key(self) -> str:
        """A digest of everything that results depend on but the certificates."""
        content = json.dumps(asdict(self) | {"versions": versions()}, sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()

    @property
    def block_steps(self) -> int:
        """Steps of a block."""
        return self.envs * EPISODE_STEPS


@dataclass(frozen=True)
class Block:
    """Episodes of one case.

    Attributes:
        case: Name of the case.
        index: From 0 on.
    """

    case: str
    index: int


@lru_cache(maxsize=1)  # a gain table may hold a hundred megabytes
def _shields(campaign: Campaign, case: str, certificate: Path) -> dict[str, VectorSafetyShield]:
    """Returns the shields of all modes around the same worst-case environments.

    Raises:
        CertificateError: If the certificate is damaged or does not verify for the case's plant.
    """
    chosen, loaded = cases(campaign.seed, campaign.random_plants)[case], Certificate.load(certificate)
    settings = {"plant": chosen.plant, "channel": chosen.channel, "contract": chosen.contract}
    env = WorstCaseVectorEnv(campaign.envs, loaded, **settings)
    modes = MODES if campaign.shielded else ("monitor",)
    return {mode: VectorSafetyShield(env, loaded, mode) for mode in modes}


def run_block(campaign: Campaign, block: Block, certificate: Path) -> Tally:
    """Returns the tally of a block, the same in any process and after any other block.

    Args:
        campaign: What all blocks share.
        block: Which one.
        certificate: File with the case's certificate.

    Raises:
        CertificateError: If the certificate is damaged or does not verify for the case's plant.
    """
    shields = list(_shields(campaign, block.case, certificate).values())
    shield = shields[block.index % len(shields)]
    plan = shield.certificate
    root = np.linalg.inv(np.linalg.cholesky(plan.L))
    seeds = np.random.SeedSequence([campaign.seed, zlib.crc32(block.case.encode()), block.index])
    seed, policy_seed = seeds.generate_state(2, np.uint64).tolist()
    _, info = shield.reset(seed=seed >> 1)
    agents = HostileAgents(campaign.envs, shield.filter.plant, plan, np.random.default_rng(policy_seed))
    exits = violations = interventions = 0
    unproved = campaign.envs - np.count_nonzero(info["shield_guaranteed"])
    broken, level = np.zeros(campaign.envs, np.bool_), 0.0
    for step in range(EPISODE_STEPS):
        *_, info = shield.step(agents.act(info["estimate"]))
        squares = np.square(root @ info["state"].T).sum(axis=0)
        outside, beyond = ~(squares <= 1.0), info["cost"] != 0.0
        exits += np.count_nonzero(outside)
        violations += np.count_nonzero(beyond)
        interventions += np.count_nonzero(info["shield_intervened"])
        unproved += campaign.envs - np.count_nonzero(info["shield_guaranteed"])
        broken |= outside | beyond
        if step >= SETTLED:
            level = max(level, float(np.nan_to_num(squares, nan=np.inf).max()))
    return Tally(
        steps=campaign.block_steps,
        episodes=campaign.envs,
        exits=int(exits),
        violations=int(violations),
        broken_episodes=int(broken.sum()),
        interventions=int(interventions),
        unproved=int(unproved),
        level=level**0.5,
    )
