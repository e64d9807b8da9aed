"""`ncs loop`: runs a control loop over a network in real time, as processes of its own."""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from experiments.backends.worker import initialize_worker, signals_blocked
from experiments.commands import short_version
from experiments.network_loop.log import rows_of
from experiments.network_loop.processes import (
    OWN_POLICIES,
    REFUSED,
    NetworkLoop,
    network_channels,
    run_controller_node,
    run_network,
    run_plant,
    suspects_text,
)
from experiments.runs.loops import registered_env
from experiments.runs.policies import require_no_statistics
from experiments.settings import LoopSettings
from experiments.terminal import wrapped
from ncs_gym import NCSEnv
from ncs_gym.network.contract import largest_age
from ncs_gym.network.wire import SHORTEST_KEY
from ncs_gym.reading import LARGEST_KEY, read_file
from ncs_gym.rendering.phase_plane import range_of
from shields import Certificate, Infeasible, certificate_for
from shields.atomic_write import write_atomically
from shields.verification import require_valid

# Budget of `--smoke`.
_SMOKE = {"steps": 100}
# What keys of the summary begin with that say how many datagrams were refused, by reason.
_BY_REASON = "refused, "
# What keys begin with that say how many steps were not proved, by reason.
_NOT_PROVED = "not proved, "
# Seconds that a process may take to end, and between two lines of the view.
_PATIENCE, _PERIOD = 1.0, 1.0


def loop(settings: LoopSettings) -> None:
    """Runs `ncs loop`; raises ChildProcessError if a process of it ends by itself."""
    settings = short_version(settings, **_SMOKE)
    env = registered_env(settings.env)
    settings.out.mkdir(parents=True, exist_ok=True)
    for file in [*settings.out.glob("*-[0-9][0-9][0-9]*.csv")]:
        file.unlink()
    network_loop = _network_loop(settings, env)
    others = {"all": (run_plant, run_network), "plant": (run_plant, run_network), "controller": ()}[settings.role]
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_in_process, args=(run, network_loop), daemon=True) for run in others]
    try:
        for process in processes:
            with signals_blocked():
                process.start()
        if settings.role == "plant":
            print(f"the plant waits for a controller at {settings.host}, port {settings.port}; end it with Ctrl-C")
            with suppress(KeyboardInterrupt):  # which ends both processes, too
                while all(process.is_alive() for process in processes):
                    time.sleep(_PERIOD / 4)
                raise ChildProcessError("a process of the loop ended by itself; its message is above")
        else:
            with LiveView(settings, env) as show:
                alone = lambda: not all(each.is_alive() for each in processes)  # noqa: E731
                was_told = run_controller_node(network_loop, show, alone)
            if not was_told and alone():
                raise ChildProcessError("a process of the loop ended by itself; its message is above")
    finally:
        started = [process for process in processes if process.pid is not None]
        for process in started:
            process.terminate()
        for process in started:
            process.join(_PATIENCE)
            process.kill()
    summary = summary_of(settings.out)
    write_atomically(settings.out / "summary.json", json.dumps(summary, indent=1) + "\n")
    print(text_of(summary))
    if refused := {
        reason: summary[_BY_REASON + words] for reason, words in REFUSED.items() if _BY_REASON + words in summary
    }:
        print(wrapped(f"Of the datagrams refused: {suspects_text(refused, settings)}."))


def text_of(summary: dict[str, Any]) -> str:
    """Returns a summary as a table, and below it a sentence for each reason why steps were not proved."""
    reasons = {name: count for name, count in summary.items() if name.startswith(_NOT_PROVED)}
    numbers = {name: value for name, value in summary.items() if name not in reasons}
    width = max(map(len, numbers))
    lines = [f"{name:>{width}}  {value}" for name, value in numbers.items()]
    lines += [wrapped(f"Not proved ({count}): {name.removeprefix(_NOT_PROVED)}.") for name, count in reasons.items()]
    return "\n".join(lines)


def _in_process(run: Callable[[NetworkLoop], None], network_loop: NetworkLoop) -> None:
    """Runs a process of the loop; the module that registers the environment is imported in each."""
    initialize_worker()
    try:
        run(network_loop)
    except OSError as error:
        sys.exit(f"ncs: {error}")


def _network_loop(settings: LoopSettings, env: NCSEnv) -> NetworkLoop:
    """Returns the loop that all processes understand, with its certificate in the folder."""
    given = _given(settings, env)
    contract = None if env.contract is None else given.contract
    if settings.certificate is None:
        try:
            certificate = certificate_for(env.plant, contract)
        except Infeasible as error:
            ages = [
                f"{way.most_consecutive_losses} + {way.delay} + {way.jitter} + {settings.room}"
                for way in (given.uplink, given.downlink)
            ]
            raise ValueError(
                f"{error}; there and back, what the network promises adds up to max_age: max_consecutive_losses + "
                f"delay + jitter + --room, now {ages[0]} by --channel and {ages[1]} by --downlink, which "
                "take NAME=VALUE ... each to change that"
            ) from error
    else:
        certificate = Certificate.load(settings.certificate)
        require_valid(certificate, env.plant)
    certificate.save(given.certificate)
    return given


def _given(settings: LoopSettings, env: NCSEnv) -> NetworkLoop:
    uplink, downlink = network_channels(env, settings.channel, settings.downlink)
    if settings.ask_age is not None and not uplink.on_request:
        raise ValueError(f"--ask-age: {settings.env} sends samples by itself; --channel on_request=True makes it ask")
    key = os.urandom(32) if settings.key_file is None else read_file(settings.key_file, LARGEST_KEY)
    if len(key) < SHORTEST_KEY:
        raise ValueError(f"{settings.key_file} must hold at least {SHORTEST_KEY} bytes")
    if settings.policy in OWN_POLICIES:
        require_no_statistics(settings.vec_normalize, settings.policy)
    max_age = largest_age(env.contract, 0)
    return NetworkLoop(settings=settings, uplink=uplink, downlink=downlink, secret=key, max_age=max_age)


class LiveView:
    """Shows the loop while it runs: a table with rich if it is installed, else a line per second; or nothing."""

    def __init__(self, settings: LoopSettings, env: NCSEnv) -> None:
        self._ranges = {name: range_of(env.plant, i) for i, name in enumerate(env.plant.state_names)}
        self._is_shown = settings.live == "yes" or (settings.live == "auto" and sys.stdout.isatty())
        self._next, self._seen, self._live = 0.0, Counter[str](), None

    def __enter__(self) -> Callable[[dict[str, Any]], None] | None:
        if not self._is_shown:
            return None
        try:
            from rich.live import Live

            self._live = Live(refresh_per_second=8)
            self._live.start()
        except ImportError:
            pass
        return self._show

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()
            if not self._live.console.is_terminal:  # where the table is left without an end of line
                print()

    def _show(self, row: dict[str, Any]) -> None:
        self._seen["overridden" if _is_answered(row) else "unanswered"] += int(row["intervened"])
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + (_PERIOD if self._live is None else _PERIOD / 8)
        proved = "proved" if row["guaranteed"] else f"NOT PROVED: {row['reason']}"
        counts = f"overridden {self._seen['overridden']}, missing {row['missing']}, late {row['skipped']}"
        counts += f", unanswered {unanswered}" if (unanswered := self._seen["unanswered"]) else ""
        known = f"margin {row['margin']:.2f}, age {row['age']}; {counts}, refused {row['refused']}"
        line = f"step {row['step']}: {proved}; {known}"
        if self._live is None:
            print(wrapped(line), flush=True)
            return
        from rich.table import Table

        table = Table(title=line)
        for title in ("state", "estimate", "of the box"):
            table.add_column(title, min_width=12)
        for name, limits in self._ranges.items():
            share = (row[f"x_hat_{name}"] - limits.middle) / limits.half
            place = min(max(round(15 * (1 + share)), 0), 30)
            bar = "".join("#" if i == place else "|" if i in (0, 15, 30) else "-" for i in range(31))
            table.add_row(name, f"{row[f'x_hat_{name}']:.4f}", f"{bar} {share:+.0%}")
        self._live.update(table)


def _is_answered(row: dict[str, Any]) -> bool:
    """Returns whether the policy proposed something in time, in a row of the controller's log."""
    return any(value not in ("", None) for name, value in row.items() if name.startswith("proposed_"))


def _counts(written: str) -> list[list[str]]:
    """Returns reasons and how many datagrams were refused for each, as a log has them."""
    return [entry.split(":") for entry in written.split()]


def summary_of(folder: Path) -> dict[str, Any]:
    """Returns what the logs of plant and controller say together.

    A step is broken once an input was missing: from then on nothing is claimed of the episode, and until the controller
    hears of it what it says is void.
    """
    proved: dict[tuple[str, str], str] = {}
    counts: Counter[str] = Counter()
    ages, times = Counter[int](), []
    for row in rows_of(folder, "controller"):
        proved[row["episode"], row["step"]] = row["guaranteed"]
        counts["steps"] += 1
        counts["proved"] += row["guaranteed"] == "1"
        counts["overridden" if _is_answered(row) else "unanswered"] += row["intervened"] == "1"
        counts["reason: " + row["reason"]] += bool(row["reason"])
        ages[int(row["age"])] += 1
        times.append(int(row["microseconds"]))
        last = row
    last_of: dict[str, int] = {}
    for row in rows_of(folder, "plant"):
        missing, key = int(row["missing"]), (row["episode"], row["step"])
        last_of[row["episode"]] = missing
        counts["plant"] += 1
        counts["sent"] += row["sent"] == "1"
        counts["outside"] += row["outside"] == "1"
        counts["outside, proved"] += row["outside"] == "1" and proved.get(key) == "1" and missing == 0
        counts["proved, missed"] += proved.get(key) == "1" and missing > 0
    summary: dict[str, Any] = {"episodes": len(last_of.keys() | {episode for episode, _ in proved})}
    if proved:  # else the controller's log is on the other machine
        summary |= {
            "steps of the controller": counts["steps"],
            "proved": counts["proved"],
            "overridden": counts["overridden"],
            "not answered in time by the policy": counts["unanswered"],
            "decided too late": int(last["skipped"]),
            "datagrams refused": int(last["refused"]),
            **{
                _BY_REASON + REFUSED[reason]: int(count) for reason, count in _counts(last["refused_why"]) if int(count)
            },
            "oldest sample in use": max(ages),
        }
        q = np.quantile(times, [0.5, 0.999, 1.0]).round().astype(int).tolist()
        summary["ms into the step, 50/99.9/100 %"] = " / ".join(f"{each / 1000:.2f}" for each in q)
    if last_of:  # else the plant's is
        summary |= {
            "steps of the plant": counts["plant"],
            "outside the box": counts["outside"],
            "inputs missing": sum(last_of.values()),
            "samples sent per step": round(counts["sent"] / counts["plant"], 3),
        }
    if proved and last_of:
        summary["outside although proved"] = counts["outside, proved"]
        summary["proved, a miss not yet heard"] = counts["proved, missed"]
    reasons = {name.removeprefix("reason: "): count for name, count in counts.items() if name.startswith("reason: ")}
    return summary | {_NOT_PROVED + name: count for name, count in reasons.items() if count}
