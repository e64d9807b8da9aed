"""Attacks on processes that are not linear: worst packets, sensor noise and starts, random and hostile agents."""

import pytest

from experiments.attack.attack_cases import attack_cases
from experiments.attack.monte_carlo_batch import MonteCarloBatch
from experiments.attack.safety_counts import SafetyCounts
from experiments.settings.certificates import AttackSettings
from ncs_gym.registration import EPISODE_STEPS, needing_extras
from tests.certificates import certificate_of

NAMES = ("Pendulum-v0", "CartPoleNonlinear-v0", "InvertedPendulum-v0")
# Kinds of packets: the longest gap each time, the oldest sample each time, and those of the environment's own channel.
KINDS = ("rare", "late", "its channel")
# More than 10^5 steps in three batches.
MANY = 168


def attacked(name, envs, kinds=KINDS, *, shielded=True):
    """Counts of one batch per kind of packets, each with another mode of the shield."""
    env_id = f"ncs_gym/{name}"
    if env_id in needing_extras():
        pytest.skip("the extra of this environment is not installed")
    campaign = AttackSettings(seed=1, random_plants=0, envs=envs, unshielded=not shielded, env=env_id)
    cases, total = attack_cases(0, 0, env_id), SafetyCounts()
    for index, kind in enumerate(kinds):
        case = cases[f"{env_id}, {kind}"]
        certificate = certificate_of(case.plant, case.contract)
        total += MonteCarloBatch(campaign, f"{env_id}, {kind}", index, certificate).execute(lambda steps: None)
    return total


def assert_safe(counts):
    assert counts.exits == counts.violations == counts.unproved == 0
    assert counts.interventions > 0
    assert counts.level > 0.8  # the attack comes close


def test_shielded_pendulum_never_leaves_the_safe_set_and_the_other_one_does():
    assert_safe(attacked("Pendulum-v0", 8, KINDS[:1]))
    counts = attacked("Pendulum-v0", 4, KINDS[:1], shielded=False)
    assert counts.violations > 0
    assert counts.broken_episodes == counts.episodes


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_shielded_process_never_leaves_the_safe_set_in_a_long_attack(name):
    counts = attacked(name, MANY)
    assert counts.steps == 3 * MANY * EPISODE_STEPS > 1e5
    assert_safe(counts)
    assert attacked(name, MANY, shielded=False).broken_episodes > 0
