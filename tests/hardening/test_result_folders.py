"""Folders of results that somebody else made: data, which writes nothing elsewhere and is whole or refused."""

import hashlib
import json
import os
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.agent_file import AgentError
from experiments.analysis.episodes import arm_summary, episodes_table, parquet, training_table
from experiments.errors import ResultsError
from experiments.report.text_tables import summary_text
from experiments.runs.output_folder import claim_folder
from experiments.runs.run_store import RunStore, file_name
from experiments.settings import CompareSettings
from shields.json_documents import document_of
from tests.command import assert_one_sentence, ncs
from tests.experiments.results import training_run
from tests.fuzz import JSON_VALUES, examples

# Names that lead out of a folder on some system, and names that are only wrong.
NAMES = ["../x.py", "../../x.py", "/{root}/x.py", "sub/x.py", "..\\x.py", "C:\\x.py", "C:x.py", "\\\\host\\share\\x"]
NAMES += ["", ".", "..", "x\0y", "x" * 300, "model.zip\0", "model.zip/", "./model.zip", "MODEL.ZIP", "README.md"]
NAMES += ["\ud800"]


@pytest.fixture(scope="module")
def run(certificate):
    return training_run(certificate, "project", scenarios=("gaussian",))


@pytest.fixture(scope="module")
def result(run):
    return run.execute(lambda steps: None)


@pytest.fixture(scope="module")
def stored(run, result, tmp_path_factory):
    """A folder with one result, for tests that put back what they change."""
    folder = tmp_path_factory.mktemp("stored")
    RunStore(folder).save(run, result)
    return folder


def file_of(folder, run):
    return folder / "runs" / file_name(run)


def signed(content):
    """The text of a file with a right checksum."""
    return json.dumps(document_of("run", "ncs-gym run 3", content))


def forged(folder, run, change):
    """Changes a stored result; the checksum is that of the new one."""
    path = file_of(folder, run)
    document = json.loads(path.read_bytes())
    change(document["run"]["result"])
    path.write_text(signed(document["run"]))


def everything_in(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


@pytest.mark.cases(6)
@pytest.mark.parametrize("name", NAMES)
def test_result_that_names_another_file_than_those_of_an_agent_is_refused(name, run, result, tmp_path):
    name, folder = name.replace("/{root}", str(tmp_path)), tmp_path / "a" / "study"
    RunStore(folder).save(run, result)
    digest = hashlib.sha256(b"print('mine')").hexdigest()
    try:
        (folder / "models" / run.name / name).write_bytes(b"print('mine')")
    except (OSError, ValueError):
        digest = hashlib.sha256(b"").hexdigest()  # as of a file that is missing
    forged(folder, run, lambda content: content["files"].update({name: digest}))
    with pytest.raises(ResultsError, match="delete it to repeat the run"):
        RunStore(folder).load(run)


@pytest.mark.parametrize("name", NAMES)
def test_files_of_other_names_are_not_written(name, run, result, tmp_path, monkeypatch):
    name, inside = name.replace("/{root}", str(tmp_path)), tmp_path / "a" / "b"
    inside.mkdir(parents=True)
    store = RunStore(inside)
    monkeypatch.setattr("tempfile.tempdir", str(inside))
    before = everything_in(tmp_path)
    other = replace(run, policy_kind="untrained", agent_files={**result.files, name: b"print('mine')"})
    with pytest.raises(AgentError, match="an agent has no file of the name"):
        other.execute(lambda steps: None)
    with pytest.raises(AgentError, match="an agent has no file of the name"):
        store.save(run, replace(result, files={name: b"print('mine')", **result.files}))
    assert everything_in(tmp_path) == before


LINKS = ["runs", "models", "models/shielded-0", "figures", "tensorboard", "channels", "runs/shielded-0.json"]


@pytest.mark.cases(6)
@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize("is_there", [True, False])
def test_links_in_an_output_folder_are_refused_before_anything_is_written(name, is_there, tmp_path):
    mine, out = tmp_path / "mine", tmp_path / "theirs"
    mine.mkdir()
    (mine / "photo.png").write_bytes(b"png")
    (mine / "secret").write_text("no line ends here")
    (out / name).parent.mkdir(parents=True)
    target = mine / "secret" if "." in name else mine
    (out / name).symlink_to(target if is_there else mine / "new")
    before = everything_in(tmp_path)
    assert_one_sentence(ncs("compare", "--smoke", "--out", out), f"{name} is a link", "give another --out")
    assert everything_in(tmp_path) == before


def test_pipes_in_an_output_folder_are_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "runs")
    with (
        pytest.raises(ResultsError, match=r"runs is neither a file nor a folder"),
        claim_folder("compare", CompareSettings(out=tmp_path)),
    ):
        pass


def test_the_output_folder_itself_may_be_reached_by_a_link(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "runs").symlink_to(tmp_path / "disk")
    with claim_folder("compare", CompareSettings(out=tmp_path / "runs")):
        pass
    assert [path.name for path in (tmp_path / "disk").iterdir()] == ["settings.json"]


def test_only_files_that_commands_write_are_removed_before_they_are_written_again(tmp_path):
    (tmp_path / "figures").mkdir()
    for name in ("data.parquet", "figures/photo.png", "notes.html"):
        (tmp_path / name).write_text("mine")
    before = everything_in(tmp_path)
    for name in ("summary.json", "report.html", "episodes.parquet", "figures/episode.png"):
        (tmp_path / name).write_text("{}")
    with claim_folder("compare", CompareSettings(out=tmp_path, force=True)):
        (tmp_path / "settings.json").unlink()
    assert everything_in(tmp_path) == before


CHANGES = [
    ("arm", lambda c: c.update(arm="unshielded")),
    ("arm", lambda c: c.update(arm=[])),
    ("index", lambda c: c.update(index=1)),
    ("index", lambda c: c.update(index=False)),
    ("train_steps", lambda c: c.update(train_steps=0)),
    ("train_steps", lambda c: c.update(train_steps=10**400)),
    ("train_violation_steps", lambda c: c.update(train_violation_steps=-1)),
    ("train_violation_steps", lambda c: c.update(train_violation_steps=10**6)),
    ("train_interventions", lambda c: c.update(train_interventions="7")),
    ("history", lambda c: c.update(history=[])),
    ("history", lambda c: c["history"].reverse()),
    ("history", lambda c: c["history"][0].update(steps=-64)),
    ("history", lambda c: c["history"][0].pop("steps")),
    ("episodes", lambda c: c.update(episodes=[])),
    ("episodes", lambda c: c.update(episodes={})),
    ("episodes", lambda c: c["episodes"].pop()),
    ("episodes", lambda c: c["episodes"].append(c["episodes"][0])),
    ("episodes", lambda c: c["episodes"][0].update(index=1)),
    ("episodes", lambda c: c["episodes"][0].update(steps=0)),
    ("episodes", lambda c: c["episodes"][0].update(violation_steps=-3)),
    ("episodes", lambda c: c["episodes"][0].update(violation_steps=10**4)),
    ("episodes", lambda c: c["episodes"][0].update(interventions=1.5)),
    ("episodes", lambda c: c["episodes"][0].update(episode_return=float("inf"))),
    ("episodes", lambda c: c["episodes"][0].update(episode_return=None)),
    ("episodes", lambda c: c["episodes"][0].update(largest_level=-1.0)),
    ("episodes", lambda c: c["episodes"][0].update(guaranteed=1)),
    ("episodes", lambda c: c["episodes"][0].update(more=1)),
    ("episodes", lambda c: c["episodes"].__setitem__(0, None)),
    ("scenarios", lambda c: c.update(scenarios={})),
    ("scenarios", lambda c: c.update(scenarios=["gaussian"])),
    ("scenarios", lambda c: c["scenarios"].update(better=c["episodes"])),
    ("scenarios", lambda c: c["scenarios"].update(gaussian=[])),
    ("trajectory", lambda c: c["trajectory"].pop("states")),
    ("trajectory", lambda c: c["trajectory"].update(states=[])),
    ("trajectory", lambda c: c["trajectory"]["states"].pop()),
    ("trajectory", lambda c: c["trajectory"]["states"][0].append(0.0)),
    ("trajectory", lambda c: c["trajectory"]["states"].__setitem__(0, [float("nan")] * 2)),
    ("trajectory", lambda c: c["trajectory"].update(states=[[True, True]] * len(c["trajectory"]["states"]))),
    ("trajectory", lambda c: c["trajectory"].update(arrivals=["no"] * len(c["trajectory"]["arrivals"]))),
    ("trajectory", lambda c: c["trajectory"].update(inputs=[[0.0, 0.0]] * len(c["trajectory"]["inputs"]))),
    ("files", lambda c: c.update(files={})),
    ("files", lambda c: c.update(files=["model.zip", "agent.json"])),
    ("files", lambda c: c["files"].update({"agent.json": None})),
    ("entries", lambda c: c.pop("history")),
    ("more", lambda c: c.update(more=1)),
]


@pytest.mark.parametrize(("named", "change"), CHANGES, ids=range(len(CHANGES)))
def test_forged_results_are_one_sentence_that_names_what_is_wrong(named, change, stored, run):
    before = file_of(stored, run).read_bytes()
    try:
        forged(stored, run, change)
        with pytest.raises(ResultsError, match="delete it to repeat the run") as caught:
            RunStore(stored).load(run)
    finally:
        file_of(stored, run).write_bytes(before)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def places_in(value, at=()):
    """Where something stands in a JSON value; of long lists the first and the last entry."""
    yield at
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, each in entries:
        if isinstance(value, dict) or key in (0, len(value) - 1):
            yield from places_in(each, (*at, key))


def replaced(value, at, by):
    """A JSON value in which something else stands somewhere."""
    if not at:
        return by
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[at[0]] = replaced(value[at[0]], at[1:], by)
    return copy


def assert_refused_or_usable(data, folder, run):
    """What is not refused passes through everything that is made of results."""
    before = file_of(folder, run).read_bytes()
    content = json.loads(before)["run"]["result"]
    at = data.draw(st.sampled_from(list(places_in(content))), label="at")
    other = replaced(content, at, data.draw(JSON_VALUES, label="by"))
    try:
        file_of(folder, run).write_text(signed(json.loads(before)["run"] | {"result": other}))
        result = RunStore(folder).load(run)
    except ResultsError:
        return
    finally:
        file_of(folder, run).write_bytes(before)
    episodes = episodes_table([result])
    arms = {run.arm: arm_summary(episodes, "project", fixed_policy=False)}
    json.dumps(arms, allow_nan=False)
    summary_text(arms, {})
    parquet(episodes, {})
    parquet(training_table([result]), {})


@given(data=st.data())
@examples(150)
def test_changed_results_are_refused_or_usable(data, stored, run):
    assert_refused_or_usable(data, stored, run)


@pytest.mark.slow
@given(data=st.data())
@examples(5000, same=False)
def test_many_changed_results_are_refused_or_usable(data, stored, run):
    assert_refused_or_usable(data, stored, run)


@pytest.mark.parametrize(
    "settings", [[[1, 2]], [["seed", 1]], {"": 1}, {"seed": {"a": {}}}, {"ppo": 3}, {"hyperparams": 3}, {"arms": [[]]}]
)
def test_forged_settings_of_finished_results_are_one_sentence(settings, tmp_path):
    (tmp_path / "summary.json").write_text("{}")
    document = {"format": "ncs-gym settings 1", "command": "compare", "settings": settings}
    (tmp_path / "settings.json").write_text(json.dumps(document))
    assert_one_sentence(ncs("compare", "--smoke", "--out", tmp_path), "holds finished results")
