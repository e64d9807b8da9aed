"""The tables of a study as text: each is a pure function of the numbers that pages show."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from experiments.runs.loops import AS_TRAINED
from experiments.study.channel_switches import SWITCHES
from experiments.study.summary import (
    ATTACKED,
    ATTACKED_IDEAL,
    FAMILIES,
    IDEAL,
    SECONDARY,
    SOUND,
    margins_needed,
    members,
)
from experiments.terminal import text_table
from ncs_gym.validation import counted

# Narrow headers of the scenarios, in the order of the columns.
_SCENARIOS = {
    IDEAL: ("ideal", "chan."),
    AS_TRAINED: ("as", "trained"),
    "worse channel": ("worse", "chan."),
    ATTACKED: ("at-", "tacked"),
    ATTACKED_IDEAL: ("att.,", "ideal"),
    "worst-case disturbance": ("worst", "dist."),
    "gaussian": ("Gauss", "noise"),
}
# Longest name of an arm whose row has room for all columns [characters].
_LONGEST_NAME = 14


def evaluation_table(env: dict[str, Any]) -> str:
    """Returns violating episodes [%] in every scenario, the interval under attack, overridden steps and returns.

    Behind long names the last two stand in a table of their own.
    """
    known = next(iter(env["arms"].values()))["scenarios"]
    scenarios = [name for name in _SCENARIOS if name in known]
    interval_of = ATTACKED if ATTACKED in known else AS_TRAINED
    violating = [
        ["violating [%]", *(_SCENARIOS[name][0] for name in scenarios), _SCENARIOS[interval_of][0]],
        ["", *(_SCENARIOS[name][1] for name in scenarios), "[95 % CI]"],
    ]
    trained = [["over-", "return"], ["ridden", "as trained"]]
    for name, arm in env["arms"].items():
        rates = [f"{100 * arm['scenarios'][each]['rate']:.1f}" for each in scenarios]
        violating.append([name, *rates, _interval(arm["scenarios"][interval_of]["rate_ci95"], 100.0)])
        own = arm["scenarios"][AS_TRAINED]
        trained.append(["-" if arm["mode"] is None else f"{100 * own['overridden']:.1f} %", _return(own)])
    rules = (2, 2 + len(env["trained"]))
    if max(map(len, env["arms"])) <= _LONGEST_NAME:
        return text_table([[*row, *more] for row, more in zip(violating, trained, strict=True)], rules)
    names = ["", "", *env["arms"]]
    others = [[name, *row] for name, row in zip(names, trained, strict=True)]
    return f"{text_table(violating, rules)}\n\n{text_table(others, rules)}"


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
    """Returns the smallest margin of each family without a violating episode, and what it costs.

    That is as trained and under attack. What it costs is said of the margin that is enough under attack, or else of the
    other: its return less that of the arm with a proof, and on an ideal channel less that of the margin of its kind
    that returns most there.
    """
    rows = [["margin without a violation", "as trained", "attacked", "return", "lost, ideal"]]
    for title, env in summary["environments"].items():
        for family, sound in FAMILIES.items():
            known = {name for arm in env["arms"].values() for name in arm["scenarios"]}
            if not members(env, family) or sound not in env["arms"] or not {IDEAL, ATTACKED} <= known:
                continue
            needed = [margins_needed(env, family, scenario) for scenario in (AS_TRAINED, ATTACKED)]
            chosen = needed[1] or needed[0]
            price = ["-", "-"] if chosen is None else [_beside(env, chosen, sound), _lost(env, chosen, family)]
            largest = _margin(members(env, family)[-1], family)
            margins = [f"> {largest}" if each is None else _margin(each, family) for each in needed]
            rows.append([f"{title} {family}", *margins, *price])
    return text_table(rows)


def network_table(summary: dict[str, Any]) -> str:
    """Returns what the network does to a filter that trusts its estimate, beside the arm with a proof.

    These are violating episodes as trained, and under attack: on an ideal channel, and over the environment's own
    network.
    """
    rows = [
        ["violating", "as", "attacked,", "attacked,", ""],
        ["[%]", "trained", "ideal", "network", "95 % interval"],
    ]
    for title, env in summary["environments"].items():
        for name in (SECONDARY[0].first, SECONDARY[0].second):
            scenarios = env["arms"].get(name, {"scenarios": {}})["scenarios"]
            if {ATTACKED, ATTACKED_IDEAL} <= set(scenarios):
                rates = [f"{100 * scenarios[each]['rate']:.1f}" for each in (AS_TRAINED, ATTACKED_IDEAL, ATTACKED)]
                rows.append([f"{title} {name}", *rates, _interval(scenarios[ATTACKED]["rate_ci95"], 100.0)])
    return text_table(rows, rules=(2,))


def regulators_table(summary: dict[str, Any]) -> str:
    """Returns of the first environment the arms in which nothing is trained."""
    env = next(iter(summary["environments"].values()))
    return evaluation_table(
        env | {"arms": {name: arm for name, arm in env["arms"].items() if not arm["train_steps"]}, "trained": []}
    )


def agents_table(summary: dict[str, Any]) -> str:
    """Returns of every environment the arms that were trained, and the regulator behind lookahead."""
    trained = {title: env for title, env in summary["environments"].items() if env["trained"]}
    return "\n\n".join(f"{title}\n{agents_of(env)}" for title, env in trained.items())


def agents_of(env: dict[str, Any]) -> str:
    """Returns of an environment the arms that were trained, and the regulator behind lookahead.

    Args:
        env: An environment of `study_summary`.
    """
    arms = {name: arm for name, arm in env["arms"].items() if arm["train_steps"] or name == f"lqr+{SOUND}"}
    return evaluation_table(env | {"arms": arms})


def training_table(summary: dict[str, Any]) -> str:
    """Returns how many steps violated while the agents learned."""
    rows = [["violating steps in training", "", "steps", "of all", "by run"]]
    for title, env in summary["environments"].items():
        for name in env["trained"]:
            arm = env["arms"][name]
            by_run = arm["train_violation_steps_by_run"]
            rows.append(
                [
                    title,
                    name,
                    f"{arm['train_violation_steps']:,}",
                    f"{100 * arm['train_violation_steps'] / max(arm['train_steps'], 1):.2f} %",
                    f"{min(by_run):,} to {max(by_run):,}",
                ]
            )
    return text_table(rows, left_columns=2)


def switches_table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns violating episodes under attack [%] with each impairment of the channel on or off.

    Args:
        rows: What `channel_switches` returns.
    """
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    points = list(dict.fromkeys(tuple(row["on"]) for row in rows))
    heads = [arm.rpartition("+") for arm in arms]
    table = [
        ["attacked,", *(first + plus for first, plus, _ in heads)],
        ["violating [%]", *(last for *_, last in heads)],
    ]
    for point in points:
        table.append([_impaired(point), *(_violating(rows, arm, point) for arm in arms)])
    return text_table(table, rules=(2,))


def impairments_table(channels: Mapping[str, Sequence[dict[str, Any]]]) -> str:
    """Returns violating episodes under attack [%] with no impairment of the channel, each alone, and all.

    Args:
        channels: What `channel_switches` returns, by environment.
    """
    played = dict.fromkeys(tuple(row["on"]) for rows in channels.values() for row in rows)
    points = [point for point in played if len(point) in (0, 1, len(SWITCHES))]
    table = [["attacked, violating [%]", *map(_impaired, points)]]
    for title, rows in channels.items():
        for arm in dict.fromkeys(row["arm"] for row in rows):
            table.append([f"{title} {arm}", *(_violating(rows, arm, point) for point in points)])
    return text_table(table)


def budget_text(summary: dict[str, Any]) -> str:
    """Returns what was spent in each environment, one line for all that spent the same."""
    spent: dict[str, list[str]] = {}
    for name, env in summary["environments"].items():
        text = (
            f"{counted(env['seeds'], 'run')} per arm, {env['steps']:,} training steps each, "
            f"{counted(env['episodes'], 'episode')} per run and scenario"
        )
        spent.setdefault(text, []).append(name)
    return "\n".join(f"{', '.join(names)}: {text}" for text, names in spent.items())


# What other pages can quote, by name.
QUOTABLE: dict[str, Callable[[dict[str, Any]], str]] = {
    "regulators": regulators_table,
    "agents": agents_table,
    "network": network_table,
    "comparisons": comparisons_table,
    "prices": prices_table,
    "margins": margins_table,
    "budget": budget_text,
}


def tables_by_name(summary: dict[str, Any]) -> dict[str, str]:
    """Returns the tables that pages quote: regulators (of the first environment), agents, network, comparisons, ...

    Args:
        summary: What `study_summary` returns, with the switches of the channels.
    """
    return {name: table(summary) for name, table in QUOTABLE.items()}


def _margin(name: str, family: str) -> str:
    return f"{name.removeprefix(family).removeprefix(':') or '0'} %"


def _beside(env: dict[str, Any], name: str, sound: str) -> str:
    """Returns the return of an arm as trained less that of the arm with a proof."""
    own, other = (env["arms"][each]["scenarios"][AS_TRAINED]["return"] for each in (name, sound))
    return f"{own - other:+z.1f}"


def _lost(env: dict[str, Any], name: str, family: str) -> str:
    """Returns what the margin of an arm costs on an ideal channel, beside the best of its family there."""
    returns = [env["arms"][each]["scenarios"][IDEAL]["return"] for each in members(env, family)]
    return f"{env['arms'][name]['scenarios'][IDEAL]['return'] - max(returns):z.1f}"


def _interval(interval: Sequence[float] | None, scale: float = 1.0) -> str:
    return "[n/a]" if interval is None else f"[{scale * interval[0]:z.1f}, {scale * interval[1]:z.1f}]"


def _return(evaluated: dict[str, Any]) -> str:
    interval = evaluated["return_ci95"]
    half = "[n/a]" if interval is None else f"+-{0.5 * (interval[1] - interval[0]):.1f}"
    return f"{evaluated['return']:z.1f} {half}"


def _impaired(point: Sequence[str]) -> str:
    """Returns the name of a combination of impairments."""
    return "ideal" if not point else "all four" if len(point) == len(SWITCHES) else "+".join(point)


def _violating(rows: Sequence[dict[str, Any]], arm: str, point: Sequence[str]) -> str:
    """Returns the violating episodes [%] of an arm at a combination of impairments."""
    (row,) = [row for row in rows if row["arm"] == arm and tuple(row["on"]) == tuple(point)]
    return f"{100 * row['violating'] / row['episodes']:.0f}"
