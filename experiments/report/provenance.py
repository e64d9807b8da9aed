"""Where the numbers of a report come from."""

from __future__ import annotations

from html import escape
from typing import Any

from experiments.report.html import Markup, note, pairs, table
from shields import Report

# The group of settings that an algorithm takes; all others take "off_policy".
GROUPS = {"PPO": "ppo", "TRPO": "ppo", "A2C": "a2c"}


def origin_sections(summary: dict[str, Any], verification: Report, command: str) -> dict[str, str]:
    """Returns the sections on how to run it again, certificate, settings and versions: HTML by heading.

    Args:
        summary: The content of summary.json.
        verification: Of the certificate.
        command: Of `ncs`, by which it was made.
    """
    settings, plant = summary["settings"], summary["plant"]
    used = GROUPS.get(settings["algo"], "off_policy")
    left_out = {"ppo", "a2c", "off_policy"} - {used}
    shown = _flat({name: value for name, value in settings.items() if name not in left_out})
    origin = {
        "certificate, SHA-256": Markup(f"<code>{escape(summary['certificate'])}</code>"),
        "plant, fingerprint": Markup(f"<code>{escape(str(plant['fingerprint']))}</code>"),
        "plant, spectral radius": f"{plant['spectral_radius']:.6g}",
    }
    which = " The certificate is that of the table's first channel." if command == "sweep" else ""
    again = f"<pre>ncs {command} --config settings.json --out again</pre>\n"
    beside = (
        "settings.json, certificate.json, summary.json and the agents lie beside this page, and so does every "
        f"{'unit' if command == 'sweep' else 'evaluation episode'} as a row of a Parquet file. Equal settings and "
        "versions draw the same numbers."
    )
    return {
        "How to reproduce this": again + note(beside),
        "The certificate, verified in exact rational arithmetic": _conditions(verification)
        + note(f"A condition holds when its exact margin has the right sign; margins are printed for people.{which}")
        + pairs(origin),
        "Settings": pairs(shown)
        + note(
            "A channel's setting of none leaves the environment's own. Settings of algorithms that were not used are "
            "in settings.json."
        ),
        "Versions": pairs(summary["versions"]),
    }


def _conditions(verification: Report) -> str:
    rows = [
        # Of a condition that is only true or false, zero says nothing.
        [c.name, f"{c.margin:+.2e}" if c.margin else "\N{EN DASH}", Markup(f'<span class="{word}">{word}</span>')]
        for c in verification.conditions
        for word in ["holds" if c.holds else "broken"]
    ]
    return table("Conditions of the certificate", ["condition", "margin", ""], rows)


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, str]:
    """Returns nested settings as text by dotted name."""
    flat: dict[str, str] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{name}.")
        elif isinstance(value, list):
            flat[prefix + name] = " ".join(map(str, value)) or "none"
        else:
            flat[prefix + name] = "none" if value is None else str(value)
    return flat
