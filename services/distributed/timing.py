"""Where the time of an iteration goes, from what each call notes of its own beginning and end."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple


class Span(NamedTuple):
    """When some work started and ended, in seconds of `time.perf_counter`: one clock for all processes of a machine."""

    started: float
    ended: float

    @property
    def seconds(self) -> float:
        """How long it took."""
        return self.ended - self.started


class Timing(NamedTuple):
    """Where an iteration's seconds went: the five add up to the time from one outer step's end to the next one's.

    Compute, step and the sum are true anywhere. The other three compare the clocks of several processes, which is sound
    on one machine only.
    """

    broadcast: float
    """From the new parameters until the workers begin, on average."""
    compute: float
    """What a worker computes, on average."""
    waiting: float
    """What a worker waits, on average: for its next call, and for the slowest worker at the end."""
    reduction: float
    """From the last gradient's end until the outer step begins with their sum."""
    step: float
    """The outer step itself."""

    @classmethod
    def of(cls, ready: float, work: Mapping[int, Sequence[Span]], step: Span) -> "Timing":
        """Divide up one iteration.

        Its parameters were `ready` at a time on the learner's clock; `work` has the gradient calls of each worker that
        had one.
        """
        begin = sum(min(span.started for span in spans) for spans in work.values()) / len(work)
        compute = sum(span.seconds for spans in work.values() for span in spans) / len(work)
        end = max(span.ended for spans in work.values() for span in spans)
        return cls(begin - ready, compute, end - begin - compute, step.started - end, step.seconds)

    @property
    def iteration(self) -> float:
        """All five together."""
        return sum(self)

    @property
    def overhead_share(self) -> float:
        """The part of the iteration in which neither the workers compute nor the learner steps."""
        return 1 - (self.compute + self.step) / self.iteration
