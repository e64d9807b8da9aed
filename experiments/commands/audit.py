"""`ncs audit`: checks the printed numbers of the paper claim by claim; docs/paper.md discusses the outcome."""

from __future__ import annotations

import json
from dataclasses import asdict
from textwrap import fill

from experiments.paper.audit import HOLDS, ROUNDED, Claim, audited_claims
from experiments.paper.paper_example import PaperExample
from experiments.settings import AuditSettings
from shields.atomic_write import write_atomically

_WIDTH = 100


def audit(settings: AuditSettings) -> None:
    """Runs `ncs audit`.

    Raises:
        OSError: If the file cannot be written.
    """
    claims = list(audited_claims(PaperExample()))
    document = json.dumps([asdict(claim) for claim in claims], indent=1)
    if settings.out is not None:
        write_atomically(settings.out, document + "\n")
    print(document if settings.json else _text(claims))


def _text(claims: list[Claim]) -> str:
    """Returns the table for a terminal."""
    blocks = []
    for number, claim in enumerate(claims, 1):
        lines = [f"{number:2d}. {claim.verdict.upper():14s} {claim.claim}"]
        for label, text in (("printed", claim.printed), ("computed", claim.computed), ("charitably", claim.charitable)):
            if text:
                indent = " " * 18
                lines.append(fill(text, _WIDTH, initial_indent=f"    {label:12s}: ", subsequent_indent=indent))
        blocks.append("\n".join(lines))
    held = sum(claim.verdict in (HOLDS, ROUNDED) for claim in claims)
    return "\n\n".join([*blocks, f"{held} of {len(claims)} claims hold."])
