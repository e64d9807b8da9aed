"""Compiling what runs are made of: once, before there are workers, and with a line that says what takes so long."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import gymnasium as gym
import numpy as np

ANNOUNCEMENT = "compiling, which takes a minute or two, once per installation..."


def compile_first() -> None:
    """Compiles the loops of environments and shields, unless an earlier run left them on disk."""
    from shields import VectorSafetyShield

    with announced():
        env = VectorSafetyShield(gym.make_vec("ncs_gym/TruckTrailer-v0", num_envs=1))
        env.reset(seed=0)
        env.step(np.zeros((1, 1), np.float32))
        env.close()


@contextmanager
def announced() -> Iterator[None]:
    """Says on stderr when numba begins to compile something, and at the end how long that took."""
    from numba.core.event import Event, Listener, install_listener

    class Announcer(Listener):
        since: float | None = None

        def on_start(self, event: Event) -> None:
            if self.since is None:
                self.since = time.perf_counter()
                print(ANNOUNCEMENT, file=sys.stderr, flush=True)

        def on_end(self, event: Event) -> None:
            pass

    announcer = Announcer()
    with install_listener("numba:compile", announcer):
        yield
    if announcer.since is not None:
        print(f"compiled in {time.perf_counter() - announcer.since:.0f} s", file=sys.stderr, flush=True)
