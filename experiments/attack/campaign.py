"""Settings that all batches of a campaign share, and what they attack."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from experiments.attack.attack_cases import AttackCase, attack_cases, plant_cases
from experiments.runs.provenance import versions
from ncs_gym import ChannelContract
from ncs_gym.registration import EPISODE_STEPS
from shields.json_documents import digest

# Modes of the shield, one per batch in turn, where none is chosen.
SHIELD_MODES = ("project", "switch", "boundary")


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
        plant: File of the only plant to attack, in place of environments; None for none.
        contract: Channel contract of the plant of the file; None for none.
        mode: Only mode of the shield; None for `SHIELD_MODES`.
        safe_set: Kind of safe set of the certificates; see `shields.synthesize`.
        horizon: Longest plan of mode "lookahead" [steps]; None in other modes.
    """

    seed: int
    random_plants: int
    envs: int
    shielded: bool
    gaussian: bool = False
    delta: float | None = None
    env: str | None = None
    plant: str | None = None
    contract: ChannelContract | None = None
    mode: str | None = None
    safe_set: str | None = None
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
        """SHA-256 of everything that the counts depend on except certificates, plants and channels."""
        given = {name: value for name, value in asdict(self).items() if value is not None and name != "plant"}
        return digest(given | {"versions": versions()})

    @property
    def batch_steps(self) -> int:
        """Number of steps in a batch."""
        return self.envs * EPISODE_STEPS

    def cases(self) -> dict[str, AttackCase]:
        """Returns what is attacked, by name.

        Raises:
            ValueError: If there is no environment of the id, or the plant's file cannot be read.
        """
        if self.plant is None:
            found = attack_cases(self.seed, self.random_plants, self.env)
        else:
            found = plant_cases(Path(self.plant), self.contract)
        return {name: case.with_delta(self.delta) for name, case in found.items()}
