"""The pages of the reference link to the pages and names that docstrings mention."""

from types import SimpleNamespace

import pytest

from tests.site.hooks import site_hook


@pytest.fixture(scope="module")
def hook():
    """The module of the site, which is part of no package."""
    return site_hook("reference_links")


def site_page(path, content="", title="", toc=()):
    """A page as mkdocs hands it to a hook."""
    url = path.replace(".md", ".html")
    return SimpleNamespace(file=SimpleNamespace(src_uri=path), url=url, content=content, title=title, toc=toc)


def linked(hook, content):
    """Content of a page of the reference after the hook, beside a page of theory."""
    entry = SimpleNamespace(title="3. The certified method", url="#3-the-certified-method", children=())
    proof = SimpleNamespace(title="Rounding", url="#rounding", children=())
    theory = site_page("theory.md", title="Theory", toc=[SimpleNamespace(title="", url="#", children=(entry, proof))])
    page = site_page("api/shields.md", '<h3 id="shields.Filter" class="x">Filter</h3>' + content)
    hook.on_page_context({}, page=page, config=None, nav=SimpleNamespace(pages=[theory, page]))
    return page.content.partition("</h3>")[2]


@pytest.mark.parametrize(
    ("text", "made"),
    [
        ("(docs/theory.md)", '(<a href="../theory.html">Theory</a>)'),
        ("theory.md section 3", '<a href="../theory.html#3-the-certified-method">Theory, section 3</a>'),
        ('docs/theory.md, "Rounding"', '<a href="../theory.html#rounding">Theory, Rounding</a>'),
        ("<code>Filter</code>", '<a href="shields.html#shields.Filter"><code>Filter</code></a>'),
        ("<code>Other</code>", "<code>Other</code>"),
        ("<pre>docs/theory.md</pre>", "<pre>docs/theory.md</pre>"),
        ('<a href="x">docs/theory.md</a>', '<a href="x">docs/theory.md</a>'),
    ],
)
def test_docstrings_link_to_what_they_name(hook, text, made):
    assert linked(hook, text) == made


@pytest.mark.parametrize("text", ["docs/none.md", "theory.md section 9", 'docs/theory.md, "None"'])
def test_reference_to_what_there_is_not_ends_the_build(hook, text):
    with pytest.raises(ValueError, match=r"names a page that there is not|has no section"):
        linked(hook, text)
