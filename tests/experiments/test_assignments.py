"""Settings given as NAME=VALUE."""

import pytest

from experiments.__main__ import parse


def channel_of(*arguments):
    return parse(["compare", *arguments]).channel


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.5", 0.5),
        ("null", None),
        ('{"pi": [64]}', {"pi": [64]}),
        ("lin_0.1", "lin_0.1"),
        ("nn.ReLU", "nn.ReLU"),
    ],
)
def test_value_is_a_json_value_or_a_word(text, value):
    given = channel_of("--channel", f"loss={text}")
    assert given == {"loss": value}
    assert type(given["loss"]) is type(value)


@pytest.mark.parametrize("text", ["dict(a=1)", "[64", "", "a b"])
def test_what_is_neither_names_the_form(text, capsys):
    with pytest.raises(SystemExit):
        channel_of("--channel", f"loss={text}")
    assert "expected loss=VALUE with a word or a JSON value" in " ".join(capsys.readouterr().err.split())
