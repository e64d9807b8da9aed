"""What a worker process does first; imports nothing large, so that it happens at once."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading


def initialize_worker() -> None:
    """Leaves the reaction to Ctrl-C to the parent, and ends this process when its parent ends, however that happens."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def wait_for_parent() -> None:
        if parent is not None:
            parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_parent, daemon=True).start()
