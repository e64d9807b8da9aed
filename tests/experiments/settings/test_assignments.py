"""Settings given as NAME=VALUE."""

import pytest

from experiments.__main__ import _parse
from experiments.settings.assignments import with_assignments


def channel_of(*arguments):
    return _parse(["compare", *arguments]).channel


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.5", 0.5),
        ("3", 3),
        ("None", None),
        ("True", True),
        ("[64, 64]", [64, 64]),
        ("1e-3", 0.001),
        ("lin_0.1", "lin_0.1"),
    ],
)
def test_value_is_what_it_is_in_python(text, value):
    given = channel_of("--channel", f"loss={text}")
    assert given == {"loss": value}
    assert type(given["loss"]) is type(value)


def test_value_that_no_file_can_keep_stays_a_text():
    assert channel_of("--channel", "loss=1e999", "delay={1, 2}", "jitter=b'1'") == {
        "loss": "1e999",
        "delay": "{1, 2}",
        "jitter": "b'1'",
    }


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["loss"], "expected NAME=VALUE"),
        (["=0.5"], "expected NAME=VALUE"),
        (["my loss=0.5"], "expected NAME=VALUE"),
        (["loss=0.1", "loss=0.2"], "loss is given twice"),
    ],
)
def test_what_is_no_assignment_is_refused(texts, words, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        _parse(["compare", "--channel", *texts])
    assert words in capsys.readouterr().err


def test_dotted_flags_mean_the_same():
    dotted = channel_of("--channel.loss", "0.5", "--seed", "3", "--channel.burst-length=4")
    assert dotted == channel_of("--channel", "loss=0.5", "burst_length=4") == {"loss": 0.5, "burst_length": 4}
    mixed = channel_of("--channel.delay", "2", "--channel", "loss=0.5", "--seed", "3")
    assert mixed == {"delay": 2, "loss": 0.5}


@pytest.mark.parametrize(
    ("algo", "former", "now"),
    [
        ([], ["--ppo.discount", "0.8", "--ppo.envs=4"], ["gamma=0.8", "n_envs=4"]),
        ([], ["--ppo.width=8", "--ppo.log-std=-1"], ["policy_kwargs=dict(net_arch=[8, 8], log_std_init=-1)"]),
        (["--algo", "TRPO"], ["--ppo.epochs", "3"], ["n_critic_updates=3"]),
        (["--algo=A2C"], ["--a2c.rollout", "4", "--a2c.discount", "0.5"], ["n_steps=4", "gamma=0.5"]),
        (["--algo=TD3"], ["--off-policy.noise", "0.3", "--hyperparams", "gamma=0.8"], ["noise_std=0.3", "gamma=0.8"]),
        (["--algo", "SAC"], ["--off-policy.noise", "0.3", "--off-policy.envs", "4"], ["n_envs=4"]),
    ],
)
def test_former_flags_mean_hyperparameters(algo, former, now):
    assert _parse(["compare", *algo, *former]) == _parse(["compare", *algo, "--hyperparams", *now])


def test_other_arguments_stay_as_they_are():
    given = ["compare", "--out", "--channel", "loss=0.5"]
    assert with_assignments(given) == given
