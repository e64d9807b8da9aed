"""The benchmark of docs/benchmark.md, tasks x arms x blocks of seeds: `python -m benchmarks.suite COMMAND`.

Commands: measure, replicate, pages.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt
from pathlib import Path
from textwrap import fill
from typing import Annotated, Any

import numpy as np
from scipy.stats import sem, t

from agents.agent import AGENT_FILES
from agents.evaluation import Policy, evaluate
from agents.hyperparams import DEFAULTS, with_changes
from agents.loop import LoopConfig
from benchmarks.commands import run, some_of
from benchmarks.suite_figures import suite_figures
from benchmarks.suite_observations import OneErrorSet, Remembered, Shown
from benchmarks.suite_recurrent import recurrent
from experiments.analysis.episodes import episodes_table, training_table
from experiments.analysis.statistics import CONFIDENCE, clopper_pearson
from experiments.backends.execution import results_of
from experiments.baselines.tuned import tuned_training
from experiments.commands.compare import CompareSettings
from experiments.runs.arms import run_of_arm
from experiments.runs.loops import AS_TRAINED, certificate_of, loop_config, registered_env, under
from experiments.runs.provenance import versions
from experiments.runs.training_run import RunResult, TrainingRun
from experiments.settings import Assignments
from experiments.terminal import text_table
from ncs_gym import Channel, ChannelContract

ROOT = Path(__file__).resolve().parents[1]
# Where numbers are kept as they come, those that the page shows, and the page.
MEASURED, NUMBERS, PAGE = Path("runs/suite/numbers.json"), Path("docs/results.json"), Path("docs/benchmark.md")
# Runs of a primary arm and block, steps of a training, and episodes of a run in each scenario.
SEEDS, STEPS, EPISODES = 10, 60_000, 25
# Tasks in which the network decides, and others, each with why it is there.
NETWORK_TASKS = {
    "CSTR-v0": "a reactor at an unstable point (Seborg et al. 2016), asked to go near its limit",
    "Convoy-v0": "a vehicle with a lagging drive, pushed for long by the leader's speed",
    "LaneKeeping-v0": "an integrator of an integrator in a narrow lane, pushed by side wind",
}
OTHER_TASKS = {
    "TruckTrailerCruise-v0": "the paper's plant, loaded, following a profile of speeds",
    "TruckTrailer-v0": "the paper's plant as it is there, at which nobody violates",
    "BatchReactor-v0": "unstable, with two inputs, four states and two outputs",
    "CartPole-v0": "the unstable plant of many papers on learning, linear, with full states",
}
TASKS = (*NETWORK_TASKS, *OTHER_TASKS)

ATTACKED, IDEAL = "attacked", "attacked on an ideal channel"
SCENARIOS = (ATTACKED, IDEAL)


@dataclass(frozen=True)
class Entry:
    """A row of the table: how its agents are trained, and what they act behind where they are judged.

    Attributes:
        arm: Arm of `ncs compare` by which agents are trained, or that needs no training.
        tested: Arm behind whose filter they are judged; empty for the same.
        attacked: Whether they are trained under the attack.
        observed: What agents see besides: "disturbance", the estimated one, or "memory"; empty for nothing.
        safe_set: What the shield keeps, "ellipsoid"; empty for the polytope of the others.
        one_error_set: Whether the shield takes every error for one that holds those of all ages.
        policy: Makes what acts, as of `row_of`; None for the arm's own agents or regulator.
        everywhere: Whether the row is that of all tasks, not only of those in which the network decides.
        seeds: Runs of a block; None for as many as asked for.
    """

    arm: str
    tested: str = ""
    attacked: bool = False
    observed: str = ""
    safe_set: str = ""
    one_error_set: bool = False
    policy: Callable[[LoopConfig, int], Policy] | None = None
    everywhere: bool = False
    seeds: int | None = None

    @property
    def tuned_as(self) -> str:
        """Name under which is kept what was tuned for its agents or regulator."""
        return f"{self.arm}, {self.observed}" if self.observed else self.arm


# Rows of the table by name. The first ones are primary: each has all runs of both blocks.
PRIMARY = {
    "unshielded": Entry("unshielded", everywhere=True),
    "trusting:20": Entry("trusting:20"),
    "shielded": Entry("shielded", everywhere=True),
    "shielded, disturbance": Entry("shielded", observed="disturbance"),
    "shield at test": Entry("unshielded", "shielded", everywhere=True),
    "shield in training": Entry("shielded", "unshielded", everywhere=True),
    "lqr:observer+shielded": Entry("lqr:observer+shielded", everywhere=True),
}
SECONDARY = {
    "penalized": Entry("penalized", seeds=5),
    "lagrangian": Entry("lagrangian", seeds=5),
    "lagrangian:0.1": Entry("lagrangian:0.1", seeds=5),
    "lagrangian:1": Entry("lagrangian:1", seeds=5),
    "unshielded, attacked": Entry("unshielded", attacked=True, seeds=5),
    "shielded, memory": Entry("shielded", observed="memory", seeds=5),
    "shielded, recurrent": Entry("shielded", policy=recurrent, seeds=5),
}
REGULATED = {
    "lqr": Entry("lqr", everywhere=True),
    "lqr:observer": Entry("lqr:observer", everywhere=True),
    **{name: Entry(name) for name in ("mpc:20", "mpc:40", "mpc:observer", "mpc:observer+shielded")},
    **{f"lqr+{name}": Entry(f"lqr+{name}") for name in ("trusting:20", "psf:20", "psf:tube")},
    "lqr+shielded": Entry("lqr+shielded", everywhere=True),
    "lqr:observer+ellipsoid": Entry("lqr:observer+shielded", safe_set="ellipsoid"),
    "lqr:observer+one set": Entry("lqr:observer+shielded", one_error_set=True),
    "lqr:observer+lookahead": Entry("lqr:observer+lookahead"),
}
# Policies that are the same in all runs need fewer.
REGULATED = {name: replace(entry, seeds=4) for name, entry in REGULATED.items()}
ENTRIES = PRIMARY | SECONDARY | REGULATED


def rows_of(task: str) -> tuple[str, ...]:
    """Returns the names of the rows of a task."""
    return tuple(name for name, entry in ENTRIES.items() if entry.everywhere or task in NETWORK_TASKS)


# Points at which training curves are kept.
CURVE_POINTS = 16

# Impairments of a channel; a rate is a sample every second step. Rows that are attacked with each of them.
SWITCHES, SLOW = ("loss", "delay", "rate", "rounding"), 2
SWITCHED = ("unshielded", "trusting:20", "shielded")
# So few runs of them play so few episodes with each.
SWITCHED_RUNS, SWITCHED_EPISODES = 5, 3


def measure(
    tasks: Annotated[Sequence[str], some_of(TASKS)] = TASKS,
    arms: Annotated[Sequence[str], some_of(tuple(ENTRIES))] = tuple(ENTRIES),
    blocks: Sequence[int] = (0, 1),
    seeds: int = SEEDS,
    steps: int = STEPS,
    episodes: int = EPISODES,
    jobs: int = 2,
    out: Path = MEASURED.parent,
    numbers: Path = MEASURED,
) -> None:
    """Trains and judges arms on tasks, and keeps the numbers; `pages` puts them into the page.

    A block is a seed of the whole experiment: of its --seeds trainings of an arm, and of the --episodes that each agent
    is judged on per scenario. Finished runs in --out are kept: started again, the suite goes on. Rows that --numbers
    has and that are not asked for stay there.

    Raises:
        ValueError: If --numbers has numbers of other blocks, runs, steps or episodes.
    """
    budget = [list(blocks), seeds, steps, episodes]
    found: dict[str, Any] = json.loads(numbers.read_text("utf-8")) if numbers.exists() else {"budget": budget}
    if found["budget"] != budget:
        raise ValueError(
            f"{numbers} has other blocks, runs, steps or episodes, {found['budget']}: give other --numbers"
        )
    found = {"tasks": {}, "impairments": {}} | found | {"versions": versions()}
    for task in tasks:
        for block in blocks:
            settings = _settings(task, block, seeds, steps, episodes, jobs, out)
            names = [each for each in rows_of(task) if each in arms and (each in PRIMARY or block == blocks[0])]
            rows = found["tasks"].setdefault(task, {}).setdefault(str(block), {})
            rows |= _block(settings, names)
            if task in NETWORK_TASKS and block == blocks[0]:
                switching = [each for each in SWITCHED if each in names]
                found["impairments"][task] = found["impairments"].get(task, {}) | _impairments(settings, switching)
        numbers.parent.mkdir(parents=True, exist_ok=True)
        numbers.write_text(json.dumps(found, allow_nan=False) + "\n", "utf-8")
    print(all_tables(found))
    print(f"{sum(os.times()[:4]):,.0f} seconds of processor time")


def replicate(
    tasks: Annotated[Sequence[str], some_of(TASKS)] = TASKS,
    block: int = 2,
    jobs: int = 2,
    out: Path = MEASURED.parent,
    numbers: Path = NUMBERS,
) -> None:
    """Runs another block of the primary arms, and counts its numbers inside the printed intervals."""
    found = json.loads(numbers.read_text("utf-8"))
    _, seeds, steps, episodes = found["budget"]
    inside, rows = [], [["outside", "printed", "block"]]
    for task in tasks:
        names = [name for name in PRIMARY if name in found["tasks"][task]["0"]]
        again = _block(_settings(task, block, seeds, steps, episodes, jobs, out), names)
        for name in names:
            for column, scenario in _JUDGED:
                printed = _interval([each[name] for each in found["tasks"][task].values()], column, scenario)
                new = float(np.mean(again[name]["scenarios"][scenario][column]))
                inside.append(printed[0] - 1e-9 <= new <= printed[1] + 1e-9)
                if not inside[-1]:
                    rows.append([f"{task} {name}, {column}, {scenario}", _shown(printed), f"{new:.3f}"])
    print(f"{sum(inside)} of {len(inside)} numbers of block {block} lie inside the printed intervals")
    print(text_table(rows) if rows[1:] else "")


def pages(numbers: Path = MEASURED, root: Path = ROOT) -> None:
    """Writes numbers, tables and figures into the pages of a clone; `--numbers docs/results.json` are those it has."""
    file, found = root / NUMBERS, json.loads(numbers.read_text("utf-8"))
    found["tasks"] = {task: found["tasks"][task] for task in TASKS if task in found["tasks"]}
    file.write_text(json.dumps(found, allow_nan=False) + "\n", "utf-8")
    file.with_suffix(".txt").write_text(all_tables(found), "utf-8")
    for name, png in suite_figures(found).items():
        (file.parent / "images" / f"results-{name}.png").write_bytes(png)
    page = root / PAGE
    page.write_text(quoted(page.read_text("utf-8"), quotable(found)), "utf-8")


def quoted(page: str, tables: Mapping[str, str]) -> str:
    """Returns a page with the tables replaced that stand between `<!-- suite: NAME -->` and `<!-- end -->`.

    Raises:
        ValueError: If the page names none, or one that there is not.
    """
    mark = re.compile(r"(<!-- suite: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)
    names = {name for _, name, _ in mark.findall(page)}
    if not names or not names <= tables.keys():
        raise ValueError(f"a page must quote tables between <!-- suite: NAME --> and <!-- end -->, got {sorted(names)}")
    return mark.sub(lambda found: f"{found[1]}```\n{tables[found[2]]}\n```\n{found[3]}", page)


def row_of(
    task: str,
    policy: Callable[[LoopConfig, int], Policy],
    behind: str = "unshielded",
    block: int = 0,
    runs: int | None = None,
) -> dict[str, Any]:
    """Returns the numbers of a policy of one's own on the episodes of a block, as those of the table's rows.

    Args:
        task: One of `TASKS`.
        policy: Makes what acts in a run, given the control loop and the number of the run.
        behind: Arm of `ncs compare` that names a filter: "shielded", "trusting:20", or "unshielded" for none.
        block: The block.
        runs: How many, by default as many as of the primary arms.
    """
    settings = _settings(task, block, runs or SEEDS, 1, EPISODES, 1, Path())
    loop = loop_config(settings.env)
    certificate, results = certificate_of(loop, None, settings.safe_set), []
    for index in range(settings.seeds):
        own = run_of_arm(settings, loop, certificate, behind, index)
        played = {
            each: evaluate(under(each, own.loop), policy(own.loop, index), own.episodes, own.evaluation_seed).episodes
            for each in (AS_TRAINED, *SCENARIOS)
        }
        nothing = {"train_steps": 0, "train_violation_steps": 0, "train_interventions": 0, "history": []}
        results.append(RunResult(behind, index, **nothing, episodes=played.pop(AS_TRAINED), scenarios=played))
    return _numbers(results)


def _settings(task: str, block: int, seeds: int, steps: int, episodes: int, jobs: int, out: Path) -> CompareSettings:
    return CompareSettings(
        env=f"ncs_gym/{task}",
        seed=block,
        seeds=seeds,
        steps=steps,
        episodes=episodes,
        scenarios=SCENARIOS,
        hyperparams=DEFAULTS["PPO"],  # which what was tuned for an arm changes
        tuned_arms=True,
        jobs=jobs,
        out=out / task / str(block),
    )


def _block(settings: CompareSettings, names: Sequence[str]) -> dict[str, Any]:
    """Returns the numbers of rows in a block: agents are trained, then they act behind other filters too."""
    loop = loop_config(settings.env)
    certificate = certificate_of(loop, None, settings.safe_set)

    def runs_of(entry: Entry, arm: str, point: str = "") -> list[TrainingRun]:
        own = certificate_of(loop, None, entry.safe_set) if entry.safe_set else certificate
        changed = ("attacked" if entry.attacked else "") or ("one set" if entry.one_error_set else "")
        point = point or changed or entry.observed or entry.safe_set
        runs = []
        for index in range(min(settings.seeds, entry.seeds or settings.seeds)):
            each = run_of_arm(settings, loop, own, arm, index, point)
            if entry.attacked:
                each = replace(each, training_loop=under(ATTACKED, each.training_loop))
            if entry.one_error_set:
                each = replace(each, loop=replace(each.loop, shield=None, filter=OneErrorSet(own)))
            runs.append(_seeing(entry, each, settings) if entry.observed else each)
        return runs

    task, numbers = settings.env.removeprefix("ncs_gym/"), dict[str, Any]()
    for name in names:
        entry = ENTRIES[name]
        if entry.policy is not None:
            runs = min(settings.seeds, entry.seeds or settings.seeds)
            numbers[name] = row_of(task, entry.policy, entry.arm, settings.seed, runs)
    names = [name for name in names if name not in numbers]
    tested = {name: ENTRIES[name] for name in names if ENTRIES[name].tested}
    trained = dict.fromkeys([*(name for name in names if name not in tested), *(each.arm for each in tested.values())])
    first = {name: runs_of(ENTRIES[name], ENTRIES[name].arm) for name in trained}
    numbers |= _judged(first, settings)
    second = {
        name: [
            _with_agent(run, settings, agent)
            for run, agent in zip(runs_of(entry, entry.tested, "tested"), first[entry.arm], strict=True)
        ]
        for name, entry in tested.items()
    }
    for name, found in _judged(second, settings).items():
        numbers[name] = found | {key: numbers[tested[name].arm][key] for key in ("training", "curve")}
    return numbers


def observing(what: str, loop: LoopConfig) -> LoopConfig:
    """Returns a loop in which agents see more than the estimate: "disturbance" or "memory", or nothing for no word."""
    seen = {"": None, "disturbance": Shown(loop.env), "memory": Remembered()}
    return replace(loop, observed=seen[what])


def _seeing(entry: Entry, run: TrainingRun, settings: CompareSettings) -> TrainingRun:
    """Returns a run whose agents see more than the estimate, with what was tuned for them."""
    own = tuned_training(run.loop.env, entry.tuned_as).get("hyperparams", {})
    loops = {name: observing(entry.observed, getattr(run, name)) for name in ("training_loop", "loop")}
    return replace(run, settings=with_changes(settings.all_hyperparams, own), **loops)


def _judged(runs: Mapping[Any, Sequence[TrainingRun]], settings: CompareSettings) -> dict[Any, dict[str, Any]]:
    """Returns the numbers of runs by the key of each, executed in the order of their indices."""
    every = sorted((each for own in runs.values() for each in own), key=lambda each: each.index)
    found = results_of(every, settings.out, settings) if every else []
    results = {each.name: result for each, result in zip(every, found, strict=True)}
    return {key: _numbers([results[each.name] for each in own]) for key, own in runs.items()}


def _with_agent(run: TrainingRun, settings: CompareSettings, trained: TrainingRun) -> TrainingRun:
    """Returns a run in which the agent acts that another one has trained."""
    folder = settings.out / "models" / trained.name
    return replace(run, agent_files={each: (folder / each).read_bytes() for each in AGENT_FILES})


def _numbers(results: Sequence[RunResult]) -> dict[str, Any]:
    """Returns the numbers of a row in a block: shares, means and counts of every run, and how trainings went."""
    scenarios = {}
    for name, played in episodes_table(results).groupby("scenario", sort=False):
        by_run = played.groupby("run")
        sums = by_run[["steps", "overridden", "proved_steps"]].sum()
        scenarios[name] = {
            "violating": by_run["violating"].mean().tolist(),
            "return": by_run["return"].mean().tolist(),
            "overridden": (sums["overridden"] / sums["steps"]).tolist(),
            "proved": (sums["proved_steps"] / sums["steps"]).tolist(),
            "episodes": len(played),
        }
    training = [each.train_violation_steps for each in results if each.train_steps]
    return {"scenarios": scenarios, "training": training, "curve": _curve(results)}


def _curve(results: Sequence[RunResult]) -> dict[str, list[list[float]]]:
    """Returns training curves of every run at the same steps: mean return of recent episodes, and violating steps."""
    points = training_table(results)
    if points.empty:
        return {}
    runs = [own.dropna(subset="return") for _, own in points.groupby("run")]
    if not all(map(len, runs)):
        return {}  # no episode has ended
    last = min(own["steps"].iloc[-1] for own in runs)
    steps = np.linspace(last / CURVE_POINTS, last, CURVE_POINTS)
    columns = {
        each: [np.round(np.interp(steps, own["steps"], own[each]), 2).tolist() for own in runs]
        for each in ("return", "violating_steps")
    }
    return {"steps": [steps.tolist()]} | columns


def switched(channel: Channel, contract: ChannelContract | None, on: Sequence[str]) -> Assignments:
    """Returns the changes of a channel by which some of `SWITCHES` are on and the others off.

    With fewer samples as many losses in a row are allowed as the contract still has room for.
    """
    period = max(channel.send_period, SLOW) if "rate" in on else 1
    delay = channel.delay if "delay" in on else 0
    changes: Assignments = {"send_period": period, "delay": delay, "jitter": channel.jitter if "delay" in on else 0}
    changes["quantization_step"] = channel.quantization_step if "rounding" in on else 0.0
    if "loss" not in on:
        changes["loss"] = 0.0
    elif contract is not None:
        room = (contract.max_age + 1 - delay - changes["jitter"]) // period - 1
        most = channel.max_consecutive_losses
        changes["max_consecutive_losses"] = room if most is None else min(room, most)
    return changes


def _impairments(settings: CompareSettings, arms: Sequence[str]) -> dict[str, dict[str, float]]:
    """Returns the share of attacked episodes that violate with no, each alone and all of `SWITCHES` on, by arm.

    Agents are those of the block, trained with all of the task's own impairments.
    """
    env, few = registered_env(settings.env), replace(settings, episodes=SWITCHED_EPISODES)
    own = loop_config(settings.env)
    trained_behind, runs = certificate_of(own, None, settings.safe_set), {}
    for title, on in {"none": (), **{each: (each,) for each in SWITCHES}, "all": SWITCHES}.items():
        loop = loop_config(settings.env, switched(env.channel, env.contract, on))
        certificate = certificate_of(loop, None, settings.safe_set)
        for arm in arms:
            runs[arm, title] = [
                _with_agent(
                    run_of_arm(few, loop, certificate, arm, index, title),
                    settings,
                    run_of_arm(settings, own, trained_behind, arm, index),
                )
                for index in range(min(settings.seeds, SWITCHED_RUNS))
            ]
    shares: dict[str, dict[str, float]] = {arm: {} for arm in arms}
    for (arm, title), numbers in _judged(runs, settings).items():
        shares[arm][title] = float(np.mean(numbers["scenarios"][ATTACKED]["violating"]))
    return shares


# Columns that a block is judged by, in their scenarios.
_JUDGED = (("return", AS_TRAINED), ("violating", AS_TRAINED), ("violating", ATTACKED))


def _interval(blocks: Sequence[dict[str, Any]], column: str, scenario: str) -> tuple[float, float]:
    """Returns where the mean of another block lies with 95 %: Student's prediction over runs.

    Of shares it stays within 0 and 1, and where all are 0 or all 1 it is the exact interval of a proportion.
    """
    values = np.concatenate([each["scenarios"][scenario][column] for each in blocks])
    mean, count, one = float(np.mean(values)), len(values), len(values) / len(blocks)
    if column != "return" and mean in (0.0, 1.0):
        trials = sum(each["scenarios"][scenario]["episodes"] for each in blocks)
        low, high = clopper_pearson(round(mean * trials), trials)
        return low, high
    half = float(t.ppf(0.5 + CONFIDENCE / 2.0, count - 1) * np.std(values, ddof=1) * sqrt(1.0 / count + 1.0 / one))
    if column == "return":
        return mean - half, mean + half
    return max(mean - half, 0.0), min(mean + half, 1.0)


def _of(row: dict[str, Any], column: str, scenario: str) -> np.ndarray:
    return np.array(row["scenarios"][scenario][column])


def _mean(blocks: Iterable[dict[str, Any]], column: str, scenario: str) -> float:
    return float(np.mean(np.concatenate([each["scenarios"][scenario][column] for each in blocks])))


def _shown(interval: Sequence[float], scale: float = 1.0, digits: int = 1) -> str:
    return f"[{scale * interval[0]:z.{digits}f}, {scale * interval[1]:z.{digits}f}]"


def task_table(blocks: Mapping[str, dict[str, Any]]) -> str:
    """Returns the rows of a task: both blocks of returns and shares, the interval of another block, and the rest."""
    rows = [
        ["", "return", "", "violating [%]", "", "", "while", "over-", "proof"],
        ["", "by block", "+-", "trained", "attacked", "interval", "training", "ridden", "held"],
    ]
    for name in ENTRIES:
        own = [each[name] for each in blocks.values() if name in each]
        if not own:
            continue

        def cells(column: str, scenario: str, scale: float, digits: int, own: Any = own) -> str:
            return " ".join(f"{scale * _mean([each], column, scenario):z.{digits}f}" for each in own)

        low, high = _interval(own, "return", AS_TRAINED)
        training = [count for each in own for count in each["training"]]
        overridden, proved = _mean(own, "overridden", AS_TRAINED), _mean(own, "proved", ATTACKED)
        acts = not name.startswith("unshielded") and overridden > 0.0
        rows.append(
            [
                name,
                cells("return", AS_TRAINED, 1.0, 1),
                f"{0.5 * (high - low):.1f}",
                cells("violating", AS_TRAINED, 100.0, 0),
                cells("violating", ATTACKED, 100.0, 0),
                _shown(_interval(own, "violating", ATTACKED), 100.0, 0),
                f"{np.mean(training):,.0f}" if training else "-",
                f"{100 * overridden:.1f}" if acts else "-",
                f"{100 * proved:.0f}" if proved else "-",
            ]
        )
    return text_table(rows, rules=(2,))


def differences_table(found: dict[str, Any]) -> str:
    """Returns the sentences about who is better, as numbers of both blocks: see the page."""
    pairs = (
        ("shielded, disturbance", "shielded"),
        ("lqr:observer+shielded", "shielded, disturbance"),
        ("lqr:observer+shielded", "shielded"),
    )
    rows = [["return, as trained", "by block", "interval"]]
    for first, second in pairs:
        rows.append([f"{first} - {second}"])
        for task, blocks in found["tasks"].items():
            both = [each for each in blocks.values() if first in each and second in each]
            if not both:
                continue
            values = []
            for each in both:  # runs of the same number have the same seeds; policies that need no training have fewer
                one, other = (_of(each[name], "return", AS_TRAINED) for name in (first, second))
                runs = min(len(one), len(other))
                values.append(one[:runs] - other[:runs])
            every = np.concatenate(values)
            mean, half = float(np.mean(every)), float(t.ppf(0.975, len(every) - 1) * sem(every))
            means = " ".join(f"{np.mean(each):+z.1f}" for each in values)
            rows.append([f"  {task}", means, _shown((mean - half, mean + half))])
    return text_table(rows, rules=(1,))


def impairments_table(found: dict[str, Any]) -> str:
    """Returns violating episodes under attack [%] with no impairment of the channel, each alone, and all."""
    table = [["attacked, violating [%]", "none", *SWITCHES, "all"]]
    for task, rows in found["impairments"].items():
        table += [[f"{task} {arm}", *(f"{100 * share:.0f}" for share in row.values())] for arm, row in rows.items()]
    return text_table(table)


def budget_text(found: dict[str, Any]) -> str:
    """Returns what was spent."""
    blocks, seeds, steps, episodes = found["budget"]
    rows = [(name, row) for each in found["tasks"].values() for rows in each.values() for name, row in rows.items()]
    trainings = sum(len(row["training"]) for name, row in rows if not ENTRIES[name].tested)
    judged = sum(len(_of(row, "return", AS_TRAINED)) for _, row in rows)
    return (
        f"{len(blocks)} blocks of {seeds} runs per primary arm, {steps:,} training steps each,\n"
        f"{episodes} episodes per run and scenario: {trainings:,} trainings, {judged:,} runs"
    )


def network_table(found: dict[str, Any]) -> str:
    """Returns what the network does to a filter that trusts its estimate, beside the shield."""
    rows = [
        ["violating", "as", "attacked,", "attacked,", "of another"],
        ["[%]", "trained", "ideal", "network", "block"],
    ]
    for task in (each for each in NETWORK_TASKS if each in found["tasks"]):
        for name in ("unshielded", "trusting:20", "shielded"):
            own = [each[name] for each in found["tasks"][task].values() if name in each]
            if own:
                shares = [f"{100 * _mean(own, 'violating', each):.1f}" for each in (AS_TRAINED, IDEAL, ATTACKED)]
                rows.append([f"{task} {name}", *shares, _shown(_interval(own, "violating", ATTACKED), 100.0)])
    return text_table(rows, rules=(2,))


def tasks_table(_: dict[str, Any]) -> str:
    """Returns what the tasks are, from their environments."""
    rows = [
        ["task", "states,", "network: lost,", "contract", "disturbance", "reward"],
        ["", "inputs", "delay, every", "[age]", "", ""],
    ]
    for task in TASKS:
        env = registered_env(f"ncs_gym/{task}")
        channel, plant = env.channel, env.plant
        late = f"{channel.delay}-{channel.delay + channel.jitter}" if channel.jitter else f"{channel.delay}"
        rows.append(
            [
                task,
                f"{plant.n}, {plant.m}",
                f"{channel.loss:.0%}, {late}, {channel.send_period}",
                "-" if env.contract is None else f"{env.contract.max_age}",
                type(env.disturbance).__name__.removesuffix("Disturbance").lower(),
                type(env.task).__name__.removesuffix("Tracking").lower(),
            ]
        )
    return text_table(rows, rules=(2,))


def tasks_in_full() -> str:
    """Returns all that a task consists of, and why it is one."""
    texts = []
    for task, reason in (NETWORK_TASKS | OTHER_TASKS).items():
        loop = loop_config(f"ncs_gym/{task}")
        attacked: Any = under(ATTACKED, loop).vector(1).unwrapped
        env, worse = registered_env(loop.env), attacked.single
        ends = "end with a violation" if env.terminate_on_violation else "go on after a violation"
        rows = {
            "network": env.channel,
            "contract": env.contract,
            "simulated": f"{env.disturbance}, {env.noise} noise",
            "attacked": f"{worse.disturbance}, {worse.noise} noise, {worse.channel}",
            "reward": env.task,
            "episodes": f"{loop.episode_steps} steps, {ends}",
            "chosen": reason,
        }
        own = "\n".join(
            fill(str(value), 80, initial_indent=f"{name:<16}", subsequent_indent=" " * 16)
            for name, value in rows.items()
        )
        texts.append(f"{task}, plant {env.plant.fingerprint[:16]}\n{env.plant}\n{own}")
    return "\n\n".join(texts)


TABLES: dict[str, Callable[[dict[str, Any]], str]] = {
    "budget": budget_text,
    "tasks": tasks_table,
    "network": network_table,
    "differences": differences_table,
    "impairments": impairments_table,
    **{task: lambda found, task=task: task_table(found["tasks"][task]) for task in TASKS},
}


def quotable(found: dict[str, Any]) -> dict[str, str]:
    """Returns the tables by name; of a task that was not measured there is none."""
    return {name: table(found) for name, table in TABLES.items() if name not in TASKS or name in found["tasks"]}


def all_tables(found: dict[str, Any]) -> str:
    """Returns all tables as plain text."""
    tables = [f"{name}\n{table}" for name, table in quotable(found).items()]
    return "\n\n\n".join([*tables, tasks_in_full()]) + "\n"


COMMANDS = (measure, replicate, pages)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
