"""What a synthesis shows on a terminal while it takes its time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

# Most syntheses are over before anybody wonders [s].
_SILENT_SECONDS = 3.0


@contextmanager
def synthesis_status() -> Iterator[Callable[[str], None]]:
    """Yields what shows a line of progress on stderr, if that is a terminal and some seconds have passed."""
    form = "synthesis, {desc} [{elapsed}]"
    with tqdm(bar_format=form, leave=False, disable=None, delay=_SILENT_SECONDS) as line:

        def show(text: str) -> None:
            line.set_description_str(text, refresh=False)
            line.update(0)  # which draws, unlike the text alone, only after the delay

        yield show
