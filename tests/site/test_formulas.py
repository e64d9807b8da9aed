"""Formulas and names of the pages: as the site and GitHub read them."""

import re
from pathlib import Path

import pytest

from tests.site.hooks import site_hook

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs").glob("*.md"))
FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
# Backslashes before punctuation are Markdown's on GitHub, signs of order look like HTML, and what is broken over two
# lines is no formula everywhere.
NOT_INLINE = re.compile(r"\\[^A-Za-z]|[<>\n]")


def formulas(page):
    """Formulas in the lines of a page, and those in blocks of their own."""
    text = page.read_text()
    blocks = [content for language, content in FENCED.findall(text) if language == "math"]
    parts = re.sub(r"`[^`]*`", "", FENCED.sub("", text)).split("$")
    assert len(parts) % 2 == 1, f"a dollar without a second one in {page.name}"
    return parts[1::2], blocks


def test_proofs_have_formulas():
    lines, blocks = formulas(ROOT / "docs" / "shield_proof.md")
    assert len(lines) > 100
    assert len(blocks) > 10


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_formulas_in_a_line_are_left_alone_by_markdown(page):
    for formula in formulas(page)[0]:
        assert formula == formula.strip() != "", formula
        assert not NOT_INLINE.search(formula), formula
        assert formula.count("{") == formula.count("}"), formula


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_formulas_become_mathml(page):
    pytest.importorskip("math_core", reason="the extra [docs] is not installed")
    hook = site_hook("mathml")
    lines, blocks = formulas(page)
    text = hook.on_page_markdown("".join(f"```math\n{block}```\n" for block in blocks))
    assert text.count("$$") == 2 * len(blocks)
    content = "".join(f'<span class="arithmatex">\\({each}\\)</span>' for each in lines)
    content += "".join(f'<div class="arithmatex">\\[\n{each}\\]</div>' for each in blocks)
    made = hook.on_page_content(content)
    assert made.count("<math") == len(lines) + len(blocks)
    assert made.count('<div class="formula">') == len(blocks)
    assert "arithmatex" not in made


def test_options_and_ids_stay_on_one_line():
    hook = site_hook("unbroken")
    block = "<pre><span></span><code>ncs train --seed 1</code></pre>"
    made = hook.on_page_content(f"<p>a--b <code>ncs train --a2c.n-steps 1 ncs_gym/CartPole-v0</code></p>{block}")
    kept = '<span class="unbroken">--a2c.n-steps</span> 1 <span class="unbroken">ncs_gym/CartPole-v0</span>'
    assert made == f"<p>a--b <code>ncs train {kept}</code></p>{block}"
