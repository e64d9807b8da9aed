"""When the steps of a control loop begin, by a clock of one's own that another one is followed with."""

from __future__ import annotations

from collections import deque

# Arrivals of which the quickest tells the origin, and how many are waited for; part of a step by which the origin is
# moved per step at most: a clock that drifts by less is followed.
WINDOW, SETTLED, LARGEST_MOVE = 100, 8, 1e-3


class StepClock:
    """Numbers the steps: step k begins at origin + k dt, on any clock that counts seconds.

    A node that follows another one does not ask what its clock says: a message that was sent at the beginning of step k
    and arrives at time a tells that step k began at a, less a delay. Of the newest hundred the one with the least delay
    counts, so that offsets do not matter, drift is followed, and late or repeated messages change nothing. Steps begin
    one least delay later than in the other node, and last at most 0.1 % longer or shorter than dt.

    Args:
        dt: Duration of a step [s].

    Attributes:
        episode: Number of the episode that was joined last; 0 for none.
        origin: When step 0 began [s].
        drift: How much faster than this clock the other one runs, as a fraction; 0.0 while it is not known.
        jumps: How often the other one was more than a step away, and its episode was left.
    """

    def __init__(self, dt: float) -> None:
        self.dt, self.drift, self.jumps, self.episode, self.origin = dt, 0.0, 0, 0, 0.0
        self._first: tuple[int, float] | None = None
        self._origins: deque[float] = deque(maxlen=WINDOW)
        self._newest = 0

    @property
    def is_settled(self) -> bool:
        """Whether enough was heard of the other clock to go by it; always without an episode."""
        return self.episode == 0 or len(self._origins) >= SETTLED

    def join(self, episode: int, now: float, step: int) -> None:
        """Starts anew with an episode of another clock, of which a message arrives; joined by several nodes once."""
        if episode != self.episode:
            self.start(now, step)
            self.episode, self._newest = episode, step - 1

    def start(self, now: float, step: int = 0) -> None:
        """Starts anew: a step begins now."""
        self.origin, self._first, self.drift = now - step * self.dt, None, 0.0
        self._origins.clear()

    def give_up(self) -> None:
        """Leaves an episode of which too little was heard to go by it."""
        if not self.is_settled:
            self.episode = 0

    def step_at(self, now: float) -> int:
        """Returns the number of the step that is under way."""
        return int((now - self.origin) // self.dt)

    def time_of(self, step: int) -> float:
        """Returns when a step begins."""
        return self.origin + step * self.dt

    def follow(self, step: int, arrival: float) -> bool:
        """Takes in that a message sent at the beginning of a step arrived at a time; only newer ones count.

        Returns:
            False if the other clock is more than a step away: steps were repeated or skipped, and the episode is left.
        """
        if step <= self._newest:
            return True
        self._newest = step
        self._origins.append(arrival - step * self.dt)
        away = min(self._origins) - self.origin
        if len(self._origins) <= SETTLED:
            self.origin += away
        elif abs(away) > self.dt:
            self.jumps, self.episode = self.jumps + 1, 0
            return False
        else:
            most = LARGEST_MOVE * self.dt
            self.origin += min(max(away, -most), most)
        if len(self._origins) == WINDOW:
            self._first = self._first or (step, self.origin)
            first, origin = self._first
            self.drift = (origin - self.origin) / (max(step - first, 1) * self.dt)
        return True
