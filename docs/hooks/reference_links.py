"""Links in what docstrings say on the pages of the reference: to the pages they name, and to the names of the code."""

import re
from collections.abc import Iterator
from posixpath import dirname, relpath
from typing import Any

# Folders of the pages whose text comes from docstrings.
FOLDERS = ("api/", "environments/")
# What stays as it is: programs and signatures, links, headings, names of arguments.
_KEPT = r"<pre\b.*?</pre>|<a\b.*?</a>|<h\d\b.*?</h\d>|<b>.*?</b>"
# A page in a docstring: docs/shield_proof.md section 3, or docs/shield_proof.md, "Rounding".
_PAGE = (
    r'(?:<code>)?(?:docs/)?(?P<page>[a-z]\w*)\.md(?:</code>)?(?:\s+sections?\s+(?P<number>\d)|,\s+"(?P<title>[^"<]+)")?'
)
_NAME = r"<code>(?P<name>[A-Za-z_]\w*)</code>"
_REFERENCE = re.compile(f"{_KEPT}|{_PAGE}|{_NAME}", re.DOTALL)
# Headings of the reference carry the full name as their anchor.
_ANCHOR = re.compile(r'<h3 id="([\w.]+)"')


def on_page_context(context: Any, page: Any, nav: Any, **_: Any) -> Any:
    """Puts the links into a page of the reference; a page or section that does not exist ends the build.

    Args:
        context: Variables of the template.
        page: The page.
        nav: All pages.

    Raises:
        ValueError: If a docstring names a page or a section that there is not.
    """
    if page.file.src_uri.startswith(FOLDERS):
        pages = {each.file.src_uri: each for each in nav.pages}
        names = _names(pages)
        page.content = _REFERENCE.sub(lambda found: _link(found, page, pages, names), page.content)
    return context


def _names(pages: dict[str, Any]) -> dict[str, tuple[Any, str]]:
    """Returns page and anchor of every class and function of the reference."""
    reference = [page for path, page in pages.items() if path.startswith("api/")]
    return {anchor.rpartition(".")[2]: (page, anchor) for page in reference for anchor in _ANCHOR.findall(page.content)}


def _link(found: re.Match[str], page: Any, pages: dict[str, Any], names: dict[str, tuple[Any, str]]) -> str:
    """Returns the link that takes the place of what was found, or what was found."""
    if found["page"]:
        target = pages.get(f"{found['page']}.md")
        if target is None:
            raise ValueError(f"{page.file.src_uri} names a page that there is not: {found[0]}")
        anchor, part = _section(found, target)
        return f'<a href="{_path(target, page)}{anchor}">{target.title}{part}</a>'
    if found["name"] in names:
        target, anchor = names[found["name"]]
        return f'<a href="{_path(target, page)}#{anchor}">{found[0]}</a>'
    return found[0]


def _path(target: Any, page: Any) -> str:
    """Returns the address of a page as another one links to it."""
    return relpath(target.url, dirname(page.url))


def _section(found: re.Match[str], target: Any) -> tuple[str, str]:
    """Returns the anchor of the section that a docstring names, and how the text names it."""
    title = " ".join((found["title"] or "").split())  # a docstring may break the line within it
    wanted = f"{found['number']}. " if found["number"] else title
    if not wanted:
        return "", ""
    for each in _headings(target.toc):
        if each.title.startswith(wanted):
            return each.url, f", section {found['number']}" if found["number"] else f", {title}"
    raise ValueError(f"{target.file.src_uri} has no section {wanted!r}")


def _headings(entries: Any) -> Iterator[Any]:
    """Yields the entries of a table of contents, those below each after it."""
    for entry in entries:
        yield entry
        yield from _headings(entry.children)
