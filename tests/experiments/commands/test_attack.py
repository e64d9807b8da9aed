"""The campaign behind `ncs attack`: exact under any split, resumable, and able to see a failure."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.attack import monte_carlo_batch
from experiments.attack.attack_cases import AttackCase, attack_cases
from experiments.attack.monte_carlo_batch import MonteCarloBatch, cases_of
from experiments.attack.safety_counts import SafetyCounts, gaussian_table, require_safe, require_within
from experiments.attack.worst_case import HostileRequests
from experiments.commands import attack as command
from experiments.commands.attack import attack
from experiments.errors import OtherResultsError, ResultsError, RunError, SafetyBroken
from experiments.runs.run_store import RunStore
from experiments.settings.certificates import AttackSettings
from ncs_gym import truck_trailer
from ncs_gym.network import requests
from ncs_gym.network.contract import contract_of
from ncs_gym.network.requests import spare_samples
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from shields import Certificate
from shields import certify as smaller_set
from tests.command import ncs
from tests.workers import no_worker_processes, replace_cases

CAMPAIGN = AttackSettings(seed=0, random_plants=1, envs=32)
CRUISE, OTHER = "TruckTrailerCruise-v0, overtaking", "CartPole-v0, rare"


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    folder = tmp_path_factory.mktemp("certificates")
    chosen = {
        name: case
        for name, case in attack_cases(0, 1).items()
        if name.startswith(("TruckTrailerCruise", "CartPole-v0"))
    }
    return command._certificates(chosen, folder)


def counts_of(campaign, certificate, case, index=0):
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


def test_batch_has_the_same_counts_after_any_other(certificates):
    batches = [(CRUISE, 0), (CRUISE, 1), ("CartPole-v0, rare", 2)]
    first = [counts_of(CAMPAIGN, certificates[case], case, index) for case, index in batches]
    again = [counts_of(CAMPAIGN, certificates[case], case, index) for case, index in reversed(batches)]
    assert first == again[::-1]
    assert first[0] != first[1]
    total = sum(first, SafetyCounts())
    assert (total.steps, total.episodes) == (3 * 32 * 200, 96)
    assert (total.exits, total.violations, total.broken_episodes, total.unproved) == (0, 0, 0, 0)
    assert 0 < total.interventions < total.steps
    assert 0.99 < total.level <= 1.0


ON_REQUEST = "CartPole-v0, on request"


def test_hostile_requests_keep_the_contract_and_the_safe_set(certificates):
    counts = counts_of(CAMPAIGN, certificates[ON_REQUEST], ON_REQUEST)
    assert 0 < counts.forced < counts.packets < counts.steps
    assert (counts.overdue, counts.lapsed, counts.exits, counts.violations, counts.unproved) == (0, 0, 0, 0, 0)
    require_safe(counts, looks_ahead=False)


def test_requests_that_are_forced_too_late_are_counted(certificates, monkeypatch):
    monkeypatch.setattr(requests, "spare_samples", lambda *given: 1 + spare_samples(*given))
    monte_carlo_batch._shields.cache_clear()
    counts = counts_of(CAMPAIGN, certificates[ON_REQUEST], ON_REQUEST)
    monte_carlo_batch._shields.cache_clear()
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
    with pytest.raises(ValueError, match="channel must be one of"):
        cases_of(replace(CAMPAIGN, channel="nowhere"))


def test_without_the_shield_the_attack_breaks_out_and_is_counted(certificates):
    watching = replace(CAMPAIGN, unshielded=True)
    counts = counts_of(watching, certificates[CRUISE], CRUISE)
    assert counts.exits > 1000
    assert counts.violations > 1000
    assert counts.broken_episodes > 16
    assert counts.level > 1.5
    assert counts.unproved > 0
    assert counts.margin < 0.0


LOOKAHEAD = replace(CAMPAIGN, mode="lookahead", horizon=6)


def test_lookahead_is_attacked_in_and_outside_the_safe_set_and_keeps_the_box(certificates):
    case = "CartPole-v0, rare"
    certificate = replace(certificates[case], polytope=None)  # so that many states are outside the safe set
    first = [counts_of(LOOKAHEAD, certificate, case, index) for index in (0, 1)]
    assert [counts_of(LOOKAHEAD, certificate, case, index) for index in (1, 0)] == first[::-1]
    total = sum(first, SafetyCounts())
    assert (total.steps, total.episodes) == (2 * 32 * 200, 64)
    assert (total.violations, total.broken_episodes, total.unproved) == (0, 0, 0)
    assert 0.98 < total.level <= 1.0
    assert total.exits > 0.5 * total.steps
    assert 0 < total.outside_starts < 32
    assert total.exits < total.planned < total.steps
    assert total.interventions > 0


def test_lookahead_that_leaves_the_box_is_counted(certificates, monkeypatch):
    from shields.runtime.backup_plans.plan_check import PlanTest

    known = PlanTest.tightenings_of
    monkeypatch.setattr(
        PlanTest,
        "tightenings_of",
        lambda *given: (found := known(*given))._replace(row_limits=np.ones_like(found.row_limits)),
    )
    monte_carlo_batch._shields.cache_clear()
    counts = counts_of(LOOKAHEAD, certificates["CartPole-v0, late"], "CartPole-v0, late")
    monte_carlo_batch._shields.cache_clear()
    assert counts.violations > 0
    assert 0 < counts.broken_episodes <= 32
    assert counts.level > 1.0


def test_nature_pushes_lookahead_to_the_box_and_out_of_the_safe_set_in_turn(certificates):
    shields = monte_carlo_batch._shields(LOOKAHEAD, CRUISE, certificates[CRUISE])
    sources = {name: shield.unwrapped._process.disturbance for name, shield in shields.items()}
    assert list(shields) == list(monte_carlo_batch.kinds_of_batches(LOOKAHEAD))
    assert sources["to the box"].M is None
    np.testing.assert_array_equal(sources["out of S"].rows, certificates[CRUISE].polytope.rows)
    for shield in shields.values():
        assert (shield.filter.mode, shield.filter.horizon) == ("lookahead", 6)


def test_stored_counts_belong_to_their_mode_and_horizon(monkeypatch):
    chosen = {CRUISE: attack_cases(0, 1)[CRUISE]}
    replace_cases(monkeypatch, chosen)
    batch = MonteCarloBatch(CAMPAIGN, CRUISE, 0, chosen[CRUISE].certificate())
    given = ({}, {"mode": "project"}, {"mode": "lookahead", "horizon": 6}, {"mode": "lookahead", "horizon": 7})
    keys = [replace(batch, settings=replace(CAMPAIGN, **each)).key for each in given]
    assert len(set(keys)) == 4
    moved = replace(CAMPAIGN, out=Path("elsewhere"), jobs=7, steps=1.0, force=True)
    assert keys[0] == batch.key == replace(batch, settings=moved).key


def test_episodes_begin_on_the_boundary_of_the_polytope(certificates):
    from experiments.attack.monte_carlo_batch import _begin, _shields

    shield = _shields(CAMPAIGN, CRUISE, certificates[CRUISE])["project"]
    info = _begin(CAMPAIGN, shield, 1, np.random.default_rng(0))
    np.testing.assert_allclose(certificates[CRUISE].polytope.gauge(info["state"]), 1.0, atol=1e-8)
    assert info["shield_guaranteed"].all()


def test_nature_attains_every_bound(certificates):
    from experiments.attack.monte_carlo_batch import _shields

    case, certificate = attack_cases(0, 1)[CRUISE], certificates[CRUISE]
    shield = _shields(CAMPAIGN, CRUISE, certificates[CRUISE])["project"]
    _, info = shield.reset(seed=1)
    np.testing.assert_allclose([certificate.ellipsoid.gauge(x) for x in info["state"]], 1.0, atol=1e-8)
    errors, initial = info["estimation_error"], Ellipsoid(case.plant.initial_noise.bound.shape_matrix)
    np.testing.assert_allclose([initial.gauge(error) for error in errors], 1.0, atol=1e-8)
    before = info["state"]
    _, _, _, _, info = shield.step(np.zeros((32, 1), np.float32))
    pushed = info["state"] - before @ case.plant.A.T - info["input"] @ case.plant.B.T
    np.testing.assert_allclose(case.plant.nominal_disturbance.gauge(pushed), 1.0, atol=1e-6)
    state = info["state"].T
    noise = shield.unwrapped._process.measure(np.random.default_rng(0), state) - case.plant.H @ state
    np.testing.assert_allclose(case.plant.sensor_noise.bound.gauge(noise.T), 1.0, atol=1e-6)


# So many draws leave their ellipsoids that the monitor sees some of it, and episodes leave S.
GAUSSIAN = replace(CAMPAIGN, noise="gaussian", delta=0.4)


def test_gaussian_nature_attains_what_is_bounded_and_draws_the_rest(tmp_path):
    from experiments.attack.monte_carlo_batch import _shields

    case = attack_cases(0, 1)[CRUISE].with_delta(GAUSSIAN.delta)
    certificate = command._certificates({CRUISE: case}, tmp_path)[CRUISE]
    shield = _shields(GAUSSIAN, CRUISE, certificate)["project"]
    assert shield.filter.plant.delta == case.plant.delta == GAUSSIAN.delta
    _, info = shield.reset(seed=1)
    np.testing.assert_allclose([certificate.ellipsoid.gauge(x) for x in info["state"]], 1.0, atol=1e-8)
    assert case.plant.initial_noise.bound.gauge(info["estimation_error"]).max() > 1.0
    source, nominal = shield.unwrapped._process.disturbance, 0.1 * np.ones((2, 5))
    pushed = source.draw(None, case.plant, nominal, 0, None)
    np.testing.assert_allclose(np.square(pushed).sum(axis=0), case.plant.gamma, rtol=1e-9)
    worse = np.sqrt(case.plant.gamma) * np.array([np.cos(turns := np.linspace(0.0, 6.3, 400)), np.sin(turns)])
    levels = [np.einsum("ik,ij,jk->k", x, certificate.M, x) for x in (nominal + pushed, nominal[:, :1] + worse)]
    assert levels[0].min() >= levels[1].max() * (1.0 - 1e-9)


def test_counts_of_gaussian_noise_lie_within_the_bound_and_do_not_end_with_an_error(
    tmp_path, small, capsys, without_workers
):
    attack(settings(tmp_path, noise="gaussian", delta=1e-4))
    printed = capsys.readouterr().out
    rows = [line for line in printed.partition("interval")[2].splitlines() if line.startswith("TruckTrailer")]
    assert [row.split()[-1] for row in rows] == ["0.031", "0.041"]
    stored = document(tmp_path)
    assert stored["bound_violation_probability"][CRUISE] == pytest.approx((200 + 100 + 1) * 1e-4)
    assert stored["settings"]["noise"] == "gaussian"
    assert stored["settings"]["delta"] == 1e-4


def test_gaussian_noise_makes_a_shielded_state_leave_the_safe_set_and_is_counted(tmp_path):
    case = attack_cases(0, 1)[CRUISE].with_delta(GAUSSIAN.delta)
    counts = counts_of(GAUSSIAN, command._certificates({CRUISE: case}, tmp_path)[CRUISE], CRUISE)
    assert counts.broken_episodes > 0
    assert counts.level > 1.0
    assert case.bound_violation_probability() == 1.0


def test_more_exits_than_the_bound_allows_are_an_error():
    counts, limits = {"case": SafetyCounts(steps=2000, episodes=100, broken_episodes=20)}, {"case": 0.15}
    require_within(counts, limits)  # the interval [0.127, 0.292] does not contradict it
    with pytest.raises(SafetyBroken, match=r"case: 20 of 100 episodes left S, more than the bound 0\.11? "):
        require_within(counts, {"case": 0.1})
    assert "[1.3e-01, 2.9e-01]   0.15" in gaussian_table(counts, limits)


@pytest.fixture
def small(monkeypatch):
    """A campaign of two cases."""
    chosen = {name: attack_cases(0, 1)[name] for name in (CRUISE, "TruckTrailer-v0, perfect")}
    replace_cases(monkeypatch, chosen)


# Steps in which each kind of both cases comes in once.
ROUND = 6 * 16 * 200


def settings(out, **changes):
    return AttackSettings(**{"steps": ROUND, "out": out, "random_plants": 1, "envs": 16, **changes})


def document(folder):
    return json.loads((folder / "certify.json").read_text())


def test_results_do_not_depend_on_worker_processes(tmp_path, small, capsys):
    attack(settings(tmp_path / "two", jobs=2))
    table = capsys.readouterr().out
    assert any(line.startswith("all  ") for line in table.splitlines())
    with no_worker_processes():
        attack(settings(tmp_path / "none"))
    assert document(tmp_path / "none") == document(tmp_path / "two")
    assert document(tmp_path / "none")["total"]["steps"] == 6 * 16 * 200


@pytest.mark.parametrize(
    ("steps", "envs", "batches", "left_out"), [(20_000, 16, 6, 0), (7_000, 5, 7, 0), (2_500, 4, 3, 1)]
)
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


def stored(folder):
    return {path.name for path in (folder / "runs").iterdir()}


def test_interrupted_campaign_goes_on(tmp_path, small, capsys, without_workers):
    attack(settings(tmp_path))
    whole, batches = document(tmp_path), stored(tmp_path)
    assert len(batches) == 6
    (tmp_path / "certify.json").unlink()
    for name in sorted(batches)[:2]:
        (tmp_path / "runs" / name).unlink()
    capsys.readouterr()
    attack(settings(tmp_path))
    assert document(tmp_path) == whole
    assert stored(tmp_path) == batches
    assert "4 of 6 runs were finished before" in capsys.readouterr().err
    attack(settings(tmp_path))  # all there
    assert "step/s" not in capsys.readouterr().err
    attack(settings(tmp_path, steps=7 * 16 * 200))
    assert document(tmp_path)["total"]["steps"] == 7 * 16 * 200
    assert len(stored(tmp_path)) == 7
    finished = (tmp_path / "certify.json").read_bytes()
    for changes in ({"steps": ROUND}, {"mode": "switch"}):
        with pytest.raises(OtherResultsError, match=next(iter(changes))):
            attack(settings(tmp_path, **changes))
        assert (tmp_path / "certify.json").read_bytes() == finished
    attack(settings(tmp_path, force=True))
    assert document(tmp_path) == whole
    assert len(stored(tmp_path)) == 7


def test_batch_that_fails_is_named_and_what_is_finished_is_kept(tmp_path, small, monkeypatch, without_workers):
    execute = MonteCarloBatch.execute

    def fails_once(batch, *reporting):
        if (batch.case, batch.index) == (CRUISE, 1):
            raise ValueError("no memory")
        return execute(batch, *reporting)

    monkeypatch.setattr(MonteCarloBatch, "execute", fails_once)
    with pytest.raises(RunError, match=r"^run TruckTrailerCruise-v0-overtaking-1: no memory") as error:
        attack(settings(tmp_path))
    assert isinstance(error.value.__cause__, ValueError)
    assert stored(tmp_path) >= {f"TruckTrailerCruise-v0-overtaking-{index}.json" for index in (0, 2)}
    assert not (tmp_path / "certify.json").exists()


def test_another_certificate_makes_stored_counts_void(tmp_path, small, without_workers):
    attack(settings(tmp_path))
    first = document(tmp_path)["cases"]
    for file in (tmp_path / "certificates").iterdir():
        certificate = Certificate.load(file)
        if certificate.fingerprint == truck_trailer().fingerprint:
            smaller_set(truck_trailer(), 0.95 * certificate.L, certificate.K).save(file)
    attack(settings(tmp_path))
    second = document(tmp_path)["cases"]
    assert second[CRUISE] == first[CRUISE]
    assert second["TruckTrailer-v0, perfect"] != first["TruckTrailer-v0, perfect"]


@pytest.fixture
def counted(monkeypatch):
    """Makes a campaign of one batch that is said to have counted something."""
    case = attack_cases(0, 1)[CRUISE]
    replace_cases(monkeypatch, {CRUISE: case})

    def counts(**counts):
        found = SafetyCounts(steps=3200, episodes=16, exits=2, **counts)
        monkeypatch.setattr(command, "_numbers_of_batches", lambda *given: [1])
        monkeypatch.setattr(command, "results_of", lambda batches, *where: [found])

    return counts


def test_a_shield_that_fails_ends_with_an_error(tmp_path, counted, capsys):
    counted(broken_episodes=1, level=1.1)
    with pytest.raises(SafetyBroken, match="2 steps outside S, 0 outside the box, 0 without a proof"):
        attack(settings(tmp_path))
    assert "-1.0e-01" in capsys.readouterr().out
    attack(settings(tmp_path / "watching", unshielded=True))


def test_exits_of_lookahead_are_allowed_and_violations_are_not(tmp_path, counted, capsys):
    counts = {"planned": 1600, "outside_starts": 3, "level": 0.75}
    counted(**counts)
    attack(settings(tmp_path / "kept", mode="lookahead"))
    head, *lines = capsys.readouterr().out.splitlines()
    assert head == "3,200 steps, 200 in each episode"
    cells = ["16", "3", "0.1%", "0", "0", "2.1e-01", "2.5e-01", "50.0%", "0.0%"]
    assert next(line for line in lines if line.startswith("  overtaking")).split() == ["overtaking", *cells]
    assert document(tmp_path / "kept")["settings"]["horizon"] == 6
    assert document(tmp_path / "kept")["total"]["planned"] == 1600
    for more, words in (
        ({"violations": 1}, "1 outside the box, 0 without"),
        ({"unproved": 4}, "0 outside the box, 4 "),
    ):
        counted(**counts, **more)
        with pytest.raises(SafetyBroken, match=f"^{words}"):
            attack(settings(tmp_path / words, mode="lookahead"))


def test_damaged_counts_are_refused_and_those_of_other_settings_not_taken(tmp_path, certificates):
    batch, store = MonteCarloBatch(CAMPAIGN, CRUISE, 0, certificates[CRUISE]), RunStore(tmp_path)
    counts = SafetyCounts(steps=32 * 200, episodes=32, exits=3, level=0.5)
    store.save(batch, counts)
    assert store.load(batch) == counts
    for other in (replace(batch, settings=replace(CAMPAIGN, seed=1)), replace(batch, certificate=certificates[OTHER])):
        assert store.load(other) is None
    path = tmp_path / "runs" / f"{batch.name}.json"
    whole = path.read_bytes()
    for position in range(len(whole) - 1):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 1]) + whole[position + 1 :])
        with pytest.raises(ResultsError, match=r"is no result of its run .*: delete it to repeat the run"):
            store.load(batch)


def test_counts_add_up_and_bound_the_probability():
    counts = sum(
        [SafetyCounts(steps=2, episodes=300, level=0.5), SafetyCounts(steps=3, episodes=300, level=0.9)], SafetyCounts()
    )
    assert (counts.steps, counts.episodes, counts.level) == (5, 600, 0.9)
    assert counts.margin == pytest.approx(0.1)
    assert counts.bound == pytest.approx(1.0 - 0.025 ** (1.0 / 600))


@pytest.mark.parametrize(
    ("changes", "flag"),
    [
        ({"steps": 0.5}, "steps"),
        ({"steps": float("nan")}, "steps"),
        ({"envs": 3}, "envs"),
        ({"jobs": 0}, "jobs"),
        ({"seed": -1}, "seed"),
        ({"random_plants": -1}, "random-plants"),
        ({"delta": 0.0}, "delta"),
        ({"delta": 0.6}, "delta"),
    ],
)
def test_wrong_settings_are_named(changes, flag, tmp_path):
    with pytest.raises(ValueError, match=f"--{flag} must be (at least|between)"):
        settings(tmp_path, **changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"horizon": 0, "mode": "lookahead"}, "--horizon must be at least 1 and at most 50, got 0"),
        ({"horizon": 51, "mode": "lookahead"}, "--horizon must be at least 1 and at most 50, got 51"),
        ({"horizon": 6}, "--horizon 6 is for mode lookahead"),
        ({"horizon": 6, "mode": "project"}, "--horizon 6 is for mode lookahead"),
        ({"unshielded": True, "mode": "switch"}, "give either --mode switch or --unshielded"),
        ({"env": "ncs_gym/CartPole-v0", "plant": "p.json"}, "give either --env or --plant"),
        ({"max_age": 3}, "--max-age and --quantization-step belong to --plant"),
        ({"env": "ncs_gym/CartPole-v0", "quantization_step": 0.1}, "--max-age and --quantization-step belong to --pla"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(changes, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        settings(tmp_path, **changes)


def test_the_certificate_of_a_case_fits_its_plant_and_contract():
    case = AttackCase(truck_trailer(), attack_cases(0, 1)[CRUISE].channel)
    assert case.certificate().fingerprint == truck_trailer().fingerprint


def test_either_kind_of_safe_set_is_attacked_and_neither_takes_the_certificates_of_the_other(
    tmp_path, small, without_workers
):
    for kind in ("polytope", "ellipsoid", None):
        attack(settings(tmp_path, safe_set=kind, force=True))
        files = sorted((tmp_path / "certificates").glob("*.json"))
        chosen = [file for file in files if file.stem.endswith(kind or "")]
        if kind is None:
            chosen = [file for file in files if not file.stem.endswith(("polytope", "ellipsoid"))]
        assert chosen
        assert {Certificate.load(file).polytope is None for file in chosen} == {kind == "ellipsoid"}
        document = json.loads((tmp_path / "certify.json").read_text())
        assert document["settings"]["safe_set"] == kind
        assert (document["total"]["exits"], document["total"]["broken_episodes"]) == (0, 0)


def test_earlier_name_of_the_command_is_the_same_command(tmp_path, small, without_workers):
    for name in ("attack", "certify"):
        run = ncs(name, "--steps", ROUND, "--random-plants", 1, "--envs", 16, "--out", tmp_path / "out")
        assert run.returncode == 0, run.stderr
    assert "step/s" not in run.stderr  # all there, in the folder of the other name
    helps = [ncs(name, "--help").stdout for name in ("attack", "certify")]
    assert helps[0] == helps[1]
    assert "ncs attack" in helps[0]
    assert "certify" not in ncs("--help").stdout
