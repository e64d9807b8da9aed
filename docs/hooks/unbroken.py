"""What a line must not break: `--seed` at its end would read as `--` and `seed`, and 30 % as a bare 30."""

import re
from typing import Any

# A block of code, which scrolls, code in a sentence, or the space before a percent sign.
PLACE = re.compile(r"<pre\b.*?</pre>|<code>(.*?)</code>|(?<=\d) (?=%)", re.DOTALL)
# An option of a command, or the id of an environment.
NAME = re.compile(r"(?<![\w-])--[\w.*-]+|\b\w+/\w+-v\d+\b")


def on_page_content(content: str, **_: Any) -> str:
    """Returns a page whose names and percentages stay on one line.

    Args:
        content: HTML of the page.
    """
    return PLACE.sub(_unbroken, content)


def _unbroken(found: re.Match[str]) -> str:
    if found[1] is None:
        return "&nbsp;" if found[0] == " " else found[0]
    if 'class="unbroken"' in found[1]:  # docstrings come through twice, alone and on their page
        return found[0]
    text = NAME.sub(r'<span class="unbroken">\g<0></span>', found[1])
    return f"<code>{text}</code>"
