"""The study of docs/experiments.md, the same arms in three environments: `python -m benchmarks.study COMMAND`.

Commands: compare, pages.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from agents.agent_file import AGENT_FILES
from benchmarks.commands import run
from benchmarks.study_figures import ATTACKED, study_figures
from experiments.analysis.episodes import episodes_table
from experiments.analysis.statistics import CONFIDENCE, hierarchical_interval
from experiments.backends.execution import results_of
from experiments.baselines import MARGINS
from experiments.commands.compare import CompareSettings, Comparison
from experiments.commands.compare import compare as compared
from experiments.runs.arms import by_arm, run_of_arm
from experiments.runs.loops import AS_TRAINED, certificate_of, loop_config, registered_env
from experiments.runs.provenance import versions
from experiments.settings import Assignments
from experiments.terminal import text_table
from ncs_gym import Channel, ChannelContract
from ncs_gym.validation import counted

ROOT = Path(__file__).resolve().parents[1]
# Where the numbers are kept, and the pages that show them.
NUMBERS = Path("docs/results.json")
PAGES = ("docs/experiments.md",)
# Environments in which the network decides.
ENVS = ("ncs_gym/CSTR-v0", "ncs_gym/Convoy-v0", "ncs_gym/LaneKeeping-v0")
# Agents, and what needs no training, each tuned by itself (`benchmarks.learning`); margins are in percent.
TRAINED = ("unshielded", "penalized", "lagrangian", "trusting:20", "shielded", "lookahead")
_MARGINS = ("", *(f":{margin}" for margin in MARGINS))
REGULATED = (
    "lqr",
    *(f"mpc{margin}" for margin in ("", ":20", ":40", ":50")),
    *(f"lqr+{name}{margin}" for name in ("psf", "trusting") for margin in _MARGINS),
    "lqr+psf:tube",
    "lqr+shielded",
    "lqr+lookahead",
)
IDEAL, ATTACKED_IDEAL = "ideal channel", "attacked on an ideal channel"
SCENARIOS = (IDEAL, "worse channel", ATTACKED, ATTACKED_IDEAL)
# Arms with a proof: no scenario leaves the assumptions of the certificate.
SOUND = "lookahead"


# Differences of two arms in a scenario, declared before the study was run, the same in every environment. The first is
# the primary one; the others are judged at a level that is divided by their number.
PRIMARY = ("unshielded", SOUND, ATTACKED)
SECONDARY = (
    ("trusting:20", SOUND, ATTACKED),
    ("penalized", SOUND, ATTACKED),
    ("lqr+psf:20", f"lqr+{SOUND}", ATTACKED),
)
# Families of arms that differ by the margin alone, with the arm that has the proof in their place.
FAMILIES = {"mpc": f"lqr+{SOUND}", "lqr+psf": f"lqr+{SOUND}", "lqr+trusting": "lqr+shielded"}
# Impairments of a channel; a rate is a sample every second step.
SWITCHES, SLOW = ("loss", "delay", "rate", "rounding"), 2
# What acts while they are on and off, and of the agents at most so many per arm.
SWITCHED_REGULATORS = ("lqr", "lqr+trusting:20", "lqr+lookahead")
SWITCHED_AGENTS, MOST_AGENTS = ("unshielded", "trusting:20", "lookahead"), 5


def compare(
    env: Sequence[str] = ENVS,
    arms: Sequence[str] = TRAINED,
    baselines: Sequence[str] = REGULATED,
    seeds: int = 5,
    steps: int | None = None,
    episodes: int = 50,
    channel_episodes: int = 25,
    jobs: int = 2,
    out: Path = Path("runs/study"),
    numbers: Path = NUMBERS,
) -> None:
    """Compares the arms in every environment, then attacks some with every impairment of the channel on and off.

    Writes the numbers that pages show. Finished runs in --out are kept: a long study can be run in parts.
    """
    environments, channels = {}, {}
    for each in env:
        name = each.rpartition("/")[2]
        settings = CompareSettings(
            env=each,
            arms=tuple(arms),
            baselines=tuple(baselines),
            scenarios=SCENARIOS,
            seeds=seeds,
            steps=steps,
            episodes=episodes,
            tuned_arms=True,
            jobs=jobs,
            out=out / name,
        )
        found = compared(settings)
        environments[name] = environment(found.summary, found.episodes)
        switching = replace(settings, out=settings.out / "channels", episodes=channel_episodes, scenarios=(ATTACKED,))
        channels[name] = channel_switches(switching, found, settings.out / "models")
    summary = {"environments": environments, "channels": channels, "versions": versions()}
    numbers.write_text(json.dumps(summary, allow_nan=False) + "\n", "utf-8")


def pages(root: Path = ROOT) -> None:
    """Writes the tables and figures of the stored numbers into the pages of a clone."""
    file = root / NUMBERS
    summary = json.loads(file.read_text("utf-8"))
    file.with_suffix(".txt").write_text(all_tables(summary), "utf-8")
    for name, png in study_figures(summary).items():
        (file.parent / "images" / f"results-{name}.png").write_bytes(png)
    for page in (root / name for name in PAGES):
        page.write_text(quoted(page.read_text("utf-8"), quotable(summary)), "utf-8")


def quoted(page: str, tables: Mapping[str, str]) -> str:
    """Returns a page with the tables replaced that stand between `<!-- study: NAME -->` and `<!-- end -->`.

    Raises:
        ValueError: If the page names none, or one that there is not.
    """
    mark = re.compile(r"(<!-- study: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)
    names = {name for _, name, _ in mark.findall(page)}
    if not names or not names <= tables.keys():
        raise ValueError(f"a page must quote tables between <!-- study: NAME --> and <!-- end -->, got {sorted(names)}")
    return mark.sub(lambda found: f"{found[1]}```\n{tables[found[2]]}\n```\n{found[3]}", page)


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


def channel_switches(settings: CompareSettings, comparison: Comparison, models: Path) -> list[dict[str, Any]]:
    """Returns how many attacked episodes of each `arm` violate with no, each alone and all of `SWITCHES` on (`on`).

    The attack has the strongest disturbance, noise of full size, and bursts as long as the contract allows. Agents are
    those of the comparison, in its folder of models, trained with all of the environment's own impairments.
    """
    env, results = registered_env(settings.env), by_arm(comparison.results)
    agents = {name: results[name][:MOST_AGENTS] for name in SWITCHED_AGENTS if name in settings.arms}
    rows = []
    for on in ((), *((each,) for each in SWITCHES), SWITCHES):
        loop = loop_config(settings.env, switched(env.channel, env.contract, on))
        certificate, point = certificate_of(loop, None, settings.safe_set), "-".join(on) or "ideal"
        runs = [run_of_arm(settings, loop, certificate, name, 0, point) for name in SWITCHED_REGULATORS]
        for name, trained in agents.items():
            part = replace(settings, episodes=-(-settings.episodes // len(trained)))
            for index, agent in enumerate(trained):
                run_of_agent = run_of_arm(part, loop, certificate, name, index, point)
                files = {each: (models / f"{agent.arm}-{agent.index}" / each).read_bytes() for each in AGENT_FILES}
                runs.append(replace(run_of_agent, agent_files=files))
        played = episodes_table(results_of(runs, settings.out, settings))
        for arm, attacked in played[played["scenario"] == ATTACKED].groupby("arm", sort=False):
            violating = int(attacked["violating"].sum())
            rows.append({"on": list(on), "arm": arm, "episodes": len(attacked), "violating": violating})
    return rows


def environment(comparison: dict[str, Any], episodes: pd.DataFrame) -> dict[str, Any]:
    """Returns JSON values of a comparison: its arms in every scenario, the declared comparisons, and prices.

    Args:
        comparison: Its summary.
        episodes: The table of its episodes.
    """
    settings, known = comparison["settings"], comparison["arms"] | comparison["references"]
    arms = {name: _arm(arm, episodes[episodes["arm"] == name]) for name, arm in known.items()}
    level = 1.0 - (1.0 - CONFIDENCE) / len(SECONDARY)
    declared = [difference(episodes, PRIMARY), *(difference(episodes, each, confidence=level) for each in SECONDARY)]
    return {
        **{name: settings[name] for name in ("env", "seeds", "steps", "episodes")},
        "certificate": comparison["certificate"],
        "trained": list(comparison["arms"]),
        "arms": arms,
        "comparisons": [each for each in declared if each is not None],
        "prices": _prices(arms, episodes),
    }


def difference(
    episodes: pd.DataFrame, pair: Sequence[str], column: str = "violating", confidence: float = CONFIDENCE
) -> dict[str, Any] | None:
    """Returns the mean difference of two arms in a scenario, and its interval; None if an arm is missing.

    Runs with the same number have the same seeds and episodes with the same index the same random numbers, so that
    differences are taken episode by episode; runs are resampled, then episodes within each.
    """
    played = episodes[episodes["scenario"] == pair[2]]
    first, second = (_by_run(played[played["arm"] == name], column) for name in pair[:2])
    if not (first.size and second.size):
        return None
    named = dict(zip(("first", "second", "scenario"), pair, strict=True))
    mean, interval = float((first - second).mean()), hierarchical_interval(first - second, confidence)
    return named | {"mean": mean, "interval": interval, "confidence": confidence}


def _arm(arm: dict[str, Any], episodes: pd.DataFrame) -> dict[str, Any]:
    kept = ("mode", "train_steps", "train_violation_steps", "train_violation_steps_by_run")
    scenarios = {
        scenario: _evaluated(numbers, episodes[episodes["scenario"] == scenario])
        for scenario, numbers in ({AS_TRAINED: arm} | arm["conditions"]).items()
    }
    return {key: arm[key] for key in kept} | {"scenarios": scenarios}


def _evaluated(numbers: dict[str, Any], played: pd.DataFrame) -> dict[str, Any]:
    """Returns rate and return of an arm in a scenario, with intervals over runs and episodes.

    A fixed policy is the same in all runs, so that its episodes are as good as one run each. Of few violating episodes
    resampling says little and of none nothing: the interval of the rate reaches as far as the exact one of a single
    proportion, too.
    """
    violating, returns = _by_run(played, "violating"), _by_run(played, "return")
    if numbers["eval_return_ci95_over"] == "episodes":
        violating, returns = violating.reshape(-1, 1), returns.reshape(-1, 1)
    rate, exact = numbers["eval_violation_rate"], numbers["eval_violation_rate_ci95"]
    return {
        "episodes": numbers["eval_episodes"],
        "violating": numbers["eval_violating_episodes"],
        "rate": rate,
        "rate_ci95": exact if rate in (0.0, 1.0) else outer_interval(hierarchical_interval(violating), exact),
        "rate_by_run": numbers["eval_violation_rate_by_run"],
        "return": numbers["eval_return_mean"],
        "return_ci95": hierarchical_interval(returns),
        "return_by_run": numbers["eval_return_by_run"],
        "overridden": numbers["intervention_rate"],
    }


def outer_interval(resampled: list[float] | None, exact: list[float]) -> list[float] | None:
    """Returns the smallest interval that contains both; None where resampling has none."""
    return None if resampled is None else [min(resampled[0], exact[0]), max(resampled[1], exact[1])]


def _by_run(played: pd.DataFrame, column: str) -> np.ndarray:
    """Returns a column by run and episode, shape (runs, episodes)."""
    return played.pivot(index="run", columns="episode", values=column).to_numpy(np.float64)


def _prices(arms: Mapping[str, dict[str, Any]], episodes: pd.DataFrame) -> list[dict[str, Any]]:
    """Returns what the proof costs beside the best arm that violates anywhere, of trained arms and of regulators."""
    prices = []
    for sound in (SOUND, f"lqr+{SOUND}"):
        rivals = {
            name: arm["scenarios"][AS_TRAINED]["return"]
            for name, arm in arms.items()
            if any(each["violating"] for each in arm["scenarios"].values())
            and (arm["train_steps"] > 0) == (not sound.startswith("lqr"))
        }
        if sound in arms and rivals:
            best = max(rivals, key=lambda name: rivals[name])
            prices.append(difference(episodes, (sound, best, AS_TRAINED), "return"))
    return prices


# Narrow headers of the scenarios, in the order of the columns.
_HEADERS = {
    IDEAL: ("ideal", "chan."),
    AS_TRAINED: ("as", "trained"),
    "worse channel": ("worse", "chan."),
    ATTACKED: ("under", "attack"),
    ATTACKED_IDEAL: ("same,", "ideal"),
}


def evaluation_table(env: dict[str, Any]) -> str:
    """Returns violating episodes [%] in every scenario, the interval under attack, overridden steps and returns."""
    known = next(iter(env["arms"].values()))["scenarios"]
    scenarios = [name for name in _HEADERS if name in known]
    rows = [
        ["violating [%]", *(_HEADERS[name][0] for name in scenarios), "attack", "filter", "return"],
        ["", *(_HEADERS[name][1] for name in scenarios), "[95 % CI]", "acts", "as trained"],
    ]
    for name, arm in env["arms"].items():
        rates = [f"{100 * arm['scenarios'][each]['rate']:.1f}" for each in scenarios]
        own, attacked = arm["scenarios"][AS_TRAINED], _interval(arm["scenarios"][ATTACKED]["rate_ci95"], 100.0)
        overridden = "-" if arm["mode"] is None else f"{100 * own['overridden']:.1f} %"
        low, high = own["return_ci95"] or (np.nan, np.nan)
        returned = f"{own['return']:z.1f} +-{0.5 * (high - low):.1f}"
        rows.append([name, *rates, attacked, overridden, returned])
    return text_table(rows, rules=(2, 2 + len(env["trained"])))


def comparisons_table(summary: dict[str, Any]) -> str:
    """Returns the declared comparisons: differences of violating episodes in points, the primary one first.

    Beside them is what the first arm violates under the same attack on an ideal channel.
    """
    rows = [["violating episodes", "differ-", "", "", "ideal"], ["[points]", "ence", "interval", "scenario", "[%]"]]
    for name, env in summary["environments"].items():
        rows += [[name]] if env["comparisons"] else []
        for index, each in enumerate(env["comparisons"]):
            title = f"  {each['first']} - {each['second']}{'' if index else ' (primary)'}"
            level = f"{_interval(each['interval'], 100.0)} ({100 * each['confidence']:.1f} %)"
            ideal = env["arms"][each["first"]]["scenarios"].get(ATTACKED_IDEAL)
            without_network = "-" if ideal is None else f"{100 * ideal['rate']:.1f}"
            rows.append([title, f"{100 * each['mean']:+z.1f}", level, each["scenario"], without_network])
    return text_table(rows, rules=(2,))


def prices_table(summary: dict[str, Any]) -> str:
    """Returns the return of the arms with a proof less that of the best arm that violates anywhere."""
    rows = [["return as trained, with a proof", "difference [95 % CI]", "from the best without"]]
    for name, env in summary["environments"].items():
        for price in env["prices"]:
            difference = f"{price['mean']:+z.1f} {_interval(price['interval'])}"
            rows.append([f"{name} {price['first']}", difference, price["second"]])
    return text_table(rows)


def margins_table(summary: dict[str, Any]) -> str:
    """Returns the smallest margin of each family without a violating episode, as trained and attacked, and its price.

    What it costs is said of the margin that is enough under attack, or else of the other: its return less that of the
    arm with a proof, and on an ideal channel less that of the margin of its kind that returns most there.
    """
    rows = [["margin without a violation", "as trained", "attacked", "return", "lost, ideal"]]
    for title, env in summary["environments"].items():
        for family, sound in FAMILIES.items():
            names = [each for each in (family, *(f"{family}:{margin}" for margin in MARGINS)) if each in env["arms"]]
            if not names or sound not in env["arms"]:
                continue
            kept = [
                [name for name in names if not env["arms"][name]["scenarios"][each]["violating"]]
                for each in (AS_TRAINED, ATTACKED)
            ]
            price = ["-", "-"]
            if chosen := (kept[1] or kept[0])[:1]:
                lost = _return(env, chosen[0], IDEAL) - max(_return(env, name, IDEAL) for name in names)
                price = [f"{_return(env, chosen[0]) - _return(env, sound):+z.1f}", f"{lost:z.1f}"]
            most = _margin(names[-1], family)
            margins = [_margin(each[0], family) if each else f"> {most}" for each in kept]
            rows.append([f"{title} {family}", *margins, *price])
    return text_table(rows)


def network_table(summary: dict[str, Any]) -> str:
    """Returns what the network does to a filter that trusts its estimate, beside the arm with a proof."""
    rows = [
        ["violating", "as", "attacked,", "attacked,", ""],
        ["[%]", "trained", "ideal", "network", "95 % interval"],
    ]
    for title, env in summary["environments"].items():
        for name in SECONDARY[0][:2]:
            scenarios = env["arms"].get(name, {"scenarios": {}})["scenarios"]
            if {ATTACKED, ATTACKED_IDEAL} <= set(scenarios):
                rates = [f"{100 * scenarios[each]['rate']:.1f}" for each in (AS_TRAINED, ATTACKED_IDEAL, ATTACKED)]
                rows.append([f"{title} {name}", *rates, _interval(scenarios[ATTACKED]["rate_ci95"], 100.0)])
    return text_table(rows, rules=(2,))


def impairments_table(channels: Mapping[str, Sequence[dict[str, Any]]]) -> str:
    """Returns violating episodes under attack [%] with no impairment of the channel, each alone, and all."""
    titles = {"ideal": (), **{each: (each,) for each in SWITCHES}, "all four": SWITCHES}
    table = [["attacked, violating [%]", *titles]]
    for name, rows in channels.items():
        shares = {(row["arm"], tuple(row["on"])): 100 * row["violating"] / row["episodes"] for row in rows}
        for arm in dict.fromkeys(row["arm"] for row in rows):
            table.append([f"{name} {arm}", *(f"{shares[arm, on]:.0f}" for on in titles.values())])
    return text_table(table)


def budget_text(summary: dict[str, Any]) -> str:
    """Returns what was spent in each environment, one line for all that spent the same."""
    spent: dict[str, list[str]] = {}
    for name, env in summary["environments"].items():
        text = (
            f"{counted(env['seeds'], 'run')} per arm, {env['steps']:,} training steps each,\n"
            f"{counted(env['episodes'], 'episode')} per run and scenario"
        )
        spent.setdefault(text, []).append(name)
    return "\n".join(f"{', '.join(names)}: {text}" for text, names in spent.items())


_TABLES: dict[str, Callable[[dict[str, Any]], str]] = {
    "budget": budget_text,
    "comparisons": comparisons_table,
    "prices": prices_table,
    "margins": margins_table,
    "network": network_table,
    "impairments": lambda summary: impairments_table(summary["channels"]),
}


def quotable(summary: dict[str, Any]) -> dict[str, str]:
    """Returns the tables that pages may quote, by name."""
    return {name: table(summary) for name, table in _TABLES.items()}


def all_tables(summary: dict[str, Any]) -> str:
    """Returns the tables as plain text, with every arm."""
    parts = [table(summary) for table in _TABLES.values()]
    parts += [f"{name}\n{evaluation_table(env)}" for name, env in summary["environments"].items()]
    return "\n\n\n".join(parts) + "\n"


def _margin(name: str, family: str) -> str:
    return f"{name.removeprefix(family).removeprefix(':') or '0'} %"


def _return(env: dict[str, Any], name: str, scenario: str = AS_TRAINED) -> float:
    return env["arms"][name]["scenarios"][scenario]["return"]


def _interval(interval: Sequence[float] | None, scale: float = 1.0) -> str:
    return "[n/a]" if interval is None else f"[{scale * interval[0]:z.1f}, {scale * interval[1]:z.1f}]"


COMMANDS = (compare, pages)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
