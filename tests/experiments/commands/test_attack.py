"""The campaign behind `ncs attack`: exact under any split, resumable, and able to see a failure."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.attack.attack_cases import AttackCase, attack_cases
from experiments.attack.monte_carlo_batch import MonteCarloBatch, cases_of, kinds_of_batches
from experiments.attack.safety_counts import SafetyCounts, gaussian_table, require_safe, require_within
from experiments.attack.worst_case import GaussianVectorEnv, HostileRequests, WorstCaseVectorEnv
from experiments.commands import attack as command
from experiments.commands.attack import attack, shortened
from experiments.errors import RunError, SafetyBroken
from experiments.settings.certificates import AttackSettings
from ncs_gym import truck_trailer
from ncs_gym.network import requests
from ncs_gym.network.contract import contract_of
from ncs_gym.network.requests import spare_samples
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from shields import Certificate, VectorSafetyShield
from shields import certify as smaller_set
from tests.certificates import certificate_of
from tests.command import ATTACK, killed, ncs
from tests.workers import no_worker_processes, replace_cases

CAMPAIGN = AttackSettings(seed=0, random_plants=1, envs=32)
CRUISE, OTHER = "TruckTrailerCruise-v0, overtaking", "CartPole-v0, rare"


def certificate_for_case(name, delta=None):
    case = attack_cases(0, 1)[name].with_delta(delta)
    return certificate_of(case.plant, case.certificate_contract, "polytope")


def counts_of(campaign, case, index=0, certificate=None):
    certificate = certificate or certificate_for_case(case, campaign.delta)
    return MonteCarloBatch(campaign, case, index, certificate).execute(lambda steps: None)


def test_every_kind_of_plant_and_channel_is_attacked():
    found = attack_cases(3, 5)
    assert len(found) == 3 * 1 + 9 * 4 + (2 + 5) * 4
    assert {case.contract is None for case in found.values()} == {True, False}
    assert (
        attack_cases(3, 5)["random plant 4, perfect"].plant.fingerprint
        == found["random plant 4, bursts"].plant.fingerprint
    )
    others = attack_cases(4, 5)["random plant 4, perfect"].plant.fingerprint
    assert others != found["random plant 4, perfect"].plant.fingerprint


def test_contracts_are_used_up():
    found = attack_cases(0, 0)
    for name in ("CartPole-v0", "BatchReactor-v0"):
        for kind in ("late", "rare"):
            case = found[f"{name}, {kind}"]
            assert contract_of(case.channel) == case.contract


@pytest.mark.slow
def test_batch_has_the_same_counts_after_any_other():
    batches = [(CRUISE, 0), (CRUISE, 1), (OTHER, 2)]
    first = [counts_of(CAMPAIGN, *each) for each in batches]
    assert first == [counts_of(CAMPAIGN, *each) for each in reversed(batches)][::-1]
    assert first[0] != first[1]
    total = sum(first, SafetyCounts())
    assert (total.steps, total.episodes) == (3 * 32 * 200, 96)
    assert (total.exits, total.violations, total.broken_episodes, total.unproved) == (0, 0, 0, 0)
    assert 0 < total.interventions < total.steps
    assert 0.99 < total.level <= 1.0


ON_REQUEST = "CartPole-v0, on request"


def test_hostile_requests_keep_the_contract_and_the_safe_set():
    counts = counts_of(CAMPAIGN, ON_REQUEST)
    assert 0 < counts.forced < counts.packets < counts.steps
    assert (counts.overdue, counts.lapsed, counts.exits, counts.violations, counts.unproved) == (0, 0, 0, 0, 0)
    require_safe(counts, looks_ahead=False)


# Shields are prepared once for settings and a case: a folder of their own gives tests that change something new ones.
CHANGED = replace(CAMPAIGN, out=Path("changed"))


def test_requests_that_are_forced_too_late_are_counted(monkeypatch):
    monkeypatch.setattr(requests, "spare_samples", lambda *given: 1 + spare_samples(*given))
    counts = counts_of(CHANGED, ON_REQUEST)
    assert counts.overdue > 100
    with pytest.raises(SafetyBroken, match="older than a contract"):
        require_safe(counts, looks_ahead=False)


def test_hostile_requests_follow_the_truth():
    M = truck_trailer().weight
    policy = HostileRequests(8, SimpleNamespace(M=M), np.random.default_rng(0))
    sizes = np.repeat([[1e-3], [1.0]], 4, axis=0) * np.ones(2)  # small in the first four environments
    asked = policy.ask({"estimation_error": sizes, "state": 10.0 * sizes})
    assert asked[[0, 4]].tolist() == [False, False]
    assert asked[[2, 6]].tolist() == asked[[3, 7]].tolist() == [True, False]


def test_one_kind_of_channel_alone_is_attacked():
    found = cases_of(replace(CAMPAIGN, channel="on request"))
    assert ON_REQUEST in found
    assert all(case.channel.on_request for case in found.values())
    assert all(contract_of(case.channel).max_age <= case.contract.max_age for case in found.values())


def test_without_the_shield_the_attack_breaks_out_and_is_counted():
    counts = counts_of(replace(CAMPAIGN, unshielded=True), CRUISE)
    assert min(counts.exits, counts.violations) > 1000
    assert counts.broken_episodes > 16
    assert counts.level > 1.5
    assert counts.unproved > 0
    assert counts.margin < 0.0


LOOKAHEAD = replace(CAMPAIGN, mode="lookahead", horizon=6)


def test_lookahead_is_attacked_in_and_outside_the_safe_set_and_keeps_the_box():
    ellipsoid = certificate_for_case(OTHER).without_polytope()  # so that many states are outside the safe set
    total = sum((counts_of(LOOKAHEAD, OTHER, index, ellipsoid) for index in (0, 1)), SafetyCounts())
    assert (total.steps, total.episodes) == (2 * 32 * 200, 64)
    assert (total.violations, total.broken_episodes, total.unproved) == (0, 0, 0)
    assert 0.98 < total.level <= 1.0
    assert total.exits > 0.5 * total.steps
    assert 0 < total.outside_starts < 32
    assert total.exits < total.planned < total.steps
    assert total.interventions > 0


@pytest.mark.slow
def test_lookahead_that_leaves_the_box_is_counted(monkeypatch):
    from shields.runtime.backup_plans.plan_check import PlanTest

    known = PlanTest.tightenings_of
    monkeypatch.setattr(
        PlanTest,
        "tightenings_of",
        lambda *given: (found := known(*given))._replace(row_limits=np.ones_like(found.row_limits)),
    )
    counts = counts_of(replace(LOOKAHEAD, out=Path("changed")), "CartPole-v0, late")
    assert counts.violations > 0
    assert 0 < counts.broken_episodes <= 32
    assert counts.level > 1.0


class Begun(Exception):
    pass


def begun(monkeypatch, campaign, index=0):
    """The shield of a batch against the cruise, and the info that its episodes begin with."""
    found, reset = [], VectorSafetyShield.reset

    def note(shield, **settings):
        found[:] = shield, reset(shield, **settings)[1]
        return found[1], found[1]

    def stop(shield, actions):
        raise Begun

    with monkeypatch.context() as patched:
        patched.setattr(VectorSafetyShield, "reset", note)
        patched.setattr(VectorSafetyShield, "step", stop)
        with pytest.raises(Begun):
            counts_of(campaign, CRUISE, index)
    return found


def test_nature_pushes_lookahead_to_the_box_and_out_of_the_safe_set_in_turn(monkeypatch):
    assert kinds_of_batches(LOOKAHEAD) == ("to the box", "out of S")
    shields = [begun(monkeypatch, LOOKAHEAD, index)[0] for index in (0, 1, 2)]
    for shield in shields:
        assert (shield.filter.mode, shield.filter.horizon) == ("lookahead", 6)
    to_the_box, out_of_the_set, again = (shield.unwrapped.single.disturbance for shield in shields)
    assert to_the_box.M is again.M is None
    np.testing.assert_array_equal(out_of_the_set.rows, certificate_for_case(CRUISE).polytope.rows)


def test_stored_counts_belong_to_their_mode_and_horizon():
    batch = MonteCarloBatch(CAMPAIGN, CRUISE, 0, certificate_for_case(CRUISE))
    given = ({}, {"mode": "project"}, {"mode": "lookahead", "horizon": 6}, {"mode": "lookahead", "horizon": 7})
    keys = [replace(batch, settings=replace(CAMPAIGN, **each)).key for each in given]
    assert len(set(keys)) == 4
    moved = replace(CAMPAIGN, out=Path("elsewhere"), jobs=7, steps=1.0, force=True)
    assert keys[0] == batch.key == replace(batch, settings=moved).key


def test_episodes_begin_on_the_boundary_of_the_polytope(monkeypatch):
    _, info = begun(monkeypatch, CAMPAIGN, 1)
    np.testing.assert_allclose(certificate_for_case(CRUISE).polytope.gauge(info["state"]), 1.0, atol=1e-8)
    assert info["shield_guaranteed"].all()


def attacked_by(nature, case, certificate):
    """A shield in an environment with a nature that does harm, and its first info."""
    shield = VectorSafetyShield(nature(32, certificate, **vars(case)), certificate, on_unproved="ignore")
    return shield, shield.reset(seed=1)[1]


def test_nature_attains_every_bound():
    case, certificate = attack_cases(0, 1)[CRUISE], certificate_for_case(CRUISE)
    shield, info = attacked_by(WorstCaseVectorEnv, case, certificate)
    np.testing.assert_allclose([certificate.ellipsoid.gauge(x) for x in info["state"]], 1.0, atol=1e-8)
    initial = Ellipsoid(case.plant.initial_noise.bound.shape_matrix)
    np.testing.assert_allclose([initial.gauge(error) for error in info["estimation_error"]], 1.0, atol=1e-8)
    before = info["state"]
    *_, info = shield.step(np.zeros((32, 1), np.float32))
    pushed = info["state"] - before @ case.plant.A.T - info["input"] @ case.plant.B.T
    np.testing.assert_allclose(case.plant.nominal_disturbance.gauge(pushed), 1.0, atol=1e-6)
    assert shield.unwrapped.single.noise == "extreme"


# So many draws leave their ellipsoids that the monitor sees some of it, and episodes leave S.
GAUSSIAN = replace(CAMPAIGN, noise="gaussian", delta=0.4)


@pytest.mark.slow
def test_gaussian_nature_attains_what_is_bounded_and_draws_the_rest():
    case, certificate = cases_of(GAUSSIAN)[CRUISE], certificate_for_case(CRUISE, GAUSSIAN.delta)
    shield, info = attacked_by(GaussianVectorEnv, case, certificate)
    assert shield.filter.plant.delta == case.plant.delta == GAUSSIAN.delta
    np.testing.assert_allclose([certificate.ellipsoid.gauge(x) for x in info["state"]], 1.0, atol=1e-8)
    assert case.plant.initial_noise.bound.gauge(info["estimation_error"]).max() > 1.0
    source, nominal = shield.unwrapped.single.disturbance, 0.1 * np.ones((2, 5))
    pushed = source.draw(None, case.plant, nominal, 0, None)
    np.testing.assert_allclose(np.square(pushed).sum(axis=0), case.plant.gamma, rtol=1e-9)
    worse = np.sqrt(case.plant.gamma) * np.array([np.cos(turns := np.linspace(0.0, 6.3, 400)), np.sin(turns)])
    levels = [np.einsum("ik,ij,jk->k", x, certificate.M, x) for x in (nominal + pushed, nominal[:, :1] + worse)]
    assert levels[0].min() >= levels[1].max() * (1.0 - 1e-9)


@pytest.mark.slow
def test_counts_of_gaussian_noise_lie_within_the_bound_and_do_not_end_with_an_error(
    tmp_path, capsys, monkeypatch, without_workers
):
    replace_cases(monkeypatch, {CRUISE: attack_cases(0, 1)[CRUISE]})
    attack(AttackSettings(steps=1, envs=16, random_plants=1, noise="gaussian", delta=1e-4, out=tmp_path))
    printed = capsys.readouterr().out
    (row,) = (line for line in printed.partition("interval")[2].splitlines() if line.startswith("TruckTrailer"))
    assert row.split()[-1] == "0.031"
    stored = document(tmp_path)
    assert stored["bound_violation_probability"][CRUISE] == pytest.approx((200 + 100 + 1) * 1e-4)
    assert (stored["settings"]["noise"], stored["settings"]["delta"]) == ("gaussian", 1e-4)


def test_gaussian_noise_makes_a_shielded_state_leave_the_safe_set_and_is_counted():
    counts = counts_of(GAUSSIAN, CRUISE)
    assert counts.broken_episodes > 0
    assert counts.level > 1.0
    assert cases_of(GAUSSIAN)[CRUISE].bound_violation_probability() == 1.0


def test_more_exits_than_the_bound_allows_are_an_error():
    counts, limits = {"case": SafetyCounts(steps=2000, episodes=100, broken_episodes=20)}, {"case": 0.15}
    require_within(counts, limits)  # the interval [0.127, 0.292] does not contradict it
    with pytest.raises(SafetyBroken, match=r"case: 20 of 100 episodes left S, more than the bound 0\.11? "):
        require_within(counts, {"case": 0.1})
    assert "[1.3e-01, 2.9e-01]   0.15" in gaussian_table(counts, limits)


def test_a_smoke_run_attacks_the_environments_own_channels_unless_others_are_asked_for():
    def attacked(**given):
        short = shortened(AttackSettings(smoke=True, **given))
        assert short.steps <= 1e5
        assert short.out == Path("runs/attack-smoke")
        return cases_of(short)

    assert {name.rpartition(", ")[2] for name in attacked()} == {"its channel"}
    assert len(attacked()) > 10
    assert {name.rpartition(", ")[2] for name in attacked(channel="perfect")} == {"perfect"}
    kinds = {name.rpartition(", ")[2] for name in attacked(env="ncs_gym/CartPole-v0")}
    assert kinds > {"its channel", "late"}
    assert shortened(AttackSettings()) == AttackSettings()


def test_a_smoke_run_says_what_it_is(tmp_path, small, capsys, without_workers):
    attack(settings(tmp_path, smoke=True, envs=250))
    assert "attacks too little to show anything else" in " ".join(capsys.readouterr().out.split())
    assert document(tmp_path)["total"]["steps"] <= 1e5


@pytest.fixture
def small(monkeypatch):
    """A campaign of two cases."""
    chosen = {name: attack_cases(0, 1)[name] for name in (CRUISE, "TruckTrailer-v0, perfect")}
    replace_cases(monkeypatch, chosen)


def settings(out, **changes):
    return AttackSettings(**{"steps": 6 * 16 * 200, "out": out, "random_plants": 1, "envs": 16, **changes})


def document(folder):
    return json.loads((folder / "attack.json").read_text())


@pytest.mark.cases(1)
@pytest.mark.parametrize(("steps", "envs", "batches", "left_out"), [(7_000, 5, 7, 0), (2_500, 4, 3, 1)])
def test_a_budget_of_steps_is_kept(tmp_path, small, capsys, without_workers, steps, envs, batches, left_out):
    attack(settings(tmp_path, steps=steps, envs=16))
    assert document(tmp_path)["total"]["steps"] == batches * envs * 200 <= steps
    said = [line for line in capsys.readouterr().out.splitlines() if "not attacked" in line]
    assert len(said) == left_out
    for line in said:
        start, _, name = line.partition(": ")
        assert start == "1 of 2 cases are not attacked within 2,500 steps"
        assert name
        assert name not in document(tmp_path)["cases"]


@pytest.fixture
def campaign(attacked, tmp_path):
    """A copy of the folder of a finished campaign, and how it is run again."""
    shutil.copytree(attacked[0], tmp_path / "out")

    def again(*changes):
        with no_worker_processes():
            return ncs(*ATTACK, "--out", tmp_path / "out", *changes)

    return tmp_path / "out", again


def stored(folder):
    return {path.name for path in (folder / "runs").iterdir()}


@pytest.mark.slow
def test_killed_campaign_goes_on_and_ends_like_one_without_worker_processes(attacked, tmp_path):
    out = tmp_path / "out"
    killed(*ATTACK, "--jobs", 1, "--out", out, once=lambda: (out / "runs").exists() and len(stored(out)) >= 2)
    assert 2 <= (left := len(stored(out))) < 9
    assert not (out / "attack.json").exists()
    with no_worker_processes():
        again = ncs(*ATTACK, "--out", out)
    assert f"{left} of 9 runs were finished before" in again.stderr
    assert document(out) == document(attacked[0])


def test_interrupted_campaign_goes_on(campaign):
    out, again = campaign
    whole, batches = document(out), stored(out)
    assert (len(batches), whole["total"]["steps"]) == (9, 9 * 8 * 200)
    (out / "attack.json").unlink()
    for name in sorted(batches)[:2]:
        (out / "runs" / name).unlink()
    assert "7 of 9 runs were finished before" in again().stderr
    assert document(out) == whole
    assert "step/s" not in again().stderr  # all there
    finished = (out / "attack.json").read_bytes()
    for changes in (("--steps", 10 * 8 * 200), ("--mode", "switch")):
        refused = again(*changes)
        assert refused.returncode == 2
        assert changes[0][2:] in refused.stderr
        assert (out / "attack.json").read_bytes() == finished
    again("--force")
    assert document(out) == whole


def test_batch_that_fails_is_named_and_what_is_finished_is_kept(tmp_path, small, monkeypatch, without_workers):
    def fails_once(batch, *reporting):
        if (batch.case, batch.index) == (CRUISE, 1):
            raise ValueError("no memory")
        return SafetyCounts(steps=batch.total_steps, episodes=batch.settings.envs)

    monkeypatch.setattr(MonteCarloBatch, "execute", fails_once)
    with pytest.raises(RunError, match=r"^run TruckTrailerCruise-v0, overtaking-1: no memory") as error:
        attack(settings(tmp_path))
    assert isinstance(error.value.__cause__, ValueError)
    assert stored(tmp_path) >= {f"TruckTrailerCruise-v0-overtaking-{index}.json" for index in (0, 2)}
    assert not (tmp_path / "attack.json").exists()


def test_another_certificate_makes_stored_counts_void(campaign):
    out, again = campaign
    first, plant = document(out)["cases"], truck_trailer()
    (file,) = (out / "certificates").iterdir()
    certificate = Certificate.load(file)
    smaller_set(plant, 0.95 * certificate.L, certificate.K).save(file)
    assert again().returncode == 0
    assert document(out)["cases"] != first


@pytest.fixture
def counted(monkeypatch):
    """Makes a campaign of one batch that is said to have counted something."""
    replace_cases(monkeypatch, {CRUISE: attack_cases(0, 1)[CRUISE]})

    def counts(**counts):
        found = SafetyCounts(steps=3200, episodes=16, exits=2, **counts)
        monkeypatch.setattr(command, "results_of", lambda batches, *where: [found])

    return counts


def test_a_shield_that_fails_ends_with_an_error(tmp_path, counted, capsys):
    counted(broken_episodes=1, level=1.1)
    with pytest.raises(SafetyBroken, match="2 steps outside S, 0 outside the box, 0 without a proof"):
        attack(settings(tmp_path, steps=1))
    assert "-1.0e-01" in capsys.readouterr().out
    attack(settings(tmp_path / "watching", steps=1, unshielded=True))


def test_exits_of_lookahead_are_allowed_and_violations_are_not(tmp_path, counted, capsys):
    counts = {"planned": 1600, "outside_starts": 3, "level": 0.75}
    counted(**counts)
    attack(settings(tmp_path / "kept", steps=1, mode="lookahead"))
    head, *lines = capsys.readouterr().out.splitlines()
    assert head == "3,200 steps, 200 in each episode"
    cells = ["16", "3", "0.1%", "0", "0", "2.1e-01", "2.5e-01", "50.0%", "0.0%"]
    assert next(line for line in lines if line.startswith(" overtaking")).split() == ["overtaking", *cells]
    assert document(tmp_path / "kept")["settings"]["horizon"] == 6
    assert document(tmp_path / "kept")["total"]["planned"] == 1600
    for more, words in (
        ({"violations": 1}, "1 outside the box, 0 without"),
        ({"unproved": 4}, "0 outside the box, 4 "),
    ):
        counted(**counts, **more)
        with pytest.raises(SafetyBroken, match=f"^{words}"):
            attack(settings(tmp_path / words, steps=1, mode="lookahead"))


def test_counts_add_up_and_bound_the_probability():
    counts = sum(
        [SafetyCounts(steps=2, episodes=300, level=0.5), SafetyCounts(steps=3, episodes=300, level=0.9)], SafetyCounts()
    )
    assert (counts.steps, counts.episodes, counts.level) == (5, 600, 0.9)
    assert counts.margin == pytest.approx(0.1)
    assert counts.bound == pytest.approx(1.0 - 0.025 ** (1.0 / 600))


def test_the_certificate_of_a_case_fits_its_plant_and_contract():
    case = AttackCase(truck_trailer(), attack_cases(0, 1)[CRUISE].channel)
    assert case.certificate().fingerprint == truck_trailer().fingerprint


@pytest.mark.slow
def test_either_kind_of_safe_set_is_attacked_and_neither_takes_the_certificates_of_the_other(campaign):
    out, again = campaign
    for kind in ("polytope", "ellipsoid"):
        assert again("--safe-set", kind, "--steps", 3 * 8 * 200, "--force").returncode == 0
        (file,) = (out / "certificates").glob(f"*{kind}.json")
        assert (Certificate.load(file).polytope is None) == (kind == "ellipsoid")
        assert document(out)["settings"]["safe_set"] == kind
        assert (document(out)["total"]["exits"], document(out)["total"]["broken_episodes"]) == (0, 0)
    assert len(list((out / "certificates").iterdir())) == 3
