"""The Monte Carlo campaign behind `ncs attack`: worst-case disturbances and hostile agents against shielded loops."""

from experiments.attack.attack_cases import AttackCase
from experiments.attack.campaign import Campaign
from experiments.attack.monte_carlo_batch import MonteCarloBatch
from experiments.attack.safety_counts import SafetyCounts

__all__ = ["AttackCase", "Campaign", "MonteCarloBatch", "SafetyCounts"]
