"""The exported filter: equal to its Python reading, sound under attack, and damaged or unsuited ones are refused."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ncs_gym import Channel
from shields import Certificate, CertificateError
from shields.export import BoardFilter, BoardTable, board_filter, c_files, export_c
from shields.packaged_certificates import __file__ as package
from tests.certificates import CHECKED_IN, certificate_of
from tests.command import ncs, succeeded
from tests.plants import oscillator
from tests.product import safety_filter
from tests.shields.attacks.adversary import Adversary, Faces, Traffic, boundary, gauges
from tests.shields.export.board import NAMES, TWO_ENDS, Boards, altered, compiled, compiler, example

EPISODE = 250
# Compiled every day; the tests of the others are slow.
DAILY = {("CartPole", True), ("CSTR", False), ("hill", False)}
EVERY = [*((name, False) for name in (*NAMES, *TWO_ENDS)), ("CartPole", True), ("CSTR", True), ("tanks", True)]
FILTERS = [pytest.param(*each, marks=[] if each in DAILY else [pytest.mark.slow]) for each in EVERY]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Folders with exported filters, by name and precision; without long test vectors."""
    folders = {}

    def folder_of(name, single=False):
        if (name, single) not in folders:
            plant, certificate = example(name)
            folder = tmp_path_factory.mktemp(name)
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(c_files, "VECTOR_STEPS", 2 * EPISODE)
                folders[name, single] = folder, export_c(certificate, plant, folder, single=single)
        return folders[name, single]

    return folder_of


class Ends(Faces):
    """The polytope {x : low <= row x <= high for all rows}, around 0."""

    @classmethod
    def of(cls, rows, low, high):
        return cls(np.vstack([rows / high[:, None], rows / low[:, None]]))

    def gauges(self, points):
        return (self.rows @ points).max(axis=0)

    def outward(self, points, reach=0.0):
        return self.rows[(self.rows @ points + np.reshape(reach, (-1, 1))).argmax(axis=0)].T


def set_of(certificate):
    P = certificate.safe_set
    return Ends.of(P.rows, P.low, P.high)


def copied(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy", ignore=shutil.ignore_patterns("*.so"))


@pytest.mark.parametrize(("name", "single"), [each for each in FILTERS if each.values[0] not in ("angle", "tanks")])
def test_c_does_what_its_python_reading_does(exported, name, single):
    """Random samples, stamps, episodes, proposals and applied inputs, also wrong ones: equal to the last bit."""
    (folder, table), (plant, certificate) = exported(name, single), example(name)
    rng, h, seen = np.random.default_rng(1), certificate.contract.max_age, set()
    board = Boards(folder, 1, plant.n, plant.m)
    for episode in range(24):
        first = rng.uniform(-1.0, 1.0, plant.n) * plant.half_widths * [0.0, 0.2, 1.5, 200.0][episode % 4]
        reading, states = BoardFilter(table, episode, first), [first]
        assert board.start(episode, first[None])
        calm, rate = rng.choice([0.9, 1.0]), rng.choice([0.6, 3.0])
        for step in range(100):
            for _ in range(rng.poisson(rate)):
                stamp = step - int(rng.integers(-1, h + 3))
                noise = 1e-5 if rng.random() < calm else 1.0
                y = plant.H @ states[min(max(stamp, 0), step)] + noise * rng.standard_normal(plant.p)
                y = np.full(plant.p, np.inf) if rng.random() < 0.02 else y
                of = episode + (rng.random() < 0.05)
                reading.receive(of, stamp % 2**32, y)
                board.receive(np.ones(1), of, np.array([stamp % 2**32]), y)
            proposed = rng.uniform(-1.5, 1.5, plant.m) * plant.largest_input
            proposed[0] = rng.choice([proposed[0], np.nan, -np.inf], p=[0.98, 0.01, 0.01])
            decision, u = reading.decide(proposed)
            u_c, (code,), (reason,) = board.decide(proposed)
            assert (decision, reading.reason, u.tolist()) == (code, reason, u_c[0].tolist())
            if rng.random() < 0.01:
                u = rng.choice([np.nan, 0.5]) * u
                reading.applied(u)
                board.applied(np.ones(1), u)
            states.append(plant.A @ states[-1] + plant.B @ u_c[0])
            estimate, (age,) = board.look()
            assert np.array_equal(estimate[0], reading.estimate, equal_nan=True)
            assert age == reading.age
            seen |= {("decision", decision), ("reason", reading.reason)}
    kinds = {("decision", code) for code in range(4) if code != board_filter.PROJECTED or name in ("CartPole", "CSTR")}
    assert kinds | {("reason", code) for code in (0, 1, 2, 3, 4, 5, 7, 8)} <= seen


@pytest.mark.parametrize(("name", "single"), FILTERS)
def test_what_passes_on_a_board_passes_the_filter_with_the_error_set_of_its_age(exported, name, single):
    (_, table), (plant, certificate) = exported(name, single), example(name)
    shield, rng = safety_filter(certificate, plant, "switch"), np.random.default_rng(2)
    passed = np.zeros(len(table.limit), np.int64)
    for _ in range(700):
        direction = boundary(set_of(certificate), plant.half_widths, rng, 1)[:, 0]
        board = BoardFilter(table, 0, rng.uniform(0.5, 1.0) * direction)
        board.age = age = int(rng.integers(len(table.limit)))
        estimate, wanted = board.estimate, rng.uniform(*plant.input_ends)
        decision, u = board.decide(wanted)
        if decision in (board_filter.SAFE, board_filter.PROJECTED):
            passed[age] += 1
            assert shield.decide(estimate, certificate.error_shapes[age], u).reason == "safe"
            assert (decision == board_filter.SAFE) == (u.tolist() == wanted.tolist())
    assert passed.min() > 20


def attacked(folder, name, steps, seed=0, count=200, outages=False):
    """Attacks N filters for so many steps: guaranteed steps, those outside the set, and errors outside their sets.

    With outages packets break the contract now and then, and what was held up arrives together.
    """
    plant, certificate = example(name)
    rng, h = np.random.default_rng(seed), certificate.contract.max_age
    boards = Boards(folder, count, plant.n, plant.m)
    channel = Channel(quantization_step=certificate.contract.quantization_step)
    shapes = np.array([*certificate.error_shapes, certificate.updates.last])
    D, N = plant.nominal_disturbance.shape_matrix, plant.nominal_sensor_error.shape_matrix
    guaranteed = outside = wrong = 0
    worst, seen_reasons = 0.0, set()
    for episode in range(steps // (EPISODE * count)):
        seen = {each: getattr(plant, each) for each in ("A", "B", "H", "n", "m", "half_widths")}
        seen = SimpleNamespace(**seen, box=plant.box, largest_input=plant.largest_input)
        adversary, traffic = (
            Adversary(seen, certificate, rng, count),
            Traffic(*((3 * h, None) if outages else (h, h)), count),
        )
        adversary.safe, adversary.box = set_of(certificate), Ends.of(plant.box, *plant.box_ends)
        x = boundary(adversary.safe, plant.half_widths, rng, count) * rng.uniform(0.5, 1.0, count)
        boards.start(episode, (x + plant.nominal_initial_error.sample_boundary(rng, count).T).T)
        taken = []
        for step in range(EPISODE):
            taken.append(channel.quantize(plant.H @ x + adversary.noise(N)) if step else np.zeros((plant.p, count)))
            for age, some in traffic.arrivals(rng, step) if step else ():
                boards.receive(some, episode, np.full(count, step - age), taken[step - age].T)
            estimate, age = boards.look()
            of_age = shapes[np.minimum(age, h)]
            adversary.begin_step(estimate.T - x, of_age)
            u, _, reason = boards.decide(adversary.proposals(estimate.T).T)
            is_guaranteed = reason == board_filter.GUARANTEED
            guaranteed += int(is_guaranteed.sum())
            values = adversary.safe.gauges(x)
            worst = max(worst, values[is_guaranteed].max(initial=0.0))
            outside += int((values > 1.0 + 1e-12)[is_guaranteed].sum())
            known = (age <= h) & (reason != board_filter.LOST_CONTRACT)
            wrong += int((gauges(of_age, estimate.T - x) > 1.0 + 1e-9)[known].sum())
            seen_reasons |= set(reason.tolist())
            nominal = plant.A @ x + plant.B @ u.T
            x = nominal + adversary.disturbances(nominal, D)
    expected = {board_filter.GUARANTEED, board_filter.NOT_KNOWN_INSIDE}
    expected |= {board_filter.OLD_SAMPLE, board_filter.LOST_CONTRACT} if outages else set()
    assert seen_reasons <= expected
    assert not outages or seen_reasons == expected
    return guaranteed, outside, wrong, worst


@pytest.mark.parametrize(("name", "single"), FILTERS)
def test_no_guaranteed_state_leaves_the_set_under_attack(exported, name, single):
    guaranteed, outside, wrong, worst = attacked(exported(name, single)[0], name, 50_000)
    assert (outside, wrong) == (0, 0)
    assert guaranteed > 45_000
    assert worst > 0.95  # the attack goes up to the boundary


@pytest.mark.parametrize(
    "name", ["CSTR", *(pytest.param(name, marks=pytest.mark.slow) for name in ("CartPole", "BatchReactor"))]
)
def test_a_broken_contract_ends_the_guarantee_and_nothing_else(exported, name):
    guaranteed, outside, wrong, _ = attacked(exported(name)[0], name, 25_000, count=100, outages=True)
    assert (outside, wrong) == (0, 0)
    assert 500 < guaranteed < 24_000


def test_the_attack_finds_a_table_that_forgets_errors(exported, tmp_path):
    table, (plant, certificate) = exported("CSTR")[1], example("CSTR")
    forgetful = replace(table, limit=np.broadcast_to(table.limit[0], table.limit.shape))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BoardTable, "of", lambda *given, **settings: forgetful)
        patch.setattr(c_files, "VECTOR_STEPS", 0)
        export_c(certificate, plant, tmp_path)
    assert attacked(tmp_path, "CSTR", 50_000)[1] > 0


def test_an_altered_table_never_starts(exported, tmp_path):
    folder, table = exported("CSTR")
    count, n = len(table.joint), table.sizes["N"]
    last = lambda text: repr(float(np.nextafter(float(text), 1e9)))  # noqa: E731
    number = r"(?<=[ \n])-?\d+\.\d+(?=[,\n])"
    changes = [(number, last, which) for which in (0, -2 * count)]
    changes += [(r"(?<=checksum = 0x)[0-9a-f]+", lambda text: f"{1 + (text[0] == '1')}{text[1:]}", 0)]
    for k, change in enumerate(changes):
        damaged = copied(folder, tmp_path / str(k))
        altered(damaged, *change)
        board = Boards(damaged, 1, n, 1)
        assert not board.start(0, np.zeros((1, n))), change
        assert [each.tolist() for each in board.decide(np.ones(1))] == [[[0.0]], [4], [board_filter.STOPPED]]
    header = (damaged := copied(folder, tmp_path)) / "ncs_filter.h"
    header.write_text(header.read_text().replace("NCS_H 6", "NCS_H 5"))
    assert not Boards(damaged, 1, n, 1).start(0, np.zeros((1, n)))
    assert Boards(folder, 1, n, 1).start(0, np.zeros((1, n)))


@pytest.mark.cases(1)
@pytest.mark.parametrize(("name", "single"), [each for each in FILTERS if each.values[0] in ("CSTR", "BatchReactor")])
def test_vectors_pass_with_sanitizers_and_a_wrong_one_is_found(exported, name, single, tmp_path):
    folder = copied(exported(name, single)[0], tmp_path)
    sanitized = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    program = compiled(folder, "check_vectors.c", out="check", flags=sanitized)
    said = subprocess.run([program], cwd=folder, capture_output=True, text=True, timeout=300)
    assert (said.returncode, said.stderr) == (0, "")
    assert said.stdout.startswith(f"{2 * EPISODE} steps, 0 wrong")
    lines = (folder / "vectors.txt").read_text().splitlines()
    last = max(k for k, line in enumerate(lines) if line.startswith("decide"))
    words = lines[last].split()
    lines[last] = " ".join([*words[:-1], repr(float(words[-1]) + 1e-6)])
    (folder / "vectors.txt").write_text("\n".join(lines))
    said = subprocess.run([program], cwd=folder, capture_output=True, text=True, timeout=300)
    assert said.returncode == 1
    assert ", 1 wrong" in said.stdout


def test_the_main_compiles_and_a_fast_math_filter_does_not(exported, tmp_path):
    folder = copied(exported("CSTR")[0], tmp_path)
    (folder / "arduino.h").write_text(
        "#include <stdbool.h>\n#include <stdint.h>\nuint32_t micros(void);\nvoid pinMode(int, int);\n"
        "void digitalWrite(int, int);\nenum { LED_BUILTIN, OUTPUT, LOW, HIGH };\nvoid setup(void);\nvoid loop(void);\n"
    )
    main = [compiler(), "-std=c99", "-Wall", "-Werror", "-include", "arduino.h", "-x", "c", "-c", "main.ino"]
    subprocess.run(main, cwd=folder, check=True, timeout=300)
    fast = [compiler(), "-ffast-math", "-c", "ncs_filter.c"]
    said = subprocess.run(fast, cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    assert said.returncode != 0
    assert "without -ffast-math" in said.stderr


def test_the_command_says_what_the_board_needs(tmp_path, monkeypatch):
    monkeypatch.setattr(c_files, "VECTOR_STEPS", 2 * EPISODE)
    plant, certificate = example("CSTR")
    plant.save(tmp_path / "plant.json")
    certificate.save(tmp_path / "certificate.json")
    files = tmp_path / "certificate.json", "--plant", tmp_path / "plant.json"
    said = succeeded("verify", *files, "--c", tmp_path / "c")
    assert "1,720 bytes of numbers and 120 bytes of state" in said.prose
    assert "at most 6 steps old" in said.prose
    text = (tmp_path / "c" / "vectors.txt").read_text()
    assert text.count("decide ") == 2 * EPISODE
    if shutil.which("make") and shutil.which("cc"):
        checked = subprocess.run(["make", "-s", "-C", tmp_path / "c"], capture_output=True, text=True, timeout=300)
        assert checked.stdout == f"{2 * EPISODE} steps, 0 wrong; the filter takes 120 bytes\n"


@pytest.mark.parametrize(
    ("file", "plant", "words"),
    [
        ("CartPoleTwoWay", "CartPoleTwoWay", "commits inputs ahead"),
        ("Convoy", "ConvoyOnRequest", "samples on request"),
        ("CSTR", "Convoy", "made for another plant"),
    ],
)
def test_what_is_not_exported_is_refused_in_a_sentence(file, plant, words, tmp_path):
    certificate = package.replace("__init__.py", f"{file}-v0.json")
    said = ncs("verify", certificate, "--env", f"ncs_gym/{plant}-v0", "--c", tmp_path / "c")
    assert (said.returncode, said.stderr.count("\n")) == (2, 1)
    assert words in said.stderr
    assert not (tmp_path / "c").exists()


def test_what_the_board_does_not_know_is_refused():
    plant, certificate = example("CSTR")
    given = {
        "it has no channel contract": example("TruckTrailer")[::-1],
        "its plant has a remainder": example("Pendulum")[::-1],
        "made for another plant": (certificate, example("Convoy")[0]),
        "it has no polytope": (certificate_of(plant, certificate.contract), plant),
        "its plant limits states and inputs together": example("coupled")[::-1],
        "or the box between samples": (Certificate.load(CHECKED_IN / "oscillator.json"), oscillator()),
    }
    for words, refused in given.items():
        with pytest.raises(CertificateError, match=words):
            BoardTable.of(*refused)
