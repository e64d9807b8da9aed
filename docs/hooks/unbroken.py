"""Names in the text that a line must not break: `--seed` at a line's end would read as `--` and `seed`."""

import re
from typing import Any

# A block of code, which scrolls, or code in a sentence.
CODE = re.compile(r"<pre\b.*?</pre>|<code>(.*?)</code>", re.DOTALL)
# An option of a command, or the id of an environment.
NAME = re.compile(r"(?<![\w-])--[\w.*-]+|\b\w+/\w+-v\d+\b")


def on_page_content(content: str, **_: Any) -> str:
    """Returns a page whose names stay on one line.

    Args:
        content: HTML of the page.
    """
    return CODE.sub(_unbroken, content)


def _unbroken(found: re.Match[str]) -> str:
    if found[1] is None:
        return found[0]
    text = NAME.sub(r'<span class="unbroken">\g<0></span>', found[1])
    return f"<code>{text}</code>"
