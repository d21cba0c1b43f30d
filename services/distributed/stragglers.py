"""How long a call may take before its actor counts as slow: many times what its like took."""

from collections import defaultdict, deque
from statistics import median

from services.distributed.calls import Call

SLOWNESS = 10
"""A call that takes so many times what its like take is slow."""
LEAST_SECONDS = 2.0
"""But not before: a spare actor takes some seconds to start."""
FIRST_SECONDS = 60.0
"""What a call may take before it is known what its like take."""
OWN_SECONDS = 30.0
"""Nor before that where the actor is one of one's own: to lose it costs more."""
PEERS = 3
"""Calls of one method that must have ended for it to be known what its like take; the last hundred count."""


class Patience:
    """Remembers what the calls of each method took."""

    def __init__(self) -> None:
        self._seconds: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=100))

    def took(self, call: Call, seconds: float) -> None:
        """Remember a call that has ended."""
        self._seconds[call.method].append(seconds)

    def with_call(self, call: Call) -> float:
        """Return the seconds that a call may take."""
        known, least = self._seconds[call.method], LEAST_SECONDS if call.on is None else OWN_SECONDS
        return max(least, SLOWNESS * median(known)) if len(known) >= PEERS else FIRST_SECONDS
