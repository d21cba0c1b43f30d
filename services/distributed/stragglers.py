"""How long a call may take before its actor counts as slow: many times the median of its method."""

from collections import defaultdict, deque
from statistics import median

from services.distributed.calls import Call

TIMEOUT_FACTOR = 10
"""A call is slow once it takes this many times the median of its method."""
MIN_TIMEOUT_SECONDS = 2.0
"""The shortest timeout: a backup takes some seconds to start."""
MIN_OUTSIDE_TIMEOUT_SECONDS = 30.0
"""The shortest timeout of a call to an actor outside the pool, which costs more to lose."""
INITIAL_TIMEOUT_SECONDS = 60.0
"""The timeout while too few durations are known."""
MIN_SAMPLES = 3
"""Durations of a method needed for its median; the last hundred count."""


class Timeouts:
    """Timeouts of calls, from the durations of earlier calls of the same method."""

    def __init__(self) -> None:
        self._durations: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=100))

    def record(self, call: Call, seconds: float) -> None:
        """Record the duration of a call that has ended."""
        self._durations[call.method].append(seconds)

    def seconds(self, call: Call) -> float:
        """Return how long a call may take."""
        durations = self._durations[call.method]
        if len(durations) < MIN_SAMPLES:
            return INITIAL_TIMEOUT_SECONDS
        shortest = MIN_TIMEOUT_SECONDS if call.actor is None else MIN_OUTSIDE_TIMEOUT_SECONDS
        return max(shortest, TIMEOUT_FACTOR * median(durations))
