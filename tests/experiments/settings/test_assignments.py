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
