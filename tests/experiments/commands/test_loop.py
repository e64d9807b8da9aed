"""A control loop over UDP in processes of its own: what the logs say holds at any speed of the machine."""

import csv
import inspect
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pandas as pd
import pytest
import tyro
from PIL import Image

import ncs_gym.network.wire
import shields.nodes.nodes
from experiments.commands.loop import summary_of
from experiments.network_loop.log import StepLog, rows_of
from experiments.network_loop.processes import REFUSED, NetworkLoop, network_channels, waiting_text
from experiments.runs.loops import registered_env
from experiments.settings import LoopSettings
from ncs_gym import Channel
from tests.certificates import certificate_of
from tests.command import environment, ncs, ncs_process, succeeded

CRUISE = "ncs_gym/TruckTrailerCruise-v0"


def free_port():
    """One of three in a row, as a rule."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as each:
        each.bind(("127.0.0.1", 0))
        return min(each.getsockname()[1], 65533)


def check(folder):
    """What the logs of plant and controller have to agree on, however late processes and packets were."""
    summary = summary_of(folder)
    assert summary["outside although proved"] == 0
    plant = pd.concat(pd.read_csv(file) for file in sorted(folder.glob("plant-*.csv")))
    controller = pd.concat(pd.read_csv(file) for file in sorted(folder.glob("controller-*.csv")))
    both = controller.merge(plant, on=["episode", "step"], suffixes=("", "_applied"))
    assert len(both) > 0
    missed = plant[plant["missing"] > 0].groupby("episode")["step"].min()
    for episode, own in plant.groupby("episode"):
        kept = own[own["step"] < missed.get(episode, 2**62)]
        if (controller["episode"] == episode).any() and not own["outside"].iloc[0]:
            assert not kept["outside"].any()  # while every input arrived
    assert (controller["missing"].groupby(controller["episode"]).diff().fillna(0) >= 0).all()
    heard = controller[controller["missing"] > 0]
    assert not heard["guaranteed"].any()  # a miss that was heard of ends the proof
    return summary, controller


@pytest.mark.slow
def test_ten_seconds_over_udp_with_everything_that_a_network_does(tmp_path):
    out = tmp_path / "loop"
    done = ncs_process(
        *("loop", "--env", CRUISE, "--speed", 5, "--steps", 100, "--room", 4, "--worst", "--mischief", 0.3),
        *("--port", free_port(), "--out", out, "--live", "yes", "--shield", "lookahead"),
    )
    assert done.returncode == 0, done.stderr
    summary, controller = check(out)
    assert summary["steps of the controller"] == len(controller) == 100
    by_reason = [value for name, value in summary.items() if name.startswith("refused, ")]
    assert summary["datagrams refused"] == sum(by_reason) > 0
    assert "--mischief 0.3 makes such: beside 30 % of the datagrams" in " ".join(done.stdout.split())
    assert controller["guaranteed"].iloc[0] == 1
    assert "outside although proved" in done.stdout
    assert "overridden" in done.stdout
    assert "; margin " in done.stdout  # a line or, with rich, the title of the table
    succeeded("render", "--env", CRUISE, "--log", out, "--out", tmp_path / "loop.png")
    assert Image.open(tmp_path / "loop.png").size[0] > 1000
    other = ncs("render", "--env", "ncs_gym/CSTR-v0", "--log", out, "--out", tmp_path / "other.png")
    assert "are of another plant, without concentration, temperature" in other.stderr
    packets = pd.read_csv(out / "packets-000.csv")
    assert (packets["received"] >= packets["sent"]).all()


def test_steps_without_an_answer_of_the_policy_are_not_called_overridden(tmp_path):
    columns = "episode,step,guaranteed,reason,proposed_u1,proposed_u2,intervened,age,skipped,refused,refused_why"
    rows = [f"1,{step},1,,{proposed},{intervened},2,0,0," for step, (proposed, intervened) in enumerate(
        [("0.0,0.0", 0), ("1.0,0.0", 1), (",", 1), (",", 1), ("0.5,0.5", 1), ("nan,0.5", 1)]
    )]  # fmt: skip
    lines = [columns + ",microseconds", *(f"{row},100" for row in rows)]
    (tmp_path / "controller-000.csv").write_text("\n".join(lines) + "\n")
    summary = summary_of(tmp_path)
    assert (summary["overridden"], summary["not answered in time by the policy"]) == (3, 2)


@pytest.mark.slow
def test_controller_that_is_killed_is_restarted_beside_the_running_plant(tmp_path):
    key, certificate = tmp_path / "key", tmp_path / "c.json"
    key.write_bytes(os.urandom(32))
    from ncs_gym.registration import loaded_truck_trailer

    certificate_of(loaded_truck_trailer()).save(certificate)
    common = ["loop", "--env", CRUISE, "--speed", "5", "--room", "4", "--port", str(free_port())]
    common += ["--key-file", str(key), "--certificate", str(certificate), "--live", "yes"]

    def started(role, *more):
        command = [sys.executable, "-m", "experiments", *common, "--role", role, "--out", str(tmp_path / role), *more]
        return subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    plant = started("plant")
    try:
        first = started("controller", "--steps", "100000")
        log = tmp_path / "controller" / "controller-000.csv"
        deadline = time.monotonic() + 120
        while not (log.exists() and log.stat().st_size > 4000) and time.monotonic() < deadline:
            time.sleep(0.2)
        first.kill()
        first.wait()
        episode = next(rows_of(tmp_path / "controller", "controller"))["episode"]
        second = started("controller", "--steps", "60", "--restarted")
        text, _ = second.communicate(timeout=240)
        assert second.returncode == 0, text
        rows = list(rows_of(tmp_path / "controller", "controller"))
        assert len(rows) == 60
        assert episode not in {row["episode"] for row in rows}
        assert rows[0]["reason"] == "the samples do not yet tell where the state is"
        assert any(row["guaranteed"] == "1" for row in rows)
    finally:
        plant.send_signal(signal.SIGTERM)  # an interrupt may be ignored where tests run
        text, _ = plant.communicate(timeout=60)
    assert plant.returncode == 0, text
    assert "steps of the plant" in text
    assert "steps of the controller" not in text


@pytest.mark.parametrize(
    "changes",
    [{"speed": 2.0}, {"room": 3}, {"uplink": Channel(loss=0.1)}, {"downlink": Channel(loss=0.1)}, {"env": "a"}],
)
def test_machines_that_were_told_other_things_have_other_keys(changes):
    told = {"settings": LoopSettings(), "uplink": Channel(), "downlink": Channel(), "secret": bytes(16), "max_age": 0}
    of_settings = {name: value for name, value in changes.items() if name not in told}
    other = told | changes if not of_settings else told | {"settings": LoopSettings(**of_settings)}
    untold = told | {"settings": LoopSettings(seed=7, out=Path("elsewhere"))}
    assert NetworkLoop(**told).key == NetworkLoop(**untold).key
    assert NetworkLoop(**told).key != NetworkLoop(**other).key
    assert "--speed, --room" in waiting_text({"tag": 3}, two_machines())


def two_machines():
    return LoopSettings(role="controller", key_file=Path("key"))


def test_messages_about_refused_datagrams_say_what_is_known():
    refused = Counter({"tag": 700, "length": 20, "episode": 5, "late": 0})
    alone = waiting_text(refused, LoopSettings(mischief=0.1))
    assert "725 datagrams were refused: 700 with a wrong tag, 20 of the wrong length, 5 of another episode" in alone
    assert "--mischief 0.1 makes such: beside 10 % of the datagrams" in alone
    assert "another key" not in alone  # on one machine there is only one
    assert "--mischief 0 makes none of these" in waiting_text(refused, LoopSettings(mischief=0.0))
    apart = waiting_text(refused, two_machines())
    assert "makes such, and if all have a wrong tag, that machine has another key" in apart
    assert "another key" not in waiting_text({"episode": 3}, two_machines())
    assert waiting_text(Counter({"late": 0}), two_machines()).endswith("nothing has arrived yet")


def test_every_reason_to_refuse_a_datagram_has_words():
    nodes, wire = (inspect.getsource(module) for module in (shields.nodes.nodes, ncs_gym.network.wire))
    reasons = {*re.findall(r'refused\["(\w+)"\]', nodes), *re.findall(r'WireError\("(\w+)"\)', wire)}
    assert len(reasons) > 5
    assert reasons == set(REFUSED)


def test_controller_that_waits_says_what_it_waits_for(tmp_path):
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    command = [sys.executable, "-m", "experiments", "loop", "--env", CRUISE, "--role", "controller"]
    command += ["--key-file", str(key), "--port", str(free_port()), "--out", str(tmp_path / "out"), "--live", "no"]
    waits = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert waits.stderr is not None
    line = waits.stderr.readline()
    waits.send_signal(signal.SIGTERM)  # an interrupt may be ignored where tests run
    waits.communicate(timeout=60)
    assert "the controller waits for sensor and actuator; nothing has arrived yet" in line
    assert waits.returncode == 0


@pytest.mark.parametrize(
    ("env", "more"),
    [
        ("CSTR", "--channel max_consecutive_losses=2 --downlink max_consecutive_losses=1"),
        ("Convoy", "--channel max_consecutive_losses=3 --downlink max_consecutive_losses=3"),
    ],
)
def test_networks_of_both_ways_are_chosen_by_name(env, more):
    arguments = ["--env", f"ncs_gym/{env}-v0", *more.split()]
    settings = tyro.cli(LoopSettings, args=arguments)
    up, down = network_channels(registered_env(settings.env), settings.channel, settings.downlink)
    assert (up.delay, down.delay) == (1, 1)
    assert up.max_consecutive_losses == settings.channel["max_consecutive_losses"]
    assert down.max_consecutive_losses == settings.downlink["max_consecutive_losses"]


@pytest.mark.slow
def test_port_that_is_in_use_ends_the_command(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as used:
        used.bind(("127.0.0.1", 0))
        port = used.getsockname()[1]
        done = ncs_process("loop", "--env", CRUISE, "--smoke", "--port", port - 1, cwd=tmp_path)
    assert done.returncode == 2
    assert "ended by itself" in done.stderr
    assert "Traceback" not in done.stderr


def test_log_is_rotated_and_read_in_order_without_a_row_that_was_cut_off(tmp_path):
    log = StepLog(tmp_path, "steps", ["step", "text"], rows_per_file=3)
    for step in range(8):
        log.write([step, "a, b"])
    log.close()
    assert [file.name for file in sorted(tmp_path.iterdir())] == [f"steps-00{i}.csv" for i in range(3)]
    with open(tmp_path / "steps-002.csv", "a", newline="") as file:
        csv.writer(file).writerow([8])
    assert [row["step"] for row in rows_of(tmp_path, "steps")] == [str(step) for step in range(8)]
