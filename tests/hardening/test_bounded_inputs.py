"""Small files and messages that would take memory or time without bound; each is refused before it is expanded."""

import base64
import io
import json
import os
import pickle
import re
import socket
import tracemalloc
import zipfile
from contextlib import contextmanager, suppress
from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import Ellipsoid, LinearPlant, PacketLog, Remainder, TraceChannel, truck_trailer
from ncs_gym.reading import (
    LARGEST_DOCUMENT,
    LARGEST_HYPERPARAMS,
    LARGEST_LOG,
    MOST_LINES,
    MOST_PACKETS,
    MOST_VALUES,
    json_values,
    read_file,
    read_text,
)
from shields import Certificate, CertificateError
from shields.json_documents import document_of
from shields.verification.between_samples import between_conditions
from tests.certificates import certificate_of

pytestmark = pytest.mark.filterwarnings("ignore:the times in")


@contextmanager
def little_memory(most=64 << 20):
    """Fails unless what is done inside takes little memory, as Python counts it."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


@pytest.fixture
def write(tmp_path):
    def write(name, content):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


# Files that never end, and one that nobody writes to.
ENDLESS = ["/dev/zero", "pipe"]


@pytest.fixture(params=ENDLESS)
def endless(request, tmp_path):
    if request.param == "pipe":
        os.mkfifo(tmp_path / "pipe")
        return tmp_path / "pipe"
    return request.param


def readers():
    from agents.hyperparams import read_hyperparams

    return {
        "bytes": read_file,
        "text": read_text,
        "plant": LinearPlant.load,
        "certificate": Certificate.load,
        "packets": PacketLog.load,
        "hyperparameters": lambda path: read_hyperparams(path, "ncs_gym/CSTR-v0"),
    }


NAMES = ["bytes", "text", "plant", "certificate", "packets", "hyperparameters"]


@pytest.mark.parametrize("name", NAMES)
def test_pipes_and_devices_are_refused_by_every_reader_of_files(name, endless):
    with little_memory(), pytest.raises((OSError, ValueError), match="not a regular file"):
        readers()[name](endless)


@pytest.mark.parametrize("name", NAMES)
def test_file_of_many_bytes_is_refused_before_it_is_read(name, tmp_path):
    path = tmp_path / "large"
    with open(path, "wb") as file:
        file.truncate(LARGEST_LOG + 1)  # takes no place on the disk
    with little_memory(), pytest.raises((OSError, ValueError), match="has more than"):
        readers()[name](path)


def test_folders_and_missing_files_are_named_as_such(tmp_path):
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(OSError, match=re.escape(path.name)):
            read_file(path)


def test_link_to_a_file_is_read(write, tmp_path):
    (tmp_path / "link").symlink_to(write("file", "text\r\n"))
    assert read_text(tmp_path / "link") == "text\n"


@pytest.mark.parametrize("part", ["[],", "{},", "0,", '"",'])
def test_json_of_many_values_is_refused_before_it_is_expanded(part, write):
    text = f"[{part * MOST_VALUES}0]"
    assert len(text) < LARGEST_DOCUMENT
    with little_memory(), pytest.raises(ValueError, match="values"):
        json_values(text)
    with little_memory(100 << 20), pytest.raises(CertificateError, match="not valid JSON"):
        Certificate.load(write("certificate.json", text))
    assert json_values("[1, 2]") == [1, 2]


LOGS = {
    "ping numbers": "icmp_seq=1 ttl=1 time=1 ms\n64 bytes: icmp_seq=10000000000 ttl=1 time=1 ms\n",
    "steps": "episode,sent,received\n1,1,1\n1,1000000000000,1000000000001\n",
    "steps of episodes": "episode,sent,received\n"
    + "".join(f"{episode},{MOST_PACKETS // 2},{MOST_PACKETS}\n" for episode in range(3)),
    "ping summary": "64 bytes: icmp_seq=1 ttl=1 time=1 ms\n"
    "9999999999 packets transmitted, 1 received, 99% packet loss, time 1000ms\n",
    "missing numbers": "seq,sent,received\n1,0,0.1\n9000000000,1,1.1\n",
    "empty lines": "12\n" + (MOST_LINES + 1) * "\n" + "12\n",
    "one long row": "sent" + 200_000 * " " + "x\n1\n2\n",
    "one field": "sent,received\n0,0\n" + '"' + 200_000 * "1" + '",1\n',
}


@pytest.mark.parametrize("kind", LOGS)
def test_packet_log_that_expands_is_refused(kind, write):
    with little_memory(), pytest.raises(ValueError, match=r"at most|no CSV file"):
        PacketLog.load(write("log.csv", LOGS[kind]))


@pytest.mark.parametrize(("gap", "dt"), [(1e9, 0.01), (1e300, 1e-3), (1e6, 0.01)])
def test_packets_that_are_far_apart_have_no_ages(gap, dt, write):
    log = PacketLog.load(write("log.csv", f"sent,received\n0,0.1\n{gap},{gap}\n{2 * gap},{2 * gap}\n"))
    for expand in (log.ages, log.channel, log.trace, log.send_period):
        with little_memory(), pytest.raises(ValueError, match="control steps"):
            expand(dt)


def test_trace_of_a_channel_has_a_largest_length():
    with pytest.raises(ValueError, match="at most 2,000,000"):
        TraceChannel(trace=range(MOST_PACKETS + 1))


def test_contracts_of_a_long_record_take_few_rows():
    from experiments.analysis.stalls import broken_contracts

    ages = np.zeros(300_000, dtype=int)
    ages[5] = 3000
    with little_memory(400 << 20):
        rows = broken_contracts(ages[:3_001], 0.1)
        assert [rows[0]["max_age"], rows[-1]["max_age"]] == [1000, 0]
        assert len(rows) < 20
        assert len(broken_contracts(np.zeros_like(ages), 0.1)) == 1


LAUGHS = "a: &a [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]\n" + "".join(
    f"{new}: &{new} [{', '.join(10 * ['*' + old])}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)
MERGED = "a: &a {x0: 1, x1: 1}\n" + "".join(
    f"{new}: &{new} {{<<: [*{old}, *{old}]}}\n"
    for old, new in zip("abcdefghijklmnopqrstuv", "bcdefghijklmnopqrstuvw", strict=True)
)


@pytest.mark.parametrize("text", [LAUGHS, MERGED, "a: &a [*a]\n"], ids=["laughs", "merged", "in itself"])
def test_yaml_that_expands_is_refused(text, write):
    from agents.hyperparams import read_hyperparams

    with little_memory(), pytest.raises(ValueError, match="aliases written out"):
        read_hyperparams(write("laughs.yml", text), "default")


@pytest.mark.parametrize("number", [f"1{20_000 * ':1'}", f"!!float '1{20_000 * ':1'}.5'", 20_000 * "9"])
def test_numbers_of_yaml_are_of_moderate_length(number, write):
    from agents.hyperparams import read_hyperparams

    with little_memory(), pytest.raises(ValueError, match="are damaged: it has a number of more than 1,000 letters"):
        read_hyperparams(write("long.yml", f"default:\n  gamma: {number}\n"), "default")


def test_yaml_with_moderate_aliases_is_read(write):
    from agents.hyperparams import read_hyperparams

    text = "common: &common {gamma: 0.9, n_envs: 4}\ndefault:\n  <<: *common\n  n_envs: 8\n"
    assert read_hyperparams(write("zoo.yml", text), "default") == {"gamma": 0.9, "n_envs": 8}
    with pytest.raises(OSError, match=f"{LARGEST_HYPERPARAMS:,} bytes"):
        read_hyperparams(write("long.yml", text + "#" * LARGEST_HYPERPARAMS), "default")


HUGE = [
    {"policy_kwargs": {"net_arch": [12_000, 12_000]}},
    {"policy_kwargs": {"net_arch": {"pi": [64], "vf": [12_000, 12_000]}}},
    {"policy_kwargs": {"net_arch": [{"pi": [12_000, 12_000], "vf": [64]}]}},
    {"policy_kwargs": {"net_arch": {"pi": [64], "qf": [12_000, 12_000]}}},
    {"policy_kwargs": {"net_arch": [10**9]}},
    {"policy_kwargs": {"net_arch": [64] * 100_000}},
    {"policy_kwargs": {"n_critics": 10**9}},
    {"policy_kwargs": {"n_quantiles": 10**9}},
    {"policy_kwargs": {"net_arch": [1024, 1024], "n_critics": 100}},
    {"buffer_size": 10**12},
    {"n_envs": 10**9},
    {"n_envs": 10_000, "n_steps": 10_000},
]


@pytest.mark.cases(5)
@pytest.mark.parametrize("hyperparams", HUGE, ids=[json.dumps(each)[:50] for each in HUGE])
def test_hyperparameters_that_take_much_memory_are_refused(hyperparams):
    from agents.hyperparams import complete_hyperparams

    algorithm = "TQC" if {"n_critics", "n_quantiles"} & hyperparams.get("policy_kwargs", {}).keys() else "PPO"
    algorithm = "SAC" if "buffer_size" in hyperparams else algorithm
    with little_memory(), pytest.raises(ValueError, match=r"at most|may have|numbers of"):
        complete_hyperparams(algorithm, hyperparams)


def test_networks_of_usual_sizes_are_taken():
    from agents.hyperparams import complete_hyperparams

    for arch in ([64, 64], [400, 300], [1024, 1024], {"pi": [256, 256], "qf": [512, 512]}, [{"pi": [64], "vf": []}]):
        for algorithm in ("PPO", "SAC"):
            complete_hyperparams(algorithm, {"policy_kwargs": {"net_arch": arch}})


def forged(folder, hyperparams):
    """A folder with the agent.json of a pretrained agent, other hyperparameters and a checksum that fits."""
    from agents.agent_file import document_of, pretrained_folder

    source = pretrained_folder("ncs_gym/CSTR-v0")
    content = json.loads((source / "agent.json").read_text())["agent"]
    (folder / "agent.json").write_bytes(document_of(content | {"hyperparams": hyperparams}))
    (folder / "model.zip").write_bytes((source / "model.zip").read_bytes())
    return folder


@pytest.mark.parametrize("arch", [[12_000, 12_000], [{"pi": [12_000, 12_000], "vf": [12_000, 12_000]}]])
def test_agent_of_large_networks_is_refused_before_they_are_made(arch, tmp_path):
    pytest.importorskip("stable_baselines3")
    from agents import Agent, AgentError

    folder = forged(tmp_path, {"policy_kwargs": {"net_arch": arch}})
    with little_memory(), pytest.raises(AgentError, match="weights"):
        Agent.load(folder)


def zipped(members):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            with archive.open(name, "w") as file:
                for piece in content:
                    file.write(piece)
    return buffer.getvalue()


def bomb(mebibytes=300):
    return zipped({"data": [bytes(1 << 20)] * mebibytes})


@pytest.mark.cases(1)
@pytest.mark.parametrize("kind", ["outside", "inside", "many", "together", "entries inside"])
def test_zip_that_unpacks_to_much_is_refused(kind, write):
    pytest.importorskip("stable_baselines3")
    from agents import AgentError
    from agents.sb3_zip import parameters_of, read_model

    content = {
        "outside": bomb,
        "inside": lambda: zipped({"data": [b"{}"], "policy.pth": [bomb()]}),
        "many": lambda: zipped({f"{i}": [b""] for i in range(1001)}),
        "together": lambda: zipped({"data": [b"{}"]} | {f"{i}.pth": [bomb(10)] for i in range(30)}),
        "entries inside": lambda: zipped({"data": [b"{}"], "policy.pth": [100_000 * (b"PK\1\2" + bytes(42))]}),
    }[kind]()
    assert len(content) < 1 << 20
    with little_memory(), pytest.raises(ValueError, match="unpacks to more than"):
        parameters_of(content)
    if kind in ("outside", "many"):
        with little_memory(), pytest.raises(AgentError, match="unpacks to more than"):
            read_model(write("agent.zip", content))


def test_zips_in_zips_in_zips_are_not_unpacked():
    from agents.sb3_zip import parameters_of

    within = zipped({})
    for _ in range(2):
        within = zipped({f"{i}.pth": [within] for i in range(300)})
    with little_memory(), pytest.raises(ValueError, match="unpacks to more than"):
        parameters_of(within)


def weights(state, change=lambda name, content: content):
    """A `policy.pth` with some state in a zip, whose files are changed."""
    import torch

    buffer = io.BytesIO()
    torch.save(state, buffer)
    with zipfile.ZipFile(buffer) as archive:
        inner = zipped({name: [change(name, archive.read(name))] for name in archive.namelist()})
    return zipped({"policy.pth": [inner]})


def test_weights_are_read_as_torch_reads_them():
    torch = pytest.importorskip("torch")
    from agents.sb3_zip import parameters_of

    layers = [torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4), torch.nn.Linear(4, 1, dtype=torch.float64)]
    net = torch.nn.Sequential(*layers)
    optimizer = torch.optim.Adam(net[:2].parameters())
    net[:2](torch.ones(2, 3)).sum().backward()
    optimizer.step()
    for state in (net.state_dict(), optimizer.state_dict()):
        read = parameters_of(weights(state))["policy"]
        assert str(read) == str(dict(state))
    net.load_state_dict(parameters_of(weights(net.state_dict()))["policy"])


@pytest.mark.parametrize("kind", ["expanded", "shared", "part", "turned", "half", "doubled", "called", "hashed"])
def test_weights_take_no_more_memory_than_their_files(kind):
    torch = pytest.importorskip("torch")
    from agents.sb3_zip import parameters_of

    numbers = torch.zeros(4, 4)
    hashed = b"\x80\x02}" + pickle.dumps(shared_tuples(), 2)[2:-1] + b"Ns."
    called = b"\x80\x02c__builtin__\nbytearray\nJ\xff\xff\xff\x7f\x85R."
    state = {
        "expanded": torch.zeros(1).expand(10**9),
        "shared": [numbers.view(16), numbers],
        "part": numbers[1:],
        "turned": torch.zeros(4, 5).T,
        "half": numbers.half(),
        "doubled": [numbers] * 2,
    }.get(kind)
    data = {"hashed": hashed, "called": called}.get(kind)
    content = weights(state, lambda name, old: data if data and name.endswith("data.pkl") else old)
    with little_memory():
        if kind == "called":
            assert parameters_of(content)["policy"].arguments == (2**31 - 1,)
            return
        with pytest.raises(ValueError, match=r"no array of its own|aliases written out"):
            parameters_of(content)


def shared_tuples():
    value = ()
    for _ in range(40):
        value = (value, value)
    return value


def of_numpy(shape):
    """A pickled array that says that it has this shape."""
    return pickle.dumps(np.zeros(3), 4).replace(b"K\x03\x85", shape, 1)


LONG_NAME = b"\x8c\xf0" + 240 * b"a"
BIG = b"\x8b" + (2000).to_bytes(4, "little") + 2000 * b"\x7f"
PICKLES = {
    "name of tuples": pickle.dumps(shared_tuples(), 4)[:-1] + b"\x8c\x01x\x93.",
    "long name": b"\x80\x04" + LONG_NAME + LONG_NAME + b"\x93.",
    "name in a line": b"\x80\x04c" + 500_000 * b"a" + b"\nb\n.",
    "name for a terminal": b"\x80\x04cos\n\x1b[2J\n.",
    "number in a line": b"\x80\x04I" + 500_000 * b"a" + b"\n.",
    "large number": b"\x80\x04" + BIG + b".",
    "arguments of letters": b"\x80\x04ca\nb\nX" + (1 << 20).to_bytes(4, "little") + (1 << 20) * b"a" + b"R.",
}


@pytest.mark.parametrize("kind", PICKLES)
def test_pickles_that_expand_are_refused_in_a_short_sentence(kind, write):
    pytest.importorskip("stable_baselines3")
    from agents import AgentError
    from agents.normalization import read_statistics

    path = write("v.pkl", PICKLES[kind])
    with little_memory(), pytest.raises(AgentError, match="no pickle that is read here") as caught:
        read_statistics(path)
    assert len(str(caught.value)) < 300 + len(str(path))
    assert str(caught.value).isprintable()


def test_arguments_that_pickles_share_are_not_copied():
    from agents.pickled_data import pickled_data

    calls = 20_000 * b"ca\nb\nh\x00R"
    with little_memory():
        pickled_data(b"\x80\x04(" + 20_000 * b"N" + b"t\x94(" + calls + b"t.")


@pytest.mark.parametrize("shape", [b"(" + 50_000 * b"J\xff\xff\xff\x7f" + b"t", b"\x8a\xff" + 255 * b"\x7f" + b"\x85"])
def test_arrays_of_many_or_large_sizes_are_refused_before_these_are_multiplied(shape):
    from agents.pickled_data import array_of, pickled_data

    value = pickled_data(of_numpy(shape))
    with little_memory(), pytest.raises(ValueError, match="array of another kind"):
        array_of(value)


def test_pickles_whose_parts_share_others_take_little_time_and_memory():
    from agents.pickled_data import parts_of, pickled_data
    from ncs_gym.reading import require_moderate

    shared, keys = [], shared_tuples()
    for _ in range(40):
        shared = [shared, shared]
    with little_memory(), pytest.raises(ValueError, match="aliases written out"):
        require_moderate(pickled_data(pickle.dumps(shared)), parts_of)
    with little_memory(), pytest.raises(ValueError, match="aliases written out"):
        pickled_data(b"\x80\x03}" + pickle.dumps(keys, 3)[2:-1] + b"Ns.")  # None by these keys


@pytest.mark.cases(2)
@pytest.mark.parametrize("operation", [b"}", b"]", b"\x8f", b"(", b"N"], ids=repr)
def test_pickles_of_many_objects_are_refused_before_they_are_made(operation, write):
    pytest.importorskip("stable_baselines3")
    from agents import AgentError
    from agents.normalization import read_statistics
    from agents.sb3_zip import read_model

    pickled = b"\x80\x04" + (8 << 20) * operation + b"."
    entry = {":serialized:": base64.b64encode(pickled).decode()}
    path = write("agent.zip", zipped({"data": [json.dumps({"policy_class": entry}).encode()]}))
    assert path.stat().st_size < 1 << 16
    with little_memory(), pytest.raises(AgentError, match="more than 100,000 operations"):
        read_model(path)
    with little_memory(), pytest.raises(AgentError, match="more than 100,000 operations"):
        read_statistics(write("v.pkl", pickled))


def places(value, path=()):
    """The paths to all values in a JSON document, of a list to the first one alone."""
    yield path
    for key in value if isinstance(value, dict) else range(min(len(value), 1)) if isinstance(value, list) else ():
        yield from places(value[key], (*path, key))


def with_long(document, path, change):
    """A document with a long text in the place of a value, or as the name of one more beside those in it."""
    document = at = json.loads(json.dumps(document))
    for key in path[:-1]:
        at = at[key]
    if change == "value" and path:
        at[path[-1]] = 10_000 * "x"
    elif change == "name":
        at = at[path[-1]] if path else at
        if isinstance(at, dict):
            at[10_000 * "x"] = 1
    return document


def documents(folder):
    """The content of each kind of document, and what loads such a content, whose checksum is right."""
    from agents import Agent, agent_file
    from agents.agent_file import pretrained_folder
    from agents.hyperparams import complete_hyperparams, read_hyperparams, tuned_hyperparams

    plant = truck_trailer(mass=4000.0)
    certificate = json.loads(json.dumps(certificate_of(plant).document))
    agent, path = pretrained_folder("ncs_gym/CSTR-v0"), folder / "agent.json"
    (folder / "model.zip").write_bytes((agent / "model.zip").read_bytes())

    def as_file(load):
        return lambda document: (path.write_text(json.dumps(document)), load(path))

    return {
        "plant": (json.loads(json.dumps(plant.document)), as_file(LinearPlant.load)),
        "certificate": (
            certificate["certificate"],
            lambda content: Certificate.read(document_of("certificate", certificate["format"], content)),
        ),
        "agent": (
            json.loads((agent / "agent.json").read_text())["agent"],
            lambda content: (path.write_bytes(agent_file.document_of(content)), Agent.load(folder)),
        ),
        "hyperparameters": (
            {"default": tuned_hyperparams("ncs_gym/CSTR-v0")},
            as_file(lambda path: complete_hyperparams("PPO", read_hyperparams(path, "default"))),
        ),
    }


@pytest.mark.parametrize("name", ["plant", "certificate", "agent", "hyperparameters"])
def test_what_is_said_of_a_document_with_long_texts_is_short(name, tmp_path):
    pytest.importorskip("stable_baselines3")
    document, load = documents(tmp_path)[name]
    refused = 0
    for path in places(document):
        for change in ("value", "name"):
            try:
                load(with_long(document, path, change))
            except (ValueError, OSError) as error:
                refused += 1
                assert len(str(error)) < 1000 + len(str(tmp_path)), (path, change, str(error)[:200])  # noqa: PT017
    assert refused > 3


@pytest.mark.parametrize("text", ["x" * 1001, "\x1b[2J", "two\nlines"], ids=["long", "escape", "lines"])
def test_texts_of_plants_are_short_and_mean_nothing_to_a_terminal(text):
    document = json.loads(json.dumps(truck_trailer().document))
    for name in ("state_names", "state_units"):
        changed = document | {"plant": document["plant"] | {name: ["x", text]}}
        with pytest.raises(ValueError, match=f"{name} must be printable text of at most 1000 letters"):
            LinearPlant.read(changed)
    with pytest.raises(ValueError, match="the basis of a remainder must be printable text"):
        Remainder(Ellipsoid(np.eye(2)), proved=False, basis=text)


def test_key_that_is_too_short_or_too_long_is_refused(write, tmp_path):
    from experiments.commands.loop import loop
    from experiments.settings import LoopSettings

    for key, reason in ((b"short", "at least 16 bytes"), (bytes(5000), "more than 4,096 bytes")):
        with pytest.raises((ValueError, OSError), match=reason):
            loop(LoopSettings(role="plant", key_file=write("key", key), out=tmp_path / "out"))


def test_log_of_a_loop_with_one_long_line_is_read_in_pieces(write, tmp_path):
    from experiments.network_loop.log import rows_of

    write("controller-000.csv", "a,b\n1,2\n" + "1" * (40 << 20) + "\n3,4\n")
    with little_memory(8 << 20):
        assert list(rows_of(tmp_path, "controller")) == [{"a": "1", "b": "2"}, {"a": "3", "b": "4"}]
    (tmp_path / "controller-000.csv").unlink()
    os.mkfifo(tmp_path / "controller-000.csv")
    with pytest.raises(OSError, match="not a regular file"):
        list(rows_of(tmp_path, "controller"))


def stiff(speed, points=64):
    """A plant with a state that follows its input so many times faster than the other."""
    model = np.array([[-1.0, 1.0], [0.0, -speed]]), np.array([[0.0], [speed]]), np.eye(2), np.zeros((2, 1))
    bounds = {name: [1e-3, 1e-3] for name in ("disturbance_bound", "sensor_bound", "initial_bound")}
    return LinearPlant.from_statespace(model, dt=0.1, box=[1.0, 1.0], u_max=1.0, between_samples=points, **bounds)


def grid_conditions(plant):
    """What is decided of the plant's grid; the certificate is another plant's, which these conditions do not ask."""
    certificate = replace(certificate_of(truck_trailer(mass=4000.0)), between_samples=plant.between_samples)
    found = []
    for condition in between_conditions(certificate, plant):
        if condition.name.startswith("(B)"):
            break
        found.append(condition)
    return [each for each in found if each.name.startswith("(G)")]


@pytest.mark.parametrize(("speed", "holds"), [(10.0, True), (300.0, True), (1000.0, True), (1e5, False)])
def test_stiff_models_are_decided_in_numbers_of_bounded_length(speed, holds):
    conditions = grid_conditions(stiff(speed))
    assert len(conditions) == 2
    assert all(each.holds for each in conditions) == holds


@pytest.mark.parametrize("speed", [3.0, 300.0])
def test_bound_between_grid_points_is_hardly_more_than_it_has_to_be(speed):
    """The plant's own eta is one percent more than needed, of which the verification leaves most."""
    plant = stiff(speed)
    rows = plant.grid_rows
    other = replace(plant)
    other.__dict__["grid_rows"] = rows._replace(remainder=0.98 * rows.remainder)
    assert all(each.holds for each in grid_conditions(plant))
    assert not all(each.holds for each in grid_conditions(other))


def test_long_datagrams_are_cut_off_and_refused():
    import asyncio

    from ncs_gym.network.wire import LARGEST_DATAGRAM, Wire, WireError
    from shields.nodes import UdpTransport

    async def sent():
        receiver = await UdpTransport.open(local=("127.0.0.1", 0))
        sender = await UdpTransport.open(peer=receiver.address)
        for _ in range(100):
            sender.send(bytes(60_000))
            await asyncio.sleep(0.005)
            if arrived := receiver.received():
                break
        sender.close()
        receiver.close()
        return arrived[0].data

    data = asyncio.run(sent())
    assert len(data) == LARGEST_DATAGRAM + 1
    with pytest.raises(WireError, match=r"format|length"):
        Wire(truck_trailer(mass=4000.0), 4, bytes(32)).decode(data)


def test_zeromq_hears_nobody_without_the_key_and_no_long_message():
    zmq = pytest.importorskip("zmq")
    import asyncio

    from ncs_gym.network.wire import LARGEST_DATAGRAM
    from shields.nodes.zeromq import ZmqTransport

    async def heard():
        context = zmq.Context()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
        controller, sizes = ZmqTransport(bytes(32), bind=address), set()
        stranger = context.socket(zmq.DEALER)
        stranger.setsockopt(zmq.LINGER, 0)
        stranger.connect(address)
        senders = [ZmqTransport(bytes(32), connect=address) for _ in range(2)]
        other_key = ZmqTransport(bytes(31) + b"1", connect=address)
        for _ in range(200):
            with suppress(zmq.Again):  # it does not even come to a connection
                stranger.send_multipart([b"stranger"] * 100, zmq.NOBLOCK)
            other_key.send(b"other key")
            senders[0].send(bytes(LARGEST_DATAGRAM))
            senders[1].send(bytes(2 * LARGEST_DATAGRAM))
            await asyncio.sleep(0.005)
            sizes |= {len(each.data) for each in controller.received()}
        for each in (controller, other_key, *senders):
            each.close()
        context.destroy(0)
        return sizes

    assert asyncio.run(heard()) == {LARGEST_DATAGRAM}
