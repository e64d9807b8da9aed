import hashlib
import json
import zipfile
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from agents.agent import Agent, AgentError, Normalization
from agents.hyperparams import with_changes
from agents.loop import LoopConfig, ShieldSettings
from agents.training import train, untrained
from ncs_gym import Channel, GilbertElliott, truck_trailer
from shields import Certificate, verify
from tests.certificates import certificate_of
from tests.plants import small

CRUISE, LINEAR = "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/LinearNCS-v0"
OBSERVATIONS = np.random.default_rng(0).standard_normal((50, 3))
SETTINGS = {
    "PPO": dict(n_envs=4, n_steps=64, batch_size=128, n_epochs=1, policy_kwargs=dict(net_arch=[16, 16])),
    "TD3": dict(n_envs=4, gradient_steps=1, batch_size=32, buffer_size=1000, learning_starts=64)
    | dict(policy_kwargs=dict(net_arch=[16, 16])),
}


def trained(algorithm="PPO", channel=None):
    return train(LoopConfig(env=CRUISE, kwargs={"channel": channel}), 256, 1, algorithm, SETTINGS[algorithm]).agent


def change(folder, **values):
    document = json.loads((folder / "agent.json").read_text())
    (folder / "agent.json").write_text(json.dumps(document | values))


def rewrite(folder, weights):
    (folder / "model.zip").write_bytes(weights)
    change(folder, sha256_of_model=hashlib.sha256(weights).hexdigest())


@pytest.fixture(scope="module")
def agent():
    return trained()


@pytest.fixture
def folder(agent, tmp_path):
    agent.save(tmp_path)
    return tmp_path


@pytest.mark.cases(1)
@pytest.mark.parametrize("algorithm", SETTINGS)
def test_loaded_agent_acts_like_the_saved_one(algorithm, tmp_path):
    bursts = Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.5), delay=1)
    agent = trained(algorithm, bursts)
    agent.save(tmp_path)
    for place in (tmp_path, tmp_path / "model.zip"):
        again = Agent.load(place)
        np.testing.assert_array_equal(again.act(OBSERVATIONS), agent.act(OBSERVATIONS))
        assert (again.algorithm, again.hyperparams, again.env) == (algorithm, agent.hyperparams, CRUISE)
        assert with_changes(again.hyperparams, SETTINGS[algorithm]) == again.hyperparams
        assert again.channel == bursts
        assert (again.shield_mode, again.horizon) == (None, None)
    single = agent.act(OBSERVATIONS[7].tolist())
    assert single.shape == (1,)
    np.testing.assert_array_equal(single, agent.act(OBSERVATIONS[7:8])[0])


def test_shared_folder_has_the_agent_its_shield_and_how_it_was_trained(agent, certificate, tmp_path):
    shared = tmp_path / "new" / "folder"
    agent.save(shared, ShieldSettings(certificate, "switch"))
    assert {file.name for file in shared.iterdir()} == {"agent.json", "certificate.json", "model.zip"}
    assert Certificate.load(shared / "certificate.json") == certificate
    again, document = Agent.load(shared), json.loads((shared / "agent.json").read_text())
    np.testing.assert_array_equal(again.act(OBSERVATIONS), agent.act(OBSERVATIONS))
    assert again.checksum == agent.checksum
    assert (document["env"], document["algorithm"], document["seed"], again.seed) == (CRUISE, "PPO", 1, 1)
    assert document["plant"] == certificate.fingerprint
    agent.save(shared)
    assert {file.name for file in shared.iterdir()} == {"agent.json", "model.zip"}


def test_folder_keeps_how_the_environment_was_made(tmp_path):
    downlink = Channel(loss=0.3, delay=2, max_consecutive_losses=3)
    kwargs = {"downlink": downlink, "between_samples": 8, "observe": ("age",), "channel": Channel(loss=0.1)}
    env = gym.make(CRUISE, **kwargs).unwrapped
    certificate = certificate_of(env.plant, env.certificate_contract)
    shield = ShieldSettings(certificate, "lookahead", horizon=3)
    loop = LoopConfig(env=CRUISE, kwargs=kwargs, shield=shield)
    agent = untrained(loop, 0)
    agent.save(tmp_path, shield)
    again = Agent.load(tmp_path)
    assert again.env_kwargs == agent.env_kwargs
    assert (again.shield_mode, again.horizon) == ("lookahead", 3)
    made = gym.make(again.env, **again.env_kwargs).unwrapped
    assert (made.plant.fingerprint, made.downlink, made.observe) == (env.plant.fingerprint, downlink, ("age",))
    with pytest.raises(ValueError, match="files of agents do not keep disturbance=<function"):
        replace(agent, kwargs={"disturbance": lambda *given: None}).save(tmp_path)
    for wrong in ({"mode": "hope", "horizon": None}, {"mode": "lookahead", "horizon": 0}, {"mode": "lookahead"}):
        change(tmp_path, shield=wrong)
        with pytest.raises(AgentError, match="is damaged"):
            Agent.load(tmp_path)


@pytest.mark.cases(1)
@pytest.mark.parametrize("as_file", [False, True])
def test_folder_keeps_a_plant_without_an_id(tmp_path, as_file):
    plant, folder = small([[0.9, 0.1], [0.0, 0.8]], disturbance_bound=0.01), tmp_path / "agent"
    plant.save(tmp_path / "plant.json")
    loop = LoopConfig(env=LINEAR, kwargs={"plant": tmp_path / "plant.json" if as_file else plant})
    shield = ShieldSettings(certificate_of(plant))
    agent = untrained(replace(loop, shield=shield), 0)
    agent.save(folder, shield)
    (tmp_path / "plant.json").unlink()  # the folder is all that is needed
    again = Agent.load(folder)
    env = gym.make(again.env, **again.env_kwargs)
    assert env.unwrapped.plant.fingerprint == plant.fingerprint
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(again.act(observation), agent.act(observation))
    assert verify(Certificate.load(folder / "certificate.json"), env.unwrapped.plant).valid


def test_a_foreign_agent_names_no_file_as_its_plant(folder, tmp_path):
    small([[0.5, 0.0], [0.0, 0.5]]).save(tmp_path / "plant.json")
    change(folder, env=LINEAR, kwargs={"plant": str(tmp_path / "plant.json")})
    with pytest.raises(AgentError, match="files of agents do not keep plant='"):
        Agent.load(folder)


def test_training_whose_agent_cannot_be_saved_is_told_so_before_it():
    loop = LoopConfig(env=CRUISE, kwargs={"autoreset_mode": "SameStep"})
    with pytest.warns(UserWarning, match="the agent cannot be saved: files of agents do not keep autoreset_mode"):
        train(loop, 32, 0, hyperparams={"n_envs": 2, "n_steps": 16, "batch_size": 8})


def test_certificate_of_another_plant_is_not_saved(agent, tmp_path):
    other = certificate_of(truck_trailer())
    with pytest.raises(ValueError, match="another plant"):
        agent.save(tmp_path / "x", ShieldSettings(other))
    assert not (tmp_path / "x").exists()


def test_model_file_is_stable_baselines3s(folder, agent):
    from stable_baselines3 import PPO

    scaled = agent.normalization(OBSERVATIONS)
    again = PPO.load(folder / "model.zip").predict(scaled, deterministic=True)[0]
    np.testing.assert_array_equal(again, agent.act(OBSERVATIONS))


def test_normalization_is_that_of_training():
    from stable_baselines3.common.vec_env import VecNormalize

    from agents import SB3VecEnv

    env = VecNormalize(SB3VecEnv(LoopConfig(env=CRUISE).vector(4)))
    env.reset()
    for _ in range(50):
        env.step(np.ones((4, 1), np.float32))
    np.testing.assert_array_equal(
        Normalization.of(env)(100 * OBSERVATIONS), env.normalize_obs(100 * OBSERVATIONS).astype(np.float32)
    )


def test_weights_with_code_in_them_are_refused(folder):
    import torch

    class Evil:
        def __reduce__(self):
            return (print, ("run!",))

    torch.save({"policy": Evil()}, folder / "policy.pth")
    with zipfile.ZipFile(folder / "model.zip") as source, zipfile.ZipFile(folder / "new.zip", "w") as target:
        for name in source.namelist():
            content = (folder / "policy.pth").read_bytes() if name == "policy.pth" else source.read(name)
            target.writestr(name, content)
    rewrite(folder, (folder / "new.zip").read_bytes())
    with pytest.raises(AgentError, match="damaged"):
        Agent.load(folder)


SHORT = {"mean": [0.0], "variance": [1.0], "epsilon": 1, "clip": 1}


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda folder: (folder / "agent.json").unlink(), "No such file"),
        (lambda folder: (folder / "agent.json").write_text("{"), "not valid JSON"),
        (lambda folder: (folder / "agent.json").write_text("[]"), "not of format"),
        (lambda folder: (folder / "agent.json").write_text('{"format": "ncs-gym agent 3"}'), "is not the one that"),
        (lambda folder: (folder / "model.zip").write_bytes(b"PK"), "is not the one that"),
        (lambda folder: rewrite(folder, b"PK"), "wasn't a zip-file"),
        (lambda folder: change(folder, env="Nowhere-v0"), "Nowhere-v0, which is not registered"),
        (lambda folder: change(folder, env="ncs_gym/TruckTrailer-v0"), "another plant"),
        (lambda folder: change(folder, algorithm="DQN"), "unknown algorithm"),
        (lambda folder: change(folder, hyperparams={"tensorboard_log": "/"}), "damaged: PPO: unknown hyperparameter"),
        (lambda folder: change(folder, channel={"loss": 7}), "damaged"),
        (lambda folder: change(folder, base_policy=[[1.0, 1.0]]), "of another version: it has 'base_policy'"),
        (lambda folder: change(folder, normalization=SHORT), "saw observations of 1 entries, those of .* now: it is"),
    ],
)
def test_damaged_and_foreign_agents_are_one_sentence(folder, damage, words):
    damage(folder)
    with pytest.raises(AgentError, match=words) as caught:
        Agent.load(folder)
    assert "\n" not in str(caught.value)
