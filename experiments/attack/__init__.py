"""The Monte Carlo campaign behind `ncs certify`: worst-case disturbances and hostile agents against shielded loops."""

from experiments.attack.attack_cases import AttackCase, attack_cases
from experiments.attack.monte_carlo_batch import Campaign, MonteCarloBatch, run_batch
from experiments.attack.safety_counts import SafetyCounts

__all__ = ["AttackCase", "Campaign", "MonteCarloBatch", "SafetyCounts", "attack_cases", "run_batch"]
