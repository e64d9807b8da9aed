"""Attacks on the certificates of published plants, by the batches of `ncs attack --plant`."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory

from experiments.attack.monte_carlo_batch import MonteCarloBatch, cases_of
from experiments.attack.safety_counts import SafetyCounts
from experiments.settings import AttackSettings
from ncs_gym import LinearPlant
from shields import Certificate

_EPISODES = 200


def attack(plant: LinearPlant, certificate: Certificate, steps: int) -> SafetyCounts:
    """Returns what at least so many attacked steps of a plant behind its shield found.

    Channels use up the contract of the certificate, by delays, by losses and by samples that nobody asks for.
    """
    assert certificate.contract is not None
    with TemporaryDirectory() as folder:
        file = Path(folder) / "plant.json"
        plant.save(file)
        settings = AttackSettings(plant=file, max_age=certificate.contract.max_age, envs=_EPISODES)
        counts, cases = SafetyCounts(), cases_of(settings)
        for number, case in enumerate(cycle(cases)):
            if counts.steps >= steps:
                return counts
            batch = MonteCarloBatch(settings, case, number // len(cases), certificate)
            counts += batch.execute(lambda count: None)
    raise AssertionError  # the cases go around for ever
