"""The tables of a study as text, at most 100 columns wide: each is a pure function of the numbers that pages show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from experiments.analysis.terminal_text import text_table
from experiments.study.channel_sweep import FILTERS_BY_COUNT
from experiments.study.summary import MEASURES, SOUND_ARMS

# Narrow headers of the conditions.
_CONDITIONS = {
    "worst-case disturbance": ("worst", "dist."),
    "worse channel": ("worse", "chan."),
    "gaussian": ("Gauss", "noise"),
}
# Policies that are simpler than a trained agent behind the shield.
_SIMPLER = ("zero input", "K x_hat", "random+", "proportional", "lqr", "shield at test")
# Arms of the overview, of which a study has some: what people would use, and the arms with a proof.
_OVERVIEW = ("unshielded", "penalized:10", "psf", "shielded", "lookahead", "lqr+shielded")
# Arms that the short table of the first environment leaves out: they are beside the point or have a twin there.
_NOT_IN_LEAD = ("penalized:1", "shield at test", "psf at test", "K x_hat", "lqr+psf", "lqr+trusting:lookahead")
_NOT_IN_LEAD += ("proportional", "proportional+trusting", "proportional+shielded")
# Headers of the table about channels, by the key of a count and by the side of the sweep.
_SWEPT_COUNTS = {"outside_set": "left S [%]", "violating": "left the box [%]"}
_SWEPT_SIDES = {"loss": "loss", "delay": "delay", "quantization_step": "step"}
# Largest adjusted p-value at which a difference counts.
LEVEL = 0.05


def evaluation_table(env: dict[str, Any]) -> str:
    """Returns the steps that violated in training [%], and what the evaluation counted.

    That is violating episodes [%] under every condition, episodes that left S, overridden steps and the return.

    Args:
        env: An environment of `page_summary`.
    """
    conditions = list(next(iter(env["arms"].values()))["conditions"])
    narrow = [_CONDITIONS.get(name, (name, "")) for name in conditions]
    head = [
        ["", "train", "violating [%]", *(first for first, _ in narrow), "left S", "over-", "return"],
        ["", "[%]", "[95 % CI]", *(second for _, second in narrow), "[%]", "ridden", "[95 % CI]"],
    ]
    rows = [
        [
            name,
            f"{100 * arm['train_violation_steps'] / arm['train_steps']:.2f}" if arm["train_steps"] else "-",
            _violating(arm),
            *(f"{100 * arm['conditions'][each]['eval_violation_rate']:.1f}" for each in conditions),
            f"{100 * arm['eval_episodes_outside_set'] / arm['eval_episodes']:.1f}",
            "-" if arm["mode"] is None else f"{100 * arm['intervention_rate']:.1f} %",
            _return(arm),
        ]
        for name, arm in env["arms"].items()
    ]
    return text_table([*head, *rows], rules=(len(head), len(head) + len(env["trained"])))


def overview_table(summary: dict[str, Any]) -> str:
    """Returns violating episodes, as trained and under every other condition at worst, and the return of a few arms.

    Args:
        summary: What `page_summary` returns.
    """
    environments = summary["environments"]
    names = [name for name in _OVERVIEW if all(name in env["arms"] for env in environments.values())]
    violating = [["violating episodes [%]", *names]]
    returns = [["mean return", *names]]
    for title, env in environments.items():
        arms = [env["arms"][name] for name in names]
        violating.append([title, *map(_rates, arms)])
        returns.append([title, *(f"{arm['eval_return_mean']:z.1f}" for arm in arms)])
    return f"{text_table(violating)}\n\n{text_table(returns)}"


def training_table(env: dict[str, Any]) -> str:
    """Returns how many steps violated while the agents learned."""
    rows = [["", "violating steps in training", "of all", "fewest and most in a run"]]
    for name in env["trained"]:
        arm = env["arms"][name]
        if arm["train_steps"] == 0:
            continue
        by_run = arm["train_violation_steps_by_run"]
        rows.append(
            [
                name,
                f"{arm['train_violation_steps']:,} of {arm['train_steps']:,}",
                f"{100 * arm['train_violation_steps'] / arm['train_steps']:.2f} %",
                f"{min(by_run):,} to {max(by_run):,}",
            ]
        )
    return text_table(rows)


def price_table(summary: dict[str, Any]) -> str:
    """Returns what the error set costs: points of overridden steps and return, arms with it minus arms without it."""
    head = ["with error set", "without", "violating", "overridden [pts]", "return"]
    parts = []
    for name, env in summary["environments"].items():
        rows = [head]
        for price in env["prices"]:
            sound, trusting = (env["arms"][price[key]] for key in ("sound", "trusting"))
            rates = [f"{100 * arm['eval_violation_rate']:.1f}" for arm in (sound, trusting)]
            names = [price["sound"], price["trusting"].rpartition("+")[2]]
            differences = [_difference(price["overridden"], 100.0), _difference(price["return"])]
            rows.append([*names, f"{rates[0]}/{rates[1]} %", *differences])
        parts.append(_titled(name, text_table(rows, left_columns=2)))
    return "\n\n".join(parts)


def pairs_table(env: dict[str, Any]) -> str:
    """Returns the differences of every arm to the arms with a proof, adjusted for comparing all pairs."""
    parts = []
    for own in (name for name in SOUND_ARMS if name in env["arms"]):
        rows = [[f"minus {own}:", "return [95 % CI]", "p (Holm)", "violating episodes [%]"]]
        for name in (each for each in env["arms"] if each != own):
            returned, violating = (_oriented(env["pairs"][measure], name, own) for measure in MEASURES)
            cells = [_difference(returned), _p_text(returned["p_holm"]), _difference(violating, 100.0)]
            rows.append([name, *cells])
        parts.append(text_table(rows))
    return "\n\n".join(parts)


def simpler_table(summary: dict[str, Any]) -> str:
    """Returns, for every environment, what simpler policies do beside trained agents with a proof."""
    parts = []
    for title, env in summary["environments"].items():
        for own in (name for name in SOUND_ARMS if name in env["arms"]):
            rows = [[f"minus {own}:", "return [95 % CI]", "p (Holm)", "violating", "verdict"]]
            for name in (each for each in env["arms"] if each.startswith(_SIMPLER)):
                arm, returned = env["arms"][name], _oriented(env["pairs"]["return"], name, own)
                violating = f"{arm['eval_violating_episodes']:,} of {arm['eval_episodes']:,}"
                cells = [_difference(returned), _p_text(returned["p_holm"]), violating, _verdict(arm, returned)]
                rows.append([name, *cells])
            parts.append(_titled(title, text_table(rows)))
    return "\n\n".join(parts)


def channels_table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns what filters do not keep at both ends of every side of a sweep, by its own disturbance and by the worst.

    Args:
        rows: What `channel_sweep` returns.
    """
    sides: dict[str, list[float]] = {}
    for row in rows:
        sides.setdefault(row["side"], []).append(row["value"])
    ends = [(side, value) for side, values in sides.items() for value in dict.fromkeys((min(values), max(values)))]
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    parts = []
    for count, filters in FILTERS_BY_COUNT.items():
        table = [[_SWEPT_COUNTS[count], *(f"{_SWEPT_SIDES[side]} {value:g}" for side, value in ends)]]
        for arm in (each for each in arms if each.rpartition("+")[2] in filters):
            own = [row for row in rows if row["arm"] == arm]
            table.append([arm, *(_swept_rates(own, end, count) for end in ends)])
        parts.append(text_table(table))
    return "\n\n".join(parts)


def scores_table(summary: dict[str, Any]) -> str:
    """Returns the interquartile means of scores over all environments; empty where there are none."""
    if not summary["scores"]:
        return ""
    rows = [["", "score", "[95 % CI]"]]
    for name, score in summary["scores"].items():
        interval = score["ci95"]
        cell = f"[{interval[0]:z.2f}, {interval[1]:z.2f}]" if interval else "one run"
        rows.append([name, f"{score['iqm']:z.2f}", cell])
    return text_table(rows)


def budget_text(summary: dict[str, Any]) -> str:
    """Returns what was spent in each environment, one line each."""
    return "\n".join(
        f"{name}: {env['seeds']} {'run' if env['seeds'] == 1 else 'runs'} per arm, {env['steps']:,} training steps "
        f"each, {env['episodes']} episodes per run and scenario"
        for name, env in summary["environments"].items()
    )


def _lead(summary: dict[str, Any]) -> dict[str, Any]:
    """Returns the first environment with the arms that a short table has."""
    env = next(iter(summary["environments"].values()))
    arms = {name: arm for name, arm in env["arms"].items() if name not in _NOT_IN_LEAD}
    return env | {"arms": arms, "trained": [name for name in env["trained"] if name in arms]}


# What other pages can quote, by name.
QUOTABLE: dict[str, Callable[[dict[str, Any]], str]] = {
    "lead": lambda summary: evaluation_table(_lead(summary)),
    "budget": budget_text,
    "price": price_table,
    "simpler": simpler_table,
    "scores": scores_table,
}


def tables_by_name(summary: dict[str, Any]) -> dict[str, str]:
    """Returns the tables that pages quote: lead (of the first environment), budget, price, simpler and scores.

    Args:
        summary: What `page_summary` returns, with the sweep of channels.
    """
    return {name: table(summary) for name, table in QUOTABLE.items()}


def _titled(title: str, table: str) -> str:
    return f"{title}\n{table}"


def _swept_rates(rows: Sequence[dict[str, Any]], end: tuple[str, float], count: str) -> str:
    """Returns the percentages of episodes at a point of a sweep, one per disturbance."""
    at_end = [row for row in rows if (row["side"], row["value"]) == end]
    return "/".join(f"{100 * row[count] / row['episodes']:.0f}" for row in at_end)


def _oriented(pairs: Sequence[dict[str, Any]], name: str, own: str) -> dict[str, Any]:
    """Returns the difference name - own, whichever order it is stored in."""
    pair = next(pair for pair in pairs if {pair["first"], pair["second"]} == {name, own})
    if pair["first"] == name:
        return pair
    interval = pair["ci95"] and [-pair["ci95"][1], -pair["ci95"][0]]
    return pair | {"mean": -pair["mean"], "ci95": interval}


def _verdict(arm: dict[str, Any], returned: dict[str, Any]) -> str:
    """Returns what a simpler policy is compared with a trained agent that has a proof."""
    if arm["eval_violating_episodes"]:
        return "violates"
    if returned["p_holm"] is None or returned["p_holm"] > LEVEL:
        return "not shown"
    return "wins" if returned["mean"] > 0.0 else "loses"


def _rates(arm: dict[str, Any]) -> str:
    """Returns the violating episodes of an arm as trained, and those under the condition where most violate."""
    worst = max(
        (each["eval_violation_rate"] for each in arm["conditions"].values()), default=arm["eval_violation_rate"]
    )
    return f"{100 * arm['eval_violation_rate']:.1f}/{100 * worst:.1f}"


def _violating(arm: dict[str, Any]) -> str:
    low, high = (100.0 * end for end in arm["eval_violation_rate_ci95"])
    return f"{100 * arm['eval_violation_rate']:.1f} [{low:.1f}, {high:.1f}]"


def _return(arm: dict[str, Any]) -> str:
    interval = arm["eval_return_ci95"]
    half = "[n/a]" if interval is None else f"+-{0.5 * (interval[1] - interval[0]):.1f}"
    return f"{arm['eval_return_mean']:z.1f} {half}"


def _difference(difference: dict[str, Any], scale: float = 1.0) -> str:
    interval = difference["ci95"]
    text = f" [{_signed(scale * interval[0])}, {_signed(scale * interval[1])}]" if interval else ""
    return f"{_signed(scale * difference['mean'])}{text}"


def _signed(value: float) -> str:
    return f"{value:+z.1f}"


def _p_text(p_value: float | None) -> str:
    if p_value is None:
        return "-"
    return "<0.001" if p_value < 0.001 else f"{p_value:.3f}"
