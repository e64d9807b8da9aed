"""One self-contained page about a comparison or a sweep."""

from __future__ import annotations

from html import escape
from typing import Any

from experiments.analysis.statistics import RESAMPLES
from experiments.report.html import figure, items, note, page, table
from experiments.report.provenance import origin_sections
from experiments.report.tables import (
    PERCENT,
    arm_name,
    difference_table,
    overridden_text,
    return_table,
    return_text,
    safety_table,
    violating_text,
)
from experiments.runs.arms import arm_of
from shields import Report

MODES = {
    "project": "where the action is not provably safe, the closest input that is takes its place.",
    "switch": "where the action is not provably safe, the certified input K x_hat takes its place.",
    "boundary": "where not every input would be provably safe, the certified input K x_hat takes the action's place.",
}
# With fewer runs the percentile bootstrap is plainly too narrow.
FEW_RUNS = 10


def html_report(summary: dict[str, Any], verification: Report, figures: dict[str, bytes], findings: list[str]) -> str:
    """Returns the page: tables, findings, figures, certificate and settings; opens offline.

    Args:
        summary: The content of summary.json.
        verification: Of the certificate.
        figures: PNG bytes by caption.
        findings: Sentences to print under the first table.
    """
    settings, arms, references = (summary[name] for name in ("settings", "arms", "references"))
    runs = max(arm["runs"] for arm in arms.values())
    lead = (
        f"{settings['algo']}, {settings['steps']:,} training steps per run, {runs} {_runs(runs)} per arm, "
        f"{settings['episodes']:,} evaluation episodes per run, seed {settings['seed']}"
    )
    sections = {
        "": _reading(summary),
        "Violations and interventions": safety_table(arms, references) + _safety_note(arms, references),
        "Findings": items(findings),
        "Return": return_table(arms, references) + note(_return_note(runs)),
        "Paired differences": _differences(summary["paired_differences"], runs),
        "Figures": _figures(figures),
    }
    return page(
        f"Safe learning on {settings['env']}", lead, sections | origin_sections(summary, verification, "compare")
    )


def sweep_report(summary: dict[str, Any], verification: Report, figures: dict[str, bytes]) -> str:
    """Returns the page of a sweep; see `html_report`."""
    settings = summary["settings"]
    lead = (
        f"{settings['algo']}, {settings['steps']:,} training steps per run, {settings['seeds']} "
        f"{_runs(settings['seeds'])} per arm and channel, {settings['episodes']:,} evaluation episodes per run, "
        f"seed {settings['seed']}"
    )
    reading = (
        "<p>Agents are trained and evaluated anew for every channel, with the same seeds. Violations are those of the "
        "true state, which neither agent nor shield sees.</p>\n"
    )
    sections = {
        "": reading + _arms_explained(settings),
        "Figures": _figures(figures),
        "Every channel and arm": _sweep_table(summary["cells"], settings["mode"]) + note(_sweep_note(settings)),
    }
    title = f"Channels of {settings['env']}"
    return page(title, lead, sections | origin_sections(summary, verification, "sweep"))


def _reading(summary: dict[str, Any]) -> str:
    """Returns what was compared."""
    rows = {
        "zero input": "does nothing",
        "K x_hat": "the certified linear feedback",
        "untrained": "the agents' networks with their initial weights",
    }
    known = [f"{name} ({rows[name]})" for name in summary["references"] if name in rows]
    below = f"<p>Below the rule of a table, for reference and without a shield: {escape(', '.join(known))}.</p>\n"
    return (
        "<p>The same task, learned with and without a certified shield. In evaluation, runs with equal numbers meet "
        "the same initial states, disturbances and packet losses in all arms. Violations are those of the true state, "
        "which neither agent nor shield sees, unless a table says that they are the estimate's.</p>\n"
        f"{_arms_explained(summary['settings'])}{below if known else ''}"
    )


def _arms_explained(settings: dict[str, Any]) -> str:
    """Returns a list of the arms and how their agents are trained."""
    entries = "".join(
        f"<dt>{arm_name(name)}</dt><dd>{escape(_explained(name, settings))}</dd>" for name in settings["arms"]
    )
    return f"<dl>{entries}</dl>\n"


def _explained(name: str, settings: dict[str, Any]) -> str:
    arm = arm_of(name, settings["mode"])
    if arm.prices_violations:
        return f"no shield; in training every violating step costs {settings['violation_penalty']:g} of reward."
    if arm.mode is None:
        return "the agent's action is applied as it is."
    if arm.mode == "monitor":
        return "unshielded too; a shield watches, and counts in brackets what it would have overridden."
    price = f" In training every intervention costs {settings['intervention_penalty']:g} of reward."
    return MODES[arm.mode] + (price if arm.prices_interventions else "")


def _safety_note(arms: dict[str, Any], references: dict[str, Any]) -> str:
    text = (
        f"Exact {PERCENT} intervals of the probability that an episode violates, given the trained agents: they say "
        "nothing of agents trained anew. After no violation the interval's upper end is shown. Steps are plain counts, "
        "because steps of one episode depend on each other. A shield decides by the estimate, so the estimate's "
        "violations are counted apart."
    )
    if "monitor" in arms | references:
        text += " In brackets: what the shield would have overridden."
    return note(text)


def _return_note(runs: int) -> str:
    """Returns how to read the intervals of the return."""
    text = "Returns in evaluation are the environment's own, without penalties. "
    if runs == 1:
        return text + "With one run per arm there is no interval over runs: how training varies is unknown."
    text += (
        f"Intervals are over {runs} runs where policies differ from run to run, as trained and untrained agents do; "
        "where every run has the same, over the episodes. The interquartile mean leaves out the lowest and the highest "
        "quarter of the values, rounded down"
    )
    text += ": of fewer than 4 runs none, so that it is the mean. " if runs < 4 else ". "
    text += "Student's interval takes the runs' returns for normal. "
    return text + _bootstrap_note(runs)


def _bootstrap_note(runs: int) -> str:
    if runs >= FEW_RUNS:
        return f"The bootstrap's is the percentile interval of {RESAMPLES:,} resamples of {runs} runs."
    return (
        f"A percentile bootstrap over {runs} runs is too narrow: it cannot reach beyond the lowest and the highest "
        "run. Believe the wider one."
    )


def _differences(paired: dict[str, Any], runs: int) -> str:
    if not paired["arms"]:
        return ""
    text = f"Each arm minus {paired['baseline']}, run by run: their episodes meet the same draws of nature. "
    if runs == 1:
        return difference_table(paired) + note(text + "One run per arm: there is no interval.")
    return difference_table(paired) + note(f"{text}Intervals over {runs} pairs of runs. {_bootstrap_note(runs)}")


def _figures(figures: dict[str, bytes]) -> str:
    return "".join(figure(caption, png) for caption, png in figures.items())


def _sweep_table(cells: list[dict[str, Any]], mode: str) -> str:
    """Returns a row per channel and arm."""
    head = [
        "arm",
        "loss probability",
        "delay [steps]",
        "rounding",
        "mean burst",
        "violating steps in training",
        f"violating evaluation episodes [{PERCENT}]",
        "overridden in evaluation",
        f"mean return [Student's {PERCENT}]",
    ]
    rows = []
    for cell in cells:
        rounding = "own" if cell["quantization_step"] is None else f"{cell['quantization_step']:g}"
        place = [
            f"{cell['loss']:g}",
            str(cell["delay"]),
            rounding,
            f"{cell['burst_length']:g}" if cell["burst_length"] else "none",
        ]
        for name, numbers in cell["arms"].items():
            arm = numbers | {"mode": arm_of(name, mode).mode}
            rows.append(
                [
                    arm_name(name),
                    *place,
                    f"{arm['train_violation_steps']:,} of {arm['train_steps']:,}",
                    violating_text(arm),
                    overridden_text(arm, "intervention_rate"),
                    return_text(arm),
                ]
            )
    per_cell = len(rows) // len(cells)
    return table("Every channel and arm", head, rows, rules=range(per_cell, len(rows), per_cell))


def _sweep_note(settings: dict[str, Any]) -> str:
    text = (
        "Shares of violating episodes with Clopper and Pearson's exact interval given the trained agents; after no "
        "violation, its upper end. "
    )
    if settings["seeds"] == 1:
        return text + "One run per arm and channel: the return has no interval, and differences may be chance."
    return text + f"Intervals of the return are Student's over {settings['seeds']} runs."


def _runs(count: int) -> str:
    return "run" if count == 1 else "runs"
