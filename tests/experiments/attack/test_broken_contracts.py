"""Where a channel breaks its contract nothing is claimed; what happens then is counted, and is no failure."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from experiments.attack.attack_cases import attack_cases
from experiments.attack.monte_carlo_batch import MonteCarloBatch
from experiments.commands.attack import attack
from experiments.settings.certificates import AttackSettings
from ncs_gym import Channel
from shields import VectorSafetyShield
from tests.certificates import certificate_of
from tests.workers import replace_cases

NAME = "BatchReactor-v0, late"
CAMPAIGN = AttackSettings(seed=0, random_plants=0, envs=16)


@pytest.fixture
def attacked(monkeypatch, tmp_path):
    """Counts of a batch behind a channel that replaces the one that keeps the contract of the batch reactor."""
    folders = count()  # shields are prepared once for settings and the name of a case

    def counts_behind(channel, campaign=CAMPAIGN, **changes):
        case = replace(attack_cases(0, 0)[NAME], channel=channel, **changes)
        replace_cases(monkeypatch, {NAME: case})
        certificate = certificate_of(case.plant, case.certificate_contract)
        return MonteCarloBatch(replace(campaign, out=tmp_path / str(next(folders))), NAME, 0, certificate).execute(
            lambda steps: None
        )

    return counts_behind


@pytest.mark.slow
def test_what_comes_after_a_broken_contract_is_counted_apart(attacked):
    counts = attacked(Channel(loss=0.3, quantization_step=1e-3))
    assert (counts.exits, counts.violations, counts.broken_episodes, counts.unproved) == (0, 0, 0, 0)
    assert 0 < counts.lapsed < counts.steps
    assert 0.9 < counts.level <= 1.0


@pytest.mark.slow
def test_states_outside_after_a_broken_contract_are_no_failure_and_not_hidden(attacked):
    counts = attacked(Channel(loss=1.0, quantization_step=1e-3))
    assert (counts.exits, counts.violations, counts.broken_episodes, counts.unproved) == (0, 0, 0, 0)
    assert counts.lapsed > 0.9 * counts.steps
    assert counts.lapsed_violations > 1000
    assert counts.level == 0.0  # nothing was claimed that late
    watched = attacked(Channel(loss=1.0, quantization_step=1e-3), replace(CAMPAIGN, unshielded=True))
    assert (watched.lapsed, watched.lapsed_violations) == (0, 0)
    assert watched.violations > 1000
    assert watched.broken_episodes == watched.episodes


def test_a_channel_that_keeps_its_contract_has_no_lapsed_step(attacked):
    counts = attacked(attack_cases(0, 0)[NAME].channel)
    assert (counts.lapsed, counts.lapsed_violations, counts.unproved) == (0, 0, 0)


def test_a_downlink_that_breaks_its_contract_is_counted_apart(attacked):
    case = attack_cases(0, 0)["CartPoleTwoWay-v0, its channel"]
    promised = case.downlink_contract
    assert promised is not None
    counts = attacked(**{**vars(case), "downlink": Channel(loss=0.4, delay=1)})
    assert (counts.exits, counts.violations, counts.broken_episodes, counts.unproved) == (0, 0, 0, 0)
    assert 0 < counts.lapsed < counts.steps


STEPS, BREAKS, AGAIN = 200, 50, 80


@pytest.mark.cases(1)
@pytest.mark.parametrize(
    ("broken", "is_proved", "lapsed", "unproved"),
    [
        # The state after the step was decided while the contract of the samples was kept.
        ("contract_broken", lambda step: step < BREAKS or step >= AGAIN, AGAIN - BREAKS - 1, 0),
        ("downlink_broken", lambda step: step < BREAKS or step >= AGAIN, AGAIN - BREAKS, 0),
        ("contract_broken", lambda step: True, 0, 0),
        (None, lambda step: step < BREAKS, 0, STEPS - BREAKS),  # a proof lost for no reason is not believed
    ],
)
def test_what_is_claimed_after_a_step_that_breaks_a_contract(
    attacked, monkeypatch, broken, is_proved, lapsed, unproved
):
    step, taken = VectorSafetyShield.step, count()

    def scripted(self, actions):
        *rest, found = step(self, actions)
        at, everywhere = next(taken), np.ones(16, np.bool_)
        said = {"contract_broken": ~everywhere, "downlink_broken": ~everywhere}
        said |= {"shield_guaranteed": everywhere & is_proved(at)} | ({broken: everywhere} if at == BREAKS else {})
        return *rest, found | {key: value for key, value in said.items() if key}

    monkeypatch.setattr(VectorSafetyShield, "step", scripted)
    counts = attacked(attack_cases(0, 0)[NAME].channel)
    assert (counts.lapsed, counts.unproved) == (16 * lapsed, 16 * unproved)


def test_a_shield_that_claims_too_much_after_a_broken_contract_is_found_out(attacked, monkeypatch):
    step = VectorSafetyShield.step

    def boasting(self, actions):
        *rest, found = step(self, actions)
        return *rest, found | {"shield_guaranteed": np.ones(16, np.bool_)}

    monkeypatch.setattr(VectorSafetyShield, "step", boasting)
    counts = attacked(Channel(loss=1.0, quantization_step=1e-3))
    assert counts.violations > 1000
    assert counts.broken_episodes > 0
    assert counts.lapsed == 0


def test_a_downlink_without_a_contract_is_refused(monkeypatch, tmp_path):
    case = replace(attack_cases(0, 0)[NAME], downlink=Channel(loss=0.3))
    replace_cases(monkeypatch, {NAME: case})
    with pytest.raises(ValueError, match="BatchReactor-v0, late: nothing is claimed behind a downlink without a contr"):
        attack(AttackSettings(out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
