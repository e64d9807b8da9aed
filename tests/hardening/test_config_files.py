"""Files given to `--config`: one sentence and exit code 2, or settings that mean what the file says."""

import json
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.settings import CompareSettings, SweepSettings
from experiments.settings.settings_file import FORMAT, settings_json
from tests.command import assert_one_sentence, ncs
from tests.fuzz import JSON_VALUES as JSON
from tests.fuzz import examples

OF_THE_MACHINE = ("engine", "ray_address", "ray_wait", "cpus_per_run", "gpus_per_run")  # which are not read
GOOD = {"compare": CompareSettings(), "sweep": SweepSettings()}
NAMES = sorted(
    {*settings_json("compare", CompareSettings())["settings"], "no-smoke", "smoke=", "x", "hyperparams.gamma", "--seed"}
)
SETTINGS = st.dictionaries(st.sampled_from(NAMES) | st.text(max_size=6), JSON, min_size=1, max_size=2)
NESTED = st.dictionaries(
    st.sampled_from(["channel", "hyperparams"]),
    st.dictionaries(
        st.sampled_from(["loss", "delay", "gamma", "learning_rate", "policy_kwargs", "n_epochs"]), JSON, max_size=2
    ),
    min_size=1,
)


def outcome(data, folder, command="compare"):
    """What `ncs` makes of a file: the settings it would run with, or None after one sentence."""
    path = folder / "settings.json"
    path.write_bytes(data)
    with mock.patch("experiments.__main__._run") as run:
        ended = ncs(command, "--config", path)
    if ended.returncode == 0:
        return run.call_args.args[0]
    assert_one_sentence(ended, "settings")
    assert not run.called
    return None


def document(values, command="compare"):
    return json.dumps({"format": FORMAT, "command": command, "settings": values}).encode()


def assert_means(given, read):
    """What a file gives is what was read, of the same kind; a whole number may stand for a float."""
    if isinstance(given, dict):
        for name, value in given.items():
            assert_means(value, read[name])
    elif isinstance(given, list):
        assert len(given) == len(read)
        for one, other in zip(given, read, strict=True):
            assert_means(one, other)
    else:
        kinds = {type(given), type(read)}
        assert len(kinds) == 1 or kinds == {int, float}
        assert given == read


def assert_refused_or_meant(values, folder):
    read = outcome(document(values), folder)
    if read is not None:
        paths = ("out", "certificate", "config", *OF_THE_MACHINE)
        whole = settings_json("compare", read)["settings"]
        assert_means({name: value for name, value in values.items() if name not in paths}, whole)
        untouched = settings_json("compare", CompareSettings())["settings"]
        assert {name: whole[name] for name in whole if name not in values} == {
            name: untouched[name] for name in whole if name not in values
        }


@pytest.mark.parametrize("count", [20, pytest.param(3000, marks=pytest.mark.slow)])
def test_values_are_refused_or_meant(count, tmp_path):
    @given(values=SETTINGS | NESTED)
    @examples(count, same=count < 100)
    def check(values):
        assert_refused_or_meant(values, tmp_path)

    check()


@given(whole=JSON)
@examples(15)
def test_documents_of_any_structure_are_refused(tmp_path_factory, whole):
    folder = tmp_path_factory.getbasetemp()
    for content in (whole, {"format": FORMAT, "command": whole, "settings": {}}, {"format": FORMAT, "settings": whole}):
        assert outcome(json.dumps(content).encode(), folder) is None


@pytest.mark.parametrize("command", GOOD)
def test_damaged_files_are_refused_or_meant(command, tmp_path):
    data = document(settings_json(command, GOOD[command])["settings"], command)
    assert outcome(data, tmp_path, command) == GOOD[command]
    for at in range(0, len(data), 97):
        assert outcome(data[:at], tmp_path, command) is None
        assert outcome(data[:at] + bytes([data[at] ^ 0x80]) + data[at + 1 :], tmp_path, command) is None


@given(data=st.binary(max_size=200))
@examples(20)
def test_bytes_are_refused(tmp_path_factory, data):
    assert outcome(data, tmp_path_factory.getbasetemp()) is None
