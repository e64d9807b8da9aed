"""Small files and messages that would take memory or time without bound; each is refused before it is expanded."""

import json
import os
import tracemalloc
from contextlib import contextmanager

import numpy as np
import pytest

from ncs_gym import Ellipsoid, LinearPlant, PacketLog, TraceChannel, truck_trailer
from ncs_gym.plants.family import Remainder
from ncs_gym.reading import (
    LARGEST_DOCUMENT,
    LARGEST_LOG,
    MOST_PACKETS,
    MOST_VALUES,
    json_values,
)
from shields import Certificate, CertificateError
from tests.product import altered, sampled_plant
from tests.second_verifier.between_samples import row_conditions

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


READERS = [LinearPlant.load, Certificate.load, PacketLog.load]


@pytest.mark.parametrize("read", READERS)
def test_pipes_and_devices_are_refused_by_every_reader_of_files(read, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for endless in (tmp_path / "pipe", "/dev/zero"):
        with little_memory(), pytest.raises((OSError, ValueError), match="not a regular file"):
            read(endless)


@pytest.mark.parametrize("read", READERS)
def test_file_of_many_bytes_is_refused_before_it_is_read(read, tmp_path):
    path = tmp_path / "large"
    with open(path, "wb") as file:
        file.truncate(LARGEST_LOG + 1)  # takes no place on the disk
    with little_memory(), pytest.raises((OSError, ValueError), match="has more than"):
        read(path)


@pytest.mark.parametrize("part", ["[],", "0,", '"",'])
def test_json_of_many_values_is_refused_before_it_is_expanded(part, write):
    text = f"[{part * MOST_VALUES}0]"
    assert len(text) < LARGEST_DOCUMENT
    with little_memory(), pytest.raises(ValueError, match="values"):
        json_values(text)
    with little_memory(100 << 20), pytest.raises(CertificateError, match="not valid JSON"):
        Certificate.load(write("certificate.json", text))
    assert json_values("[1, 2]") == [1, 2]


PING = "PING h (192.0.2.1) 56(84) bytes of data.\n{}\n--- h ping statistics ---\n{} packets transmitted, 2 received, "
LOGS = {
    "ping statistics": PING.format("", 9_999_999) + "0% packet loss, time 1ms\n",
    "ping lines": PING.format(2_000_000 * "\n" + "x", 2) + "0% packet loss, time 1ms\n",
    "rows": "sent,received\n" + (MOST_PACKETS + 1) * "0,\n",
    "one long row": "sent" + 200_000 * " " + "x\n1\n2\n",
    "one field": "sent,received\n0,0\n" + '"' + 200_000 * "1" + '",1\n',
}


@pytest.mark.parametrize(
    "kind", [*(each for each in LOGS if each != "rows"), pytest.param("rows", marks=pytest.mark.slow)]
)
def test_packet_log_that_expands_is_refused(kind, write):
    with little_memory(), pytest.raises(ValueError, match=r"at most|a record is a table"):
        PacketLog.load(write("log.csv", LOGS[kind]))


def test_packets_that_are_far_apart_have_no_ages():
    log, dt = PacketLog([0.0, 1e6, 2e6], [0.1, 0.0, 0.0]), 0.01
    for expand in (log.ages, log.channel, log.trace, log.send_period):
        with little_memory(), pytest.raises(ValueError, match="control steps"):
            expand(dt)


def test_trace_of_a_channel_has_a_largest_length():
    with pytest.raises(ValueError, match="at most 2,000,000"):
        TraceChannel(trace=range(MOST_PACKETS + 1))


@pytest.mark.parametrize("text", ["x" * 1001, "\x1b[2J"], ids=["long", "escape"])
def test_texts_of_plants_are_short_and_mean_nothing_to_a_terminal(text):
    document = json.loads(json.dumps(truck_trailer().document))
    for labels, name in (({"x": "m", text: "m"}, "names"), ({"x": "m", "y": text}, "units")):
        changed = document | {"labels": {"states": labels}}
        with pytest.raises(ValueError, match=f"{name} of states must be printable text of at most 1000 letters"):
            LinearPlant.load(changed)
    with pytest.raises(ValueError, match="the basis of a remainder must be printable text"):
        Remainder(Ellipsoid(np.eye(2)), proved=False, basis=text)


def stiff(speed, points=64):
    """A plant with a state that follows its input so many times faster than the other."""
    model = np.array([[-1.0, 1.0], [0.0, -speed]]), np.array([[0.0], [speed]]), np.eye(2), np.zeros((2, 1))
    bounds = {name: [1e-3, 1e-3] for name in ("disturbance_bound", "sensor_bound", "initial_bound")}
    return sampled_plant(model, dt=0.1, box=[1.0, 1.0], u_max=1.0, between_samples=points, **bounds)


def test_a_state_that_is_too_fast_between_the_times_is_refused():
    with pytest.raises(ValueError, match="leaves nothing of row 2 of the box"):
        stiff(1e5)


@pytest.mark.cases(1)
@pytest.mark.parametrize("speed", [3.0, 300.0])
def test_rows_of_stiff_models_are_right_and_hardly_closer_than_they_have_to_be(speed):
    """The plant's own eta is one percent more than needed."""
    plant = stiff(speed)
    assert all(each.holds for each in row_conditions(plant))
    other = altered(plant)
    kept = other.box_ends + 0.98 * (plant.kept_ends - other.box_ends)
    object.__setattr__(other, "kept_ends", kept)
    object.__setattr__(other, "step_ends", np.tile(kept, 63))
    assert not all(each.holds for each in row_conditions(other))
