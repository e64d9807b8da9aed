"""`ncs attack`: nature and agents at their worst, exact counts, and an end that tells of every failure."""

import json

import gymnasium as gym
import numpy as np
import pytest

from experiments.commands.attack import attacked, channels_of, hostile_agents, starts, worst_case
from ncs_gym import Channel, ChannelContract, Ellipsoid
from ncs_gym.envs.env import ncs_env
from ncs_gym.registration import needing_extras
from shields import VectorSafetyShield, certificate_for
from tests.command import ncs, succeeded
from tests.product import vector_shield

CRUISE, CART, REACTOR = (f"ncs_gym/{name}-v0" for name in ("TruckTrailerCruise", "CartPole", "BatchReactor"))


def shield_of(env_id, count, mode="project", **changed):
    """A shield around environments of an id under attack."""
    env = ncs_env(gym.make(env_id))
    certificate = certificate_for(env.plant, env.certificate_contract)
    vector = gym.make_vec(env_id, num_envs=count, **(worst_case(certificate, mode) | changed))
    return vector_shield(vector, certificate, mode, on_unproved="ignore")


def counts_of(shield, seed=0):
    counts = {}
    for found in attacked(shield, np.random.default_rng(seed)):
        for name, count in found.items():
            counts[name] = counts.get(name, 0) + count
    return counts


@pytest.fixture
def short(monkeypatch):
    """Episodes of 60 steps."""
    monkeypatch.setattr("experiments.commands.attack.EPISODE_STEPS", 60)


def rows_of(run):
    """Cells of the table by the channel's name, of the sum by "all"."""
    rows = [line.split() for line in run.stdout.splitlines()]
    return {row[0]: row[1:] for row in rows if row and row[-1].endswith("%")}


def test_table_has_every_channel_and_their_sum(short, tmp_path):
    run = succeeded("attack", "--env", CART, "--steps", 1_440, "--out", tmp_path / "a.json")
    rows, stored = rows_of(run), json.loads((tmp_path / "a.json").read_text())
    assert list(rows) == ["own", "late", "rare", "all"]
    assert "\nCartPole-v0\n" in run.stdout
    assert [rows["all"][k] for k in range(5)] == ["1,440", "24", "0", "0", "0"]
    for name, counts in stored.items():
        assert counts["steps"] == 8 * 60
        assert rows[name.removeprefix("CartPole-v0, ")][5] == f"{counts['overridden'] / 480:.1%}"
        assert counts["overridden"] > 0.25 * counts["steps"]
        assert counts["outside S"] == counts["guaranteed outside S"] == counts["lost"] == 0


def test_the_attack_does_harm_where_the_shield_only_watches():
    counts = counts_of(shield_of(CART, 16, "monitor"))
    assert counts["outside box"] > 100
    assert counts["overridden"] > 100
    assert counts["no claim"] >= counts["outside S"] > 100
    assert counts["guaranteed outside S"] == counts["guaranteed outside box"] == 0


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (lambda info: {"shield_guaranteed": info["shield_guaranteed"] | True}, "were outside the box"),
        (lambda info: {"shield_guaranteed": info["shield_guaranteed"] & False}, "no longer guaranteed though"),
    ],
)
def test_a_shield_that_claims_too_much_or_loses_its_proof_ends_with_exit_code_1(said, words, short, monkeypatch):
    step = VectorSafetyShield.step

    def altered(self, actions):
        *rest, info = step(self, np.where(np.isnan(actions), 0.0, actions))
        return *rest, info | {"cost": info["cost"] + 1.0} | said(info)

    monkeypatch.setattr(VectorSafetyShield, "step", altered)
    run = ncs("attack", "--env", CRUISE, "--steps", 1)
    assert run.returncode == 1
    assert "Traceback" not in run.stderr
    assert words in " ".join(run.stderr.split())
    assert rows_of(run)["all"][3] == rows_of(run)["all"][0]  # the table is printed all the same


def test_what_comes_after_a_broken_contract_is_no_failure():
    counts = counts_of(shield_of(REACTOR, 16, channel=Channel(loss=1.0, quantization_step=1e-3)))
    assert counts["outside box"] > 30  # which ends the episode
    assert counts["no claim"] > 0.8 * counts["steps"]
    assert counts["lost"] == counts["guaranteed outside S"] == counts["guaranteed outside box"] == 0


@pytest.mark.parametrize("env_id", [CART, REACTOR, CRUISE])
def test_channels_keep_the_contract_and_use_it_up(env_id, short):
    env = ncs_env(gym.make(env_id))
    channels = channels_of(env.channel, env.contract)
    assert channels["own"] is env.channel
    if env.contract is None:
        assert list(channels) == ["own", "blackout"]
        assert counts_of(shield_of(env_id, 8, channel=channels["blackout"]))["no claim"] == 0
        return
    shorter = ChannelContract(env.contract.max_age - 1, env.contract.quantization_step)
    for kind in ("late", "rare"):
        assert env.contract.is_kept_by(channels[kind])
        assert not shorter.is_kept_by(channels[kind])


def test_nature_attains_every_bound():
    shield = shield_of(CRUISE, 32)
    certificate, plant, rng = shield.certificate, shield.filter.plant, np.random.default_rng(1)
    _, info = shield.reset(seed=1, options={"state": starts(certificate, rng, 32)})
    np.testing.assert_allclose(certificate.safe_set.gauge(info["state"]), 1.0, atol=1e-8)
    assert info["shield_guaranteed"].all()
    initial = Ellipsoid(plant.initial_noise.bound.shape_matrix)
    np.testing.assert_allclose([initial.gauge(error) for error in info["estimation_error"]], 1.0, atol=1e-8)
    before = info["state"]
    *_, info = shield.step(np.zeros((32, 1), np.float32))
    pushed = info["state"] - before @ plant.A.T - info["input"] @ plant.B.T
    np.testing.assert_allclose(plant.nominal_disturbance.gauge(pushed), 1.0, atol=1e-6)
    assert shield.unwrapped.single.noise == "extreme"


def test_agents_are_random_outward_turned_round_and_bang_bang():
    env = ncs_env(gym.make(CART))
    certificate, plant = certificate_for(env.plant, env.certificate_contract), env.plant
    act, rng = hostile_agents(certificate, plant, 8, np.random.default_rng(0)), np.random.default_rng(1)
    estimates = rng.standard_normal((8, plant.n)) * plant.half_widths
    first, second = act(estimates).copy(), act(estimates)
    assert (first[:2] != second[:2]).all()
    np.testing.assert_array_equal(first[2:], second[2:])
    growing = np.array([x @ plant.A.T @ plant.weight @ plant.B for x in estimates])
    np.testing.assert_array_equal(first[2:4], np.sign(growing[2:4]))
    np.testing.assert_array_equal(np.sign(first[4:6]), -np.sign(estimates[4:6] @ certificate.K.T))
    np.testing.assert_array_equal(np.abs(first[6:]), 1.0)


def assert_safe(counts):
    assert counts["outside S"] == counts["outside box"] == counts["no claim"] == counts["lost"] == 0
    assert counts["overridden"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Pendulum-v0", "CartPoleNonlinear-v0", "InvertedPendulum-v0"])
def test_shielded_process_never_leaves_the_safe_set_in_a_long_attack(name):
    env_id = f"ncs_gym/{name}"
    if env_id in needing_extras():
        pytest.skip("the extra of this environment is not installed")
    env = ncs_env(gym.make(env_id))
    kinds = channels_of(env.channel, env.contract).values()
    for channel, mode in zip(kinds, ("project", "switch", "boundary"), strict=True):
        assert_safe(counts_of(shield_of(env_id, 168, mode, channel=channel)))
        assert counts_of(shield_of(env_id, 24, "monitor", channel=channel))["outside box"] > 0
