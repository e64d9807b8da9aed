"""The agents that come with the package: one for every id, small, and safe behind the shield of its certificate."""

import json

import gymnasium as gym
import pytest

from agents import AgentError, LoopConfig, ShieldSettings, evaluate, pretrained, pretrained_folder
from benchmarks.learning import PACKAGE_SEED, seeds_of
from ncs_gym.registration import ENVIRONMENTS
from shields import certificate_for
from tests.command import succeeded

IDS = [env_id for env_id, each in ENVIRONMENTS.items() if each.plant is not None]
LARGEST = 200_000


def folder_of(env_id):
    try:
        return pretrained_folder(env_id)
    except AgentError:
        pytest.fail(f"{env_id} has no pretrained agent: python -m benchmarks.learning pretrained --env {env_id}")


@pytest.mark.parametrize("env_id", IDS)
def test_every_id_has_a_small_agent_that_says_how_it_was_trained(env_id):
    files = {file.name: file.stat().st_size for file in folder_of(env_id).iterdir()}
    assert files.keys() == {"model.zip", "agent.json"}
    assert sum(files.values()) < LARGEST
    document = json.loads((folder_of(env_id) / "agent.json").read_text())
    assert (document["env"], document["algorithm"]) == (env_id, "PPO")
    assert document["seed"] == seeds_of(PACKAGE_SEED, 0)[0]
    assert document["versions"]["stable-baselines3"].startswith("2.")


@pytest.mark.cases(1)
@pytest.mark.parametrize("env_id", IDS)
def test_every_agent_keeps_its_plant_safe_behind_its_shield(env_id):
    if not ENVIRONMENTS[env_id].is_installed:
        pytest.skip(f"{env_id} needs {ENVIRONMENTS[env_id].extra}")
    env = gym.make(env_id).unwrapped
    certificate, agent = certificate_for(env.plant, env.certificate_contract), pretrained(env_id)
    assert (agent.env, agent.channel, agent.shield_mode) == (env_id, None, "project")
    loop = LoopConfig(env=env_id, shield=ShieldSettings(certificate, "project", on_unproved="raise"))
    episode = evaluate(loop, lambda observations, infos: agent.act(observations), 1, seed=0).episodes[0]
    assert (episode.steps, episode.violation_steps, episode.guaranteed) == (200, 0, True)


def test_ids_without_an_agent_are_one_sentence(tmp_path):
    with pytest.raises(AgentError, match="no pretrained agent of 'Plants/CSTR-v0', only of ncs_gym/BatchReactor-v0"):
        pretrained("Plants/CSTR-v0")


def test_commands_take_pretrained_agents(tmp_path):
    run = succeeded("evaluate", "pretrained", "--env", "ncs_gym/CSTR-v0", "--episodes", 1)
    assert "PPO of" in run.stdout
    assert "shield: project" in run.stdout
    out = tmp_path / "episode.png"
    succeeded("render", "--env", "ncs_gym/CSTR-v0", "--policy", "pretrained", "--steps", 3, "--out", out)
    assert out.exists()


def test_missing_package_of_an_environment_is_no_damage(monkeypatch):
    monkeypatch.setattr("ncs_gym.processes.mujoco_pendulum.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match="InvertedPendulum-v5 needs MuJoCo"):
        pretrained("ncs_gym/InvertedPendulum-v0")
