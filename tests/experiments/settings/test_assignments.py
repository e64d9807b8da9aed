"""Settings given as NAME=VALUE."""

import pytest

from experiments.__main__ import _parse


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
