"""Hyperparameters: those tuned for each environment, and the activation functions of networks."""

import json
from pathlib import Path

import numpy as np
import pytest
from torch import nn

import agents
from agents import Agent, LoopConfig, tuned_hyperparams, tuned_steps, untrained
from agents.hyperparams import DEFAULTS, complete_hyperparams, with_changes
from ncs_gym.registration import ENVIRONMENTS, needing_extras, registered_ids

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
# Those of the three have the defaults: none were sought.
DEFAULT = {
    f"ncs_gym/{name}-v0" for name in ("CSTR", "Convoy", "ConvoyOnRequest", "LaneKeeping", "LaneKeepingOnRequest")
}
OWN = [env_id for env_id in ENVIRONMENTS if env_id in {*registered_ids(), *needing_extras()} - DEFAULT]


def test_tuned_are_registered_environments():
    assert set(json.loads((Path(agents.__file__).parent / "tuned" / "ppo.json").read_text())) == set(OWN)
    assert len(OWN) == 9
    for env_id in OWN:
        assert tuned_hyperparams(env_id).keys() == DEFAULTS["PPO"].keys()
        assert tuned_steps(env_id) >= 100_000


@pytest.mark.parametrize("given", [("ncs_gym/LinearNCS-v0",), ("ncs_gym/CartPole-v0", "SAC")])
def test_plant_of_ones_own_and_algorithm_that_was_not_tuned_have_none(given):
    assert tuned_hyperparams(*given) is None
    assert tuned_steps(*given) is None


def test_part_of_the_networks_arguments_may_be_changed():
    changed = with_changes(DEFAULTS["PPO"], {"gamma": 0.99, "policy_kwargs": {"net_arch": [8]}})
    expected = {"gamma": 0.99, "policy_kwargs": {"net_arch": [8], "log_std_init": -0.7}}
    assert changed == DEFAULTS["PPO"] | expected
    assert complete_hyperparams("PPO", expected) == changed
    assert DEFAULTS["PPO"]["policy_kwargs"]["net_arch"] == [64, 64]


@pytest.mark.parametrize(("name", "kind", "algorithm"), [("nn.ReLU", nn.ReLU, "PPO"), ("GELU", nn.GELU, "SAC")])
def test_activation_function_is_that_of_torch_and_survives_the_files(name, kind, algorithm, tmp_path):
    policy = {"net_arch": [8], "activation_fn": name}
    agent = untrained(LoopConfig(env=CRUISE), 0, algorithm, {"policy_kwargs": policy})
    assert any(isinstance(module, kind) for module in agent.model.policy.modules())
    agent.save(tmp_path)
    again = Agent.load(tmp_path)
    observations = np.random.default_rng(0).standard_normal((5, 3))
    np.testing.assert_array_equal(again.act(observations), agent.act(observations))
