"""Formulas of the pages as MathML, which browsers draw without scripts or anything loaded from elsewhere."""

import html
import re
from typing import Any

from math_core import LatexToMathML

# A fenced block of language math, which GitHub draws as well and leaves its backslashes alone.
BLOCK = re.compile(r"^```math\n(.*?)^```$", re.DOTALL | re.MULTILINE)
# What pymdownx.arithmatex makes of `$...$` and `$$...$$`, with the brackets and punctuation that stay on its line.
FORMULA = re.compile(r'([(\[]*)<(span|div) class="arithmatex">\s*\\[(\[](.*?)\\[)\]]\s*</\2>([.,;:)\]]*)', re.DOTALL)
CONVERTER = LatexToMathML(fancy_error=False)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Returns the text of a page with its blocks of formulas between dollars.

    Args:
        markdown: Text of the page.
    """
    return BLOCK.sub(r"$$\n\1$$", markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Returns a page with its formulas as MathML.

    Args:
        content: HTML of the page.

    Raises:
        math_core.LatexError: If a formula is not LaTeX; it ends the build.
    """
    return FORMULA.sub(_mathml, content)


def _mathml(found: re.Match[str]) -> str:
    before, tag, latex, after = found.groups()
    formula = CONVERTER.convert_with_local_state(html.unescape(latex).strip(), displaystyle=tag == "div")
    if tag == "div":
        return f'{before}<div class="formula">{formula}</div>{after}'
    return f'<span class="inline-formula">{before}{formula}{after}</span>' if before or after else formula
