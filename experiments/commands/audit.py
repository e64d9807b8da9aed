"""`ncs audit`: checks the claims of the paper one by one; docs/paper.md discusses the outcome."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from experiments.paper.audit import Claim, Verdict, audited_claims, defects
from experiments.paper.paper_example import PaperExample
from experiments.runs.output_folder import require_place
from experiments.terminal import terminal_width, wrapped
from shields.atomic_write import write_atomically


@dataclass(frozen=True, kw_only=True)
class AuditSettings:
    """Checks the claims of the paper (Liu et al.) one by one, from its own printed numbers.

    Attributes:
        out: File for the rows (JSON).
    """

    out: Path | None = None


_INDENT = 16
_RELATIONS = re.compile(r" (=|<=|>=|<|>) ")


def audit(settings: AuditSettings) -> None:
    """Runs `ncs audit`."""
    require_place(settings.out)
    claims = list(audited_claims(PaperExample()))
    if settings.out is not None:
        write_atomically(settings.out, json.dumps([asdict(claim) for claim in claims], indent=1) + "\n")
    print(text_of(claims, terminal_width()))


def text_of(claims: Sequence[Claim], width: int) -> str:
    """Returns the claims as a terminal of some width shows them."""
    blocks = []
    for number, claim in enumerate(claims, 1):
        lines = [_wrapped(f"{number:2d}.", f"{claim.verdict.upper()}: {claim.claim}", width, indent=4)]
        for label, text in (("printed", claim.printed), ("computed", claim.computed), ("charitably", claim.charitable)):
            if text:
                lines.append(_wrapped(f"    {label}", text, width))
        blocks.append("\n".join(lines))
    return "\n\n".join([*blocks, _summary(claims, width)])


def _summary(claims: Sequence[Claim], width: int) -> str:
    """Returns how many rows have each verdict, and the distinct defects behind those that do not hold."""
    counts, found = Counter(claim.verdict for claim in claims), defects(claims)
    text = (
        f"Of {len(claims)} rows {counts[Verdict.HOLDS] + counts[Verdict.ROUNDED]} hold ({counts[Verdict.ROUNDED]} of "
        f"them but for rounding), {counts[Verdict.FAILS]} do not hold, {counts[Verdict.UNDECIDED]} are undecided, "
        f"{counts[Verdict.NOT_PRINTED]} is about what is not printed, {counts[Verdict.VACUOUS]} is vacuous. The rows "
        f"that do not hold show {len(found)} distinct defects:"
    )
    lines = [_wrapped("", text, width, indent=0)]
    for number, (defect, rows) in enumerate(found.items(), 1):
        named = f"row{'s' * (len(rows) > 1)} {', '.join(map(str, rows))}"
        lines.append(_wrapped(f"{number:2d}.", f"{defect} ({named})", width, indent=4))
    return "\n".join(lines)


def _wrapped(label: str, text: str, width: int, indent: int = _INDENT) -> str:
    """Returns a label and a text in lines of at most that width; a formula is not broken at its relation."""
    for product in ("K L K'", "x+'M x+"):
        text = text.replace(product, product.replace(" ", "\0"))
    return wrapped(_RELATIONS.sub("\0\\1\0", text), width, label=label, indent=indent).replace("\0", " ")
