"""Writes the filter in C, with test vectors and what checks them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path

import numpy as np

from ncs_gym import Channel, LinearPlant
from shields.certificate import Certificate
from shields.documents import write_atomically
from shields.export.board_filter import BoardFilter
from shields.export.board_table import BoardTable

_TEMPLATES = Path(__file__).parent / "templates"
# Steps of the test vectors, and of an episode of these.
VECTOR_STEPS, EPISODE_STEPS = 10_000, 250


def export_c(certificate: Certificate, plant: LinearPlant, folder: Path, *, single: bool = False) -> BoardTable:
    """Writes `ncs_filter.c` and its header, test vectors with a driver, and a main, into a folder.

    Args:
        certificate: Verified exactly here.
        plant: The plant it was made for.
        folder: Made if it is not there; files of the same names are replaced.
        single: Whether the rows of the safe set are float, which has a margin of its own.

    Raises:
        CertificateError: If it does not verify, or is of a kind that is not exported; nothing was written then.
        OSError: If a file cannot be written.
    """
    table = BoardTable.of(certificate, plant, single=single)
    sizes = [f"#define NCS_{name} {value}" for name, value in table.sizes.items()]
    sizes += [f"#define NCS_MARGIN {table.margin!r}"]
    if plant.dt is not None and round(1e6 * plant.dt) >= 1:
        sizes.append(f"#define NCS_PERIOD_US {round(1e6 * plant.dt)}u")
    doubles, rows = (list(part.items()) for part in (table.doubles, table.rows))
    fields = {
        "SIZES": "\n".join(sizes),
        "REAL": "float" if single else "double",
        "OFFSETS": ",\n".join([*_offsets(doubles, "TABLE_SIZE"), *_offsets(rows, "ROWS_SIZE")]),
        "TABLE": _listed(doubles, ""),
        "ROWS": _listed(rows, "f" if single else ""),
        "CHECKSUM": hex(table.checksum),
        "CERTIFICATE": certificate.checksum[:16],
        "FINGERPRINT": plant.fingerprint[:16],
    }
    files = {"vectors.txt": "\n".join(_vectors(table, plant, certificate)) + "\n"}
    for template in sorted(_TEMPLATES.iterdir()):
        text = template.read_text(encoding="utf-8")
        for name, value in fields.items():
            text = text.replace(f"@{name}@", value)
        files[template.name] = text
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_atomically(folder / name, text)
    return table


def _offsets(parts: list[tuple[str, np.ndarray]], end: str) -> list[str]:
    """Returns where each array begins in a table, and its size, as entries of an enumeration."""
    starts, names = accumulate((each.size for _, each in parts), initial=0), [*(name.upper() for name, _ in parts), end]
    return [f"    {name} = {start}" for name, start in zip(names, starts, strict=True)]


def _listed(parts: list[tuple[str, np.ndarray]], suffix: str) -> str:
    return ",\n".join(", ".join(f"{value!r}{suffix}" for value in each.ravel().tolist()) for _, each in parts)


def _vectors(table: BoardTable, plant: LinearPlant, certificate: Certificate) -> Iterator[str]:
    """Yields lines of a simulation: samples late, lost and out of order, in some episodes also what breaks a proof."""
    rng, h, updates = np.random.default_rng(0), len(table.limit) - 1, certificate.updates
    assert updates is not None  # or it is not exported
    channel = Channel(quantization_step=updates.contract.quantization_step)
    for episode in range(VECTOR_STEPS // EPISODE_STEPS):
        x = certificate.resting_state
        first = x + plant.nominal_initial_error.sample_boundary(rng)
        board, taken, breaks = BoardFilter(table, episode, first), [np.zeros(plant.p)], episode % 4 == 3
        yield f"start {episode} {_text(first)}"
        for step in range(EPISODE_STEPS):
            if step:
                taken.append(channel.quantize(plant.H @ x + plant.nominal_sensor_error.sample_boundary(rng)))
            late = [stamp for stamp in range(max(step - h, 0), step + 1) if rng.random() < 0.5 / (h + 1)]
            if board.age > h - (not late) and not breaks:
                late.append(step - int(rng.integers(min(h, board.age - 1) + 1)))
            for stamp in late:
                of, y = (episode + 1, taken[stamp]) if rng.random() < 0.05 else (episode, taken[stamp])
                if breaks and rng.random() < 0.005:
                    stamp, y = [(stamp, np.full(plant.p, np.nan)), (step + 1, y), (stamp, y + 1e3)][rng.integers(3)]
                yield f"sample {of} {stamp} {_text(y)}"
                board.receive(of, stamp, y)
            outwards = plant.input_ends[int(step % 50 < 25)]
            proposed = rng.choice([-1.0, 1.0, 1.0, 3.0, 0.1], plant.m) * outwards
            proposed = np.full(plant.m, np.nan) if rng.random() < 0.01 else proposed
            estimate = board.estimate
            decision, u = board.decide(proposed)
            yield f"decide {_text(proposed)} {_text(estimate)} {decision} {board.reason} {_text(u)}"
            if breaks and rng.random() < 0.002:
                u = 0.5 * u
                yield f"applied {_text(u)}"
                board.applied(u)
            x = plant.A @ x + plant.B @ u + plant.nominal_disturbance.sample_boundary(rng)


def _text(numbers: np.ndarray) -> str:
    return " ".join(map(repr, numbers.tolist()))
