"""When the steps of a control loop begin, by a clock of one's own that another one is followed with."""

from __future__ import annotations

from collections import deque

# Arrivals of which the quickest tells the origin; part of a step by which a clock is moved at once at most.
WINDOW, LARGEST_MOVE = 100, 0.02


class StepClock:
    """Numbers the steps: step k begins at origin + k dt, on any clock that counts seconds.

    A node that follows another one does not ask what its clock says: a message that was sent at the beginning of step k
    and arrives at time a tells that step k began at a, less a delay. Of the newest hundred the one with the least delay
    counts, and the origin is moved there by at most 2 % of a step at once, so that offsets do not matter, drift is
    followed, and late or repeated messages change nothing. Steps so begin one least delay later than in the other node.

    Args:
        dt: Duration of a step [s].

    Attributes:
        episode: Number of the episode that was joined last; 0 for none.
        origin: When step 0 began [s].
        drift: How much faster than this clock the other one runs, as a fraction, since the start; 0.0 if none is heard.
        jumps: How often the other one was more than a step away, so that steps were repeated or skipped to follow it.
    """

    def __init__(self, dt: float) -> None:
        self.dt, self.drift, self.jumps = dt, 0.0, 0
        self.origin, self._started = 0.0, 0.0
        self.episode = 0
        self._origins: deque[float] = deque(maxlen=WINDOW)
        self._newest = -(2**63)

    def join(self, episode: int, now: float, step: int) -> None:
        """Starts anew with the episode of another clock; nodes with a common clock join it once."""
        if episode != self.episode:
            self.start(now, step)
            self.episode = episode

    def start(self, now: float, step: int = 0) -> None:
        """Starts anew: a step begins now."""
        self.origin = self._started = now - step * self.dt
        self._origins.clear()
        self._newest, self.drift, self.jumps = step, 0.0, 0

    def step_at(self, now: float) -> int:
        """Returns the number of the step that is under way."""
        return int((now - self.origin) // self.dt)

    def time_of(self, step: int) -> float:
        """Returns when a step begins."""
        return self.origin + step * self.dt

    def follow(self, step: int, arrival: float) -> None:
        """Takes in that a message sent at the beginning of a step arrived at a time; only newer ones count."""
        if step <= self._newest:
            return
        self._newest = step
        self._origins.append(arrival - step * self.dt)
        away = min(self._origins) - self.origin
        if abs(away) > self.dt:
            self.jumps += 1
            self.origin += away
        else:
            most = LARGEST_MOVE * self.dt
            self.origin += min(max(away, -most), most)
        if step > WINDOW:
            self.drift = (self._started - self.origin) / (step * self.dt)
