"""The extension of Markdown with which pages become HTML: formulas as MathML, and what a line must not break."""

from typing import Any

import mathml
import unbroken
from markdown import Markdown
from markdown.extensions import Extension
from markdown.postprocessors import Postprocessor
from markdown.preprocessors import Preprocessor

# Before fenced blocks are taken out of the text (25), and after everything is put back into the page (30).
BEFORE_FENCES, AFTER_ALL = 28, -10


class _Formulas(Preprocessor):
    def run(self, lines: list[str]) -> list[str]:
        return mathml.on_page_markdown("\n".join(lines)).split("\n")


class _Page(Postprocessor):
    def run(self, text: str) -> str:
        return unbroken.on_page_content(mathml.on_page_content(text))


class SiteMarkdown(Extension):
    """Registers both."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Adds the parts to the parser."""
        md.preprocessors.register(_Formulas(md), "formulas", BEFORE_FENCES)
        md.postprocessors.register(_Page(md), "page", AFTER_ALL)


def makeExtension(**settings: Any) -> SiteMarkdown:
    """Returns the extension; Markdown calls this by its name."""
    return SiteMarkdown(**settings)
