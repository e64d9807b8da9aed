"""`ncs requirements`: which networks leave a plant certifiable, and the cheapest of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

import shields
from experiments.analysis.stalls import broken_contracts, how_often, silences_text
from experiments.backends.execution import results_of
from experiments.plots.heatmaps import requirements_map
from experiments.runs.loops import registered_env
from experiments.runs.output_folder import claim_folder, write_results
from experiments.runs.provenance import versions
from experiments.settings import RequirementsSettings
from experiments.terminal import text_table, wrapped
from ncs_gym import ChannelContract, LinearPlant, PacketLog
from ncs_gym.network.channel import in_time
from ncs_gym.network.requests import spare_samples
from ncs_gym.validation import counted
from shields import Certificate, Network, Requirement, Requirements
from shields.json_documents import digest
from shields.synthesis.network_requirements import LargestAge, kind_of_share
from shields.synthesis.requirement_search import Answer, Search

_DEFAULT_ENV = "ncs_gym/CartPole-v0"
# Steps between samples, and losses in a row, that are asked about by default.
_SEND_PERIODS, _LOSSES = (1, 2, 3, 4, 6, 8), (0, 1, 2, 3, 4, 5)
# What a network consists of: the setting, the field of `Network`, and its name in tables and figures.
_AXES = {
    "sampling_periods": ("sampling_period", "sampling period [s]"),
    "send_periods": ("send_period", "steps between samples"),
    "losses": ("losses", "losses in a row"),
    "delays": ("delay", "delay [steps]"),
    "jitters": ("jitter", "jitter [steps]"),
    "input_delays": ("input_delay", "input delay [steps]"),
    "quantization_steps": ("quantization_step", "quantization step"),
    "disturbances": ("disturbance", "size of disturbances"),
    "noises": ("noise", "size of noise"),
}
# What the numbers of a table of shares are, by what has them.
_SHARES = {
    "ellipsoid": "ellipsoid's share of the box [%]",
    "polytope": "polytope's share of the box [%]",
    "certificate": "100: a certificate, whose share of the box is not known",
}
# Progress is counted in these parts of a search: workers report a thousand at a time.
_PARTS = 1000
_MOST_PANELS = 9


def requirements(settings: RequirementsSettings) -> None:
    """Runs `ncs requirements`."""
    plant, today = _plant_and_network(settings)
    asked = _values(settings, plant, today)
    log = None if settings.log is None else PacketLog.load(settings.log)
    with claim_folder("requirements", settings):
        found = shields.requirements(
            plant,
            **asked,
            tolerance=settings.tolerance,
            execute=lambda searches: [
                each.answers for each in results_of(list(map(_SearchRun, searches)), settings.out, settings)
            ],
        )
        wanted = {"share": True, "tolerance": settings.tolerance}
        names = [name for name, is_wanted in wanted.items() if is_wanted]
        tables = [_Table.of(found, asked, name) for name in names]
        figures = {}
        for name, table in zip(names, tables, strict=True):
            figure = table.figure(today)
            figures[name] = (figure.caption, figure.png)
        place = settings.out / "certificates"
        place.mkdir(exist_ok=True)
        for point in found.points:
            if point.certificate is not None:
                point.certificate.save(place / f"{point.certificate.checksum[:16]}.json")
        cheapest = found.cheapest(settings.keep / 100.0)
        summary = found.document | {
            "command": "requirements",
            "log": None if log is None else log.read_as,
            "plant_fingerprint": plant.fingerprint,
            "today": None if today is None else _index_of(found, today),
            "cheapest": None if cheapest is None else found.points.index(cheapest),
            "keep": settings.keep,
            "versions": versions(),
        }
        write_results(settings.out, summary, figures=figures)
    for table in tables:
        print(table.text, end="\n\n")
    sentences = [
        *(_boundary_text(each, _late(found)) for each in found.largest_ages),
        *(() if log is None else _log_texts(log, found, today, plant)),
        _today_text(found, today),
        _requests_text(found, settings),
    ]
    sentences += [_cheapest_text(found, settings, None), _cheapest_text(found, settings, today)]
    for sentence in dict.fromkeys(sentences):
        if sentence:
            print(wrapped(sentence))
    print(f"files: {settings.out}")


def _plant_and_network(settings: RequirementsSettings) -> tuple[LinearPlant, Network | None]:
    """Returns the plant, and the network that it has today; None for the plant of a file."""
    if settings.plant is not None:
        return LinearPlant.load(settings.plant), None
    env = registered_env(settings.env or _DEFAULT_ENV)
    plant, channel = env.plant, env.channel
    network = Network(
        sampling_period=plant.dt,
        send_period=channel.send_period,
        losses=channel.most_consecutive_losses,
        delay=channel.delay,
        jitter=channel.jitter,
        input_delay=env.downlink_protocol.input_delay,
        quantization_step=channel.quantization_step,
    )
    return plant, network


def _values(settings: RequirementsSettings, plant: LinearPlant, today: Network | None) -> dict[str, Sequence[Any]]:
    """Returns the values of every axis: those given, else today's, and of losses and periods the usual ones, too."""
    default = today or Network(sampling_period=plant.dt)
    values = {}
    for name, (entry, _) in _AXES.items():
        given = tuple(None if value == "any" else value for value in getattr(settings, name))
        values[name] = given or (getattr(default, entry),)
    if not settings.send_periods:
        values["send_periods"] = tuple(sorted({*_SEND_PERIODS, default.send_period}))
    if not settings.losses:
        limited = {*_LOSSES, *(() if default.losses is None else (default.losses,))}
        values["losses"] = (*sorted(limited), *((None,) if plant.spectral_radius < 1.0 else ()))
    return values


@dataclass(frozen=True)
class _StoredAnswer:
    """What a search found for one age, as JSON values.

    Attributes:
        age: Largest age of the newest sample [steps]; None for no contract.
        searched: Whether a certificate was sought.
        tolerance: The factor on all radii that it tolerates; None if that was not sought.
        certificate: Its document; None for none.
    """

    age: float | None
    searched: bool
    tolerance: float | None
    certificate: dict[str, Any] | None

    @classmethod
    def of(cls, age: float, answer: Answer) -> _StoredAnswer:
        document = None if answer.certificate is None else answer.certificate.document
        return cls(None if age == inf else age, answer.searched, answer.tolerance, document)

    @property
    def answer(self) -> Answer:
        certificate = None if self.certificate is None else Certificate.read(self.certificate)
        return Answer(certificate, self.searched, self.tolerance)


@dataclass(frozen=True)
class _SearchResult:
    """What a search found for each age."""

    found: tuple[_StoredAnswer, ...]

    @classmethod
    def of_json(cls, values: dict[str, Any]) -> _SearchResult:
        return cls(tuple(_StoredAnswer(**each) for each in values["found"]))

    @property
    def answers(self) -> dict[float, Answer]:
        """The answers by age, infinite for no contract."""
        return {inf if each.age is None else int(each.age): each.answer for each in self.found}

    @property
    def outcome(self) -> str:
        """The largest age that is certified."""
        certified = [inf if each.age is None else each.age for each in self.found if each.certificate is not None]
        return f"certified up to {max(certified):g}" if certified else "no certificate found"

    @property
    def files(self) -> dict[str, bytes]:
        return {}


@dataclass(frozen=True)
class _SearchRun:
    """A search as a `Run`, whose steps are thousandths of an age."""

    search: Search
    parts: tuple[str, ...] = ("search",)
    unit: str = ""
    result_type: type = _SearchResult
    leaves: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.search.title

    @property
    def key(self) -> str:
        search = self.search
        ages = [None if age == inf else age for age in search.ages]
        return digest([search.plant.fingerprint, search.quantization_step, ages, search.tolerance, versions()])

    @property
    def total_steps(self) -> int:
        return _PARTS * self.search.count

    def execute(self, on_progress: Callable[[int], None], log_folder: Path | None = None) -> _SearchResult:
        answers = self.search(lambda count: on_progress(_PARTS * count))
        return _SearchResult(tuple(_StoredAnswer.of(age, answer) for age, answer in answers.items()))


@dataclass(frozen=True)
class _Table:
    """A quantity of every network: a block per combination of what rows and columns do not show.

    Attributes:
        quantity: What the numbers are.
        rows: Name and values of the rows.
        columns: Name and values of the columns.
        blocks: Numbers by title, shape (rows, columns); NaN where no certificate was found.
        fixed: What the networks of a block have in common, by title.
        entries: Fields of `Network` that rows and columns show.
    """

    quantity: str
    rows: tuple[str, Sequence[Any]]
    columns: tuple[str, Sequence[Any]]
    blocks: dict[str, np.ndarray]
    fixed: dict[str, dict[str, Any]]
    entries: tuple[str, str]

    @classmethod
    def of(cls, found: Requirements, asked: dict[str, Sequence[Any]], quantity: str) -> _Table:
        several = [name for name in _AXES if len(asked[name]) > 1]
        shown = (several + [name for name in ("send_periods", "losses") if name not in several])[:2]
        others = [name for name in several if name not in shown]
        (down, down_name), (across, across_name) = (_AXES[name] for name in shown)
        blocks, fixed = {}, {}
        for values in product(*(asked[name] for name in others)):
            common = {_AXES[name][0]: value for name, value in zip(others, values, strict=True)}
            title = ", ".join(f"{_AXES[name][1]} {_shown(value)}" for name, value in zip(others, values, strict=True))
            block = np.full((len(asked[shown[0]]), len(asked[shown[1]])), np.nan)
            for point in found.points:
                if all(getattr(point.network, entry) == value for entry, value in common.items()):
                    i = asked[shown[0]].index(getattr(point.network, down))
                    j = asked[shown[1]].index(getattr(point.network, across))
                    block[i, j] = _number(point, quantity)
            blocks[title], fixed[title] = block, common
        title, axes = _title(found, quantity), [(down_name, asked[shown[0]]), (across_name, asked[shown[1]])]
        return cls(title, axes[0], axes[1], blocks, fixed, (down, across))

    @property
    def text(self) -> str:
        """The table for a terminal."""
        parts = []
        for title, block in self.blocks.items():
            header = [f"{self.rows[0]} \\ {self.columns[0]}", *map(_shown, self.columns[1])]
            cells = [
                [_shown(value), *("-" if np.isnan(number) else f"{number:.3g}" for number in line)]
                for value, line in zip(self.rows[1], block, strict=True)
            ]
            parts.append(f"{self.quantity}{', ' if title else ''}{title}\n{text_table([header, *cells])}")
        return "\n\n".join(parts)

    def figure(self, today: Network | None) -> Any:
        """The heatmap, with the first panels where there are too many."""
        marked = None
        for title, common in self.fixed.items():
            if today is None or any(getattr(today, entry) != value for entry, value in common.items()):
                continue
            at = [getattr(today, entry) for entry in self.entries]
            if at[0] in self.rows[1] and at[1] in self.columns[1]:
                marked = title, list(self.rows[1]).index(at[0]), list(self.columns[1]).index(at[1])
        panels = dict(list(self.blocks.items())[:_MOST_PANELS])
        return requirements_map(panels, self.rows, self.columns, marked, self.quantity)


def _title(found: Requirements, quantity: str) -> str:
    """Returns what the numbers of a table are."""
    if quantity == "tolerance":
        return "factor on all radii"
    certificates = (point.certificate for point in found.points if point.certificate is not None)
    return _SHARES[next(map(kind_of_share, certificates), "ellipsoid")]


def _number(point: Requirement, quantity: str) -> float:
    if point.certificate is None:
        return float("nan")
    return 100.0 * point.share if quantity == "share" else point.tolerance or float("nan")


def _index_of(found: Requirements, network: Network) -> int | None:
    return next((i for i, point in enumerate(found.points) if point.network == network), None)


def _late(found: Requirements) -> list[int]:
    """Returns by how many steps inputs are late in the networks asked about, which ages of contracts count."""
    return sorted({point.network.input_delay for point in found.points})


def _boundary_text(largest: LargestAge, late: list[int]) -> str:
    network, counted_too = largest.network, late[0] if len(late) == 1 else 0
    where = network.setting.capitalize()
    if counted_too:
        where += f", inputs {counted(counted_too, 'step')} late"
    if largest.certified is None or largest.certified < counted_too:
        return f"{where}: no certificate was found for any age of the newest sample that was asked."
    if largest.certified == inf:
        return f"{where}: a certificate needs no samples at all."
    age = largest.certified - counted_too
    steps = f"{age:g} steps ({in_time(age * network.sampling_period)})"
    text = f"{where}: the newest sample may be {steps} old"
    if len(late) > 1:
        text = f"{where}: the age of the newest sample and the steps that inputs are late may be {steps} together"
    beyond = "; no older one was asked"
    if largest.none_found is not None:
        beyond = f"; for {_shown_age(largest.none_found - counted_too)} no certificate was found"
    return f"{text}{beyond}."


def _log_texts(log: PacketLog, found: Requirements, today: Network | None, plant: LinearPlant) -> Iterator[str]:
    """Yields how a record was read, and how often it would have broken the contract of today and the widest ones."""
    yield log.read_as
    yield log.disagreement
    widest = "The widest contract with a certificate"
    late = _late(found)
    asked = [
        (
            (widest if each.none_found is not None else f"{widest} of those asked")
            + (f" for inputs {counted(steps, 'step')} late" if len(late) > 1 else ""),
            replace(each.network, input_delay=steps),
            each.certified,
        )
        for each in found.largest_ages
        for steps in late
    ]
    if today is not None and today.contract is not None:
        asked.insert(0, ("Today's contract", today, today.contract.max_age))
    if any(each.certified == inf for each in found.largest_ages):
        yield "A certificate that needs no samples at all keeps whatever the record lost."
    for which, network, age in asked:
        if age is not None and age != inf and age >= network.input_delay:
            dt, oldest = network.sampling_period, int(age) - network.input_delay
            (row,) = (each for each in broken_contracts(log.ages(dt), dt, (oldest,)) if each["max_age"] == oldest)
            yield f"{which}, {counted(oldest, 'step')} of {dt:g} s, the record breaks {how_often(row)}."
    index = None if today is None else _index_of(found, today)
    certificate = None if index is None else found.points[index].certificate
    if (
        today is not None
        and certificate is not None
        and (silence := shields.silence_of(certificate, plant)) is not None
    ):
        age, dt = silence.max_age - today.input_delay + silence.anywhere, today.sampling_period
        (row,) = (each for each in broken_contracts(log.ages(dt), dt, (age,)) if each["max_age"] == age)
        yield silences_text(age, row, "today's contract")


def _shown_age(age: float) -> str:
    return "any age" if age == inf else f"{age:g}"


def _today_text(found: Requirements, today: Network | None) -> str:
    index = None if today is None else _index_of(found, today)
    return "" if index is None else f"Today: {_description(found.points[index])}."


def _requests_text(found: Requirements, settings: RequirementsSettings) -> str:
    """Returns how many samples may be left out where they are on request; empty for other channels."""
    env = None if settings.plant is not None else registered_env(settings.env or _DEFAULT_ENV)
    if env is None or not env.channel.on_request or env.contract is None:
        return ""
    spare = spare_samples(env.channel, env.contract)
    text = (
        f"Samples are on request: of those newer than the newest that arrived, {spare} may be left out under the "
        f"contract of {counted(env.contract.max_age, 'step')}"
    )
    delay = env.downlink_protocol.input_delay
    largest = [each.certified for each in found.largest_ages if each.certified not in (None, inf)]
    if len(largest) == 1 and (oldest := int(largest[0]) - delay) >= env.contract.max_age:
        longest = spare_samples(env.channel, ChannelContract(oldest, env.contract.quantization_step))
        text += f", and {longest} under one of {counted(oldest, 'step')}"
    return f"{text}. Today's line above is that of asking for every sample."


def _cheapest_text(found: Requirements, settings: RequirementsSettings, bearing: Network | None) -> str:
    cheapest = found.cheapest(settings.keep / 100.0, bearing)
    if cheapest is None:
        if bearing is not None:
            return ""
        plant = f"--env {settings.env or _DEFAULT_ENV}" if settings.plant is None else f"--plant {settings.plant}"
        advice = f"`ncs synthesize {plant} --max-age 0` says what binds, and what would help"
        if settings.sampling_periods:  # it is about the plant's own
            advice = (
                "`shields.synthesize(plant.resampled(dt), contract=ChannelContract(0))` says what binds at one of them"
            )
        return f"No certificate was found for any of these networks: {advice}."
    what = "Cheapest" if bearing is None else "Cheapest that bears the losses and delays of today"
    known = cheapest.certificate is not None and kind_of_share(cheapest.certificate) != "certificate"
    kept = f"with at least {settings.keep:g} % of the largest share" if known else "with a certificate"
    return f"{what}, {kept}: {_description(cheapest)}."


def _description(point: Requirement) -> str:
    network = point.network
    every = "step" if network.send_period == 1 else counted(network.send_period, "step")
    parts = [f"a step of {network.sampling_period:g} s", f"a sample every {every}"]
    losses = f"at most {network.losses} lost in a row" if network.losses else "none lost"
    parts.append("any losses" if network.losses is None else losses)
    if network.delay or network.jitter:
        latest = network.delay + network.jitter
        parts.append(f"at most {counted(latest, 'step')} late")
    if network.input_delay:
        parts.append(f"inputs {counted(network.input_delay, 'step')} late")
    if network.quantization_step:
        parts.append(f"rounded to {network.quantization_step:g}")
    parts.append(f"{_rate(network.packets_per_second)} packets/s and {_rate(point.bits_per_second)} bits/s")
    kept = "no certificate was found"
    if point.certificate is not None:
        kind = kind_of_share(point.certificate)
        kept = {"ellipsoid": "an ellipsoid", "polytope": "a polytope"}.get(kind, "a certificate")
        kept += "" if kind == "certificate" else f" of {100.0 * point.share:.3g} % of the box"
    return f"{', '.join(parts)}: {kept}"


def _rate(number: float) -> str:
    return f"{number:,.0f}" if number >= 1000.0 else f"{number:.4g}"


def _shown(value: Any) -> str:
    return "any" if value is None else f"{value:g}"
