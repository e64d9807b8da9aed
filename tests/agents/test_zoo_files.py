"""Hyperparameter files of rl-zoo3: what they hold is read without evaluating it, or it is named."""

from pathlib import Path

import numpy as np
import pytest
from torch import nn

from agents import Agent, LoopConfig, read_hyperparams, train
from agents.agent_file import AgentError
from agents.hyperparams import RL_ZOO_KEYS, value_of
from agents.training import untrained

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "rl_zoo" / "ncs.yml"


def file_of(folder, text):
    (folder / "zoo.yml").write_text(f"{CRUISE}:\n{text}")
    return folder / "zoo.yml"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        (
            "dict(log_std_init=-2, ortho_init=False, activation_fn=nn.ReLU, net_arch=dict(pi=[256, 256], vf=[8]))",
            {
                "log_std_init": -2,
                "ortho_init": False,
                "activation_fn": "nn.ReLU",
                "net_arch": {"pi": [256, 256], "vf": [8]},
            },
        ),
        ("dict(\n  activation_fn=torch.nn.GELU,\n  net_arch=[]\n)", {"activation_fn": "nn.GELU", "net_arch": []}),
        ("{'activation_fn': th.nn.Tanh}", {"activation_fn": "nn.Tanh"}),
        ("dict(net_arch=dict(pi=[256, 256], qf=[1024]))", {"net_arch": {"pi": [256, 256], "qf": [1024]}}),
        ("{'norm_obs': True, 'norm_reward': False}", {"norm_obs": True, "norm_reward": False}),
        ("dict(info_keywords=('a', 'b'))", {"info_keywords": ["a", "b"]}),
        ("auto_0.1", "auto_0.1"),
        ("lin_7.3e-4", "lin_7.3e-4"),
        ("MlpPolicy", "MlpPolicy"),
        (3, 3),
    ],
)
def test_values_of_the_zoo_are_read(text, value):
    assert value_of("policy_kwargs", text) == value


@pytest.mark.parametrize(
    ("text", "culprit"),
    [
        ("dict(optimizer_class=RMSpropTFLike, optimizer_kwargs=dict(eps=1e-5))", "'RMSpropTFLike'"),
        ("dict(net_arch=[64], features_extractor_class=mine.Extractor)", "'mine.Extractor'"),
        ("dict(net_arch=[width, 64])", "'width'"),
        ("dict(a=__import__('os').system('true'))", r'"__import__\(.os.\)'),
        ("dict(net_arch=[64] * 2)", r"'\[64\] \* 2'"),
        ("dict(a=[x for x in (1, 2)])", "'x'"),
        ("dict(a=lambda: 1)", "'lambda: 1'"),
        ("dict(**given)", r"'dict\(\*\*given\)'"),
        ("dict(a=1, a=2)", r"'dict\(a=1, a=2\)'"),
        ("dict(net_arch=[64, 64]", r"'dict\(net_arch=\[64, 64\]'"),
        ("[64, x", r"'\[64, x'"),
        ("nn.ReLU()", r"'nn.ReLU\(\)'"),
    ],
)
def test_what_cannot_be_read_is_named_with_its_key_and_file(text, culprit, tmp_path):
    file = file_of(tmp_path, f'  policy_kwargs: "{text}"\n' if '"' not in text else f"  policy_kwargs: '{text}'\n")
    with pytest.raises(ValueError, match=f"zoo.yml: cannot read {culprit}.* in policy_kwargs: ") as caught:
        read_hyperparams(file, CRUISE)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("entry", ["n_steps: 2001-01-01", "2001-01-01: 3", "policy_kwargs: {net_arch: !!set {8}}"])
def test_value_that_json_has_not_is_named_with_its_key_and_file(entry, tmp_path):
    said = "zoo.yml: hyperparameters must be JSON values, got "
    with pytest.raises(ValueError, match=said) as caught:
        read_hyperparams(file_of(tmp_path, f"  gamma: 0.9\n  {entry}\n"), CRUISE)
    assert entry.split(":")[0].replace("2001-01-01", "datetime.date(2001, 1, 1)") in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "value", ["!!bool maybe", "!!int ''", "!!float half", "!!timestamp now", "2001-99-99", "1" + ":1" * 400 + ".0"]
)
def test_value_that_is_none_of_its_tag_is_one_sentence(value, tmp_path):
    with pytest.raises(ValueError, match=r"hyperparameters .*zoo\.yml are damaged: ") as caught:
        read_hyperparams(file_of(tmp_path, f"  gamma: {value}\n"), CRUISE)
    assert "\n" not in str(caught.value)


def test_keys_of_the_zoo_itself_are_left_out_with_a_note(tmp_path):
    keys = "".join(f"  {name}: something\n" for name in RL_ZOO_KEYS)
    with pytest.warns(UserWarning, match="only rl-zoo3 reads that, it is left out here") as caught:
        assert read_hyperparams(file_of(tmp_path, keys + "  gamma: 0.9\n"), CRUISE) == {"gamma": 0.9}
    assert all(name in str(caught[0].message) for name in RL_ZOO_KEYS)


@pytest.mark.filterwarnings("error")
def test_no_note_for_a_key_without_a_value(tmp_path):
    assert read_hyperparams(file_of(tmp_path, "  env_wrapper: null\n  gamma: 0.9\n"), CRUISE) == {"gamma": 0.9}


def test_agent_is_trained_with_the_example_s_file():
    with pytest.warns(UserWarning, match="callback, env_wrapper, monitor_kwargs in "):
        given = read_hyperparams(EXAMPLE, CRUISE)
    given |= {"n_envs": 2, "n_steps": 4, "batch_size": 8}
    agent = train(LoopConfig(env=CRUISE), algorithm="PPO", steps=8, seed=0, hyperparams=given).agent
    assert agent.hyperparams["learning_rate"] == "lin_1e-3"


@pytest.mark.parametrize(("name", "kind"), [("nn.ReLU", nn.ReLU), ("GELU", nn.GELU)])
@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_activation_function_is_that_of_torch_and_survives_the_files(name, kind, algorithm, tmp_path):
    policy = {"net_arch": [8], "activation_fn": name}
    agent = untrained(LoopConfig(env=CRUISE), algorithm=algorithm, seed=0, hyperparams={"policy_kwargs": policy})
    assert any(isinstance(module, kind) for module in agent.model.policy.modules())
    agent.save(tmp_path)
    again = Agent.load(tmp_path)
    observations = np.random.default_rng(0).standard_normal((5, 3))
    np.testing.assert_array_equal(again.act(observations), agent.act(observations))


@pytest.mark.parametrize(
    "name",
    [
        "nn.Linear",
        "nn.Module",
        "os.system",
        "nn.modules",
        "nn.__doc__",
        "",
        "GLU",
        "nn.Softmax2d",
        3,
        "nn.MultiheadAttention",
    ],
)
def test_what_is_no_activation_function_is_named(name):
    with pytest.raises(ValueError, match="no activation function") as caught:
        untrained(LoopConfig(env=CRUISE), seed=0, hyperparams={"policy_kwargs": {"activation_fn": name}})
    assert "\n" not in str(caught.value)
    assert not isinstance(caught.value, AgentError)
