"""Builds the site: makes the pages of environments and notebook, lets Zensical make HTML of all, links docstrings.

Ends with an error at a broken link, anchor, reference, picture or formula.

python docs/hooks/build_site.py [SITE]
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import environment_pages
import notebook_page
import reference_links
import yaml

ROOT = Path(__file__).resolve().parent.parent.parent
# A heading with its anchor, the text of a page without navigation, and the address of a picture.
HEADING = re.compile(r'<h([1-6]) id="([^"]+)"[^>]*>(.*?)(?:<a class="headerlink".*?)?</h\1>', re.DOTALL)
ARTICLE = re.compile(r"(?<=<article class=\"md-content__inner md-typeset\">).*?(?=</article>)", re.DOTALL)
PICTURE = re.compile(r'<img\b[^>]*\bsrc="([^"]+)"')


def main(site: str = "site") -> None:
    """Builds the site."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        shutil.copytree(ROOT / "docs", work / "docs", ignore=shutil.ignore_patterns("hooks"))
        config = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
        environment_pages.add_pages(work / "docs", config["nav"])
        notebook_page.add_page(work / "docs", config["nav"])
        config["plugins"][1]["mkdocstrings"]["handlers"]["python"]["paths"] = [str(ROOT)]
        (work / "mkdocs.yml").write_text(yaml.safe_dump(config, sort_keys=False))
        path = os.pathsep.join([str(Path(__file__).parent), str(ROOT)])
        command = [sys.executable, "-m", "zensical", "build", "--strict"]
        subprocess.run(command, cwd=work, env=os.environ | {"PYTHONPATH": path, "NO_COLOR": "1"}, check=True)
        require_pictures(work / "site")
        link_docstrings(work / "site")
        shutil.rmtree(site, ignore_errors=True)
        shutil.copytree(work / "site", site)


def require_pictures(site: Path) -> None:
    """Returns if every picture of a built site is there, which Zensical does not check.

    Raises:
        FileNotFoundError: Naming the first that is not, and its page.
    """
    for page in site.rglob("*.html"):
        for source in PICTURE.findall(page.read_text()):
            if not re.match(r"https?:|data:", source) and not (page.parent / source).is_file():
                raise FileNotFoundError(f"{page.relative_to(site)} shows a picture that there is not: {source}")


def link_docstrings(site: Path) -> None:
    """Puts links into the pages of a site whose text comes from docstrings.

    Raises:
        ValueError: If a docstring names a page or a section that there is not.
    """
    pages = [page_of(path, site) for path in sorted(site.rglob("*.html")) if path.name != "404.html"]
    nav = SimpleNamespace(pages=pages)
    for page in pages:
        before = page.content
        reference_links.on_page_context({}, page=page, nav=nav)
        if page.content != before:
            path = site / page.url
            path.write_text(ARTICLE.sub(lambda _, made=page.content: made, path.read_text(), count=1))


def page_of(path: Path, site: Path) -> Any:
    """Returns a page of a built site: its address, its text and its headings."""
    url = path.relative_to(site).as_posix()
    found = ARTICLE.search(path.read_text())
    content = found[0] if found else ""
    headings = [
        (level, anchor, re.sub("<[^>]+>", "", text).strip()) for level, anchor, text in HEADING.findall(content)
    ]
    return SimpleNamespace(
        file=SimpleNamespace(src_uri=url.removesuffix(".html") + ".md"),
        url=url,
        content=content,
        title=next((text for level, _, text in headings if level == "1"), ""),
        toc=[SimpleNamespace(title=text, url=f"#{anchor}", children=()) for _, anchor, text in headings],
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
