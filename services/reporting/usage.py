"""How the high level uses its sub-skills along time: shares, dwell times, switches and transitions."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64


class Segment(NamedTuple):
    """Steps one after the other for which a sub-skill is kept."""

    start: int
    steps: int
    sub_skill: int


class Usage(NamedTuple):
    """How sub-skills are used in some episodes, or along some demonstrations."""

    episodes: int
    steps: int
    """In all of them."""
    shares: Float64[np.ndarray, " sub_skills"]
    """Of all steps."""
    dwell: Float64[np.ndarray, " sub_skills"]
    """For how many steps a sub-skill is kept once it is taken, on average; NaN where it never is. The end of an
    episode ends it too."""
    switches: float
    """In an episode, on average."""
    transitions: Int64[np.ndarray, "sub_skills sub_skills"]
    """How often the sub-skill of a row is followed, at the next step, by that of a column."""

    @property
    def followed(self) -> Float64[np.ndarray, "sub_skills sub_skills"]:
        """The transitions as fractions of their row; NaN where nothing follows."""
        total = self.transitions.sum(1, keepdims=True)
        return np.divide(self.transitions, total, out=np.full(self.transitions.shape, np.nan), where=total > 0)


def segments(timeline: Int64[np.ndarray, " steps"]) -> list[Segment]:
    """Return the stretches of equal sub-skills of a timeline, in their order."""
    starts = np.flatnonzero(np.diff(timeline, prepend=-1))
    ends = np.append(starts[1:], len(timeline))
    return [
        Segment(start, end - start, int(timeline[start]))
        for start, end in zip(starts.tolist(), ends.tolist(), strict=False)
    ]


def usage(timelines: Sequence[Int64[np.ndarray, " _"]], sub_skills: int) -> Usage:
    """Return how sub-skills are used in episodes, none of which goes over into another.

    Args:
        timelines: the sub-skill at each step, for each episode.
        sub_skills: K; each is at least 0 and below K.
    """
    steps, kept = np.zeros(sub_skills, np.int64), np.zeros(sub_skills, np.int64)
    transitions = np.zeros((sub_skills, sub_skills), np.int64)
    for timeline in timelines:
        for segment in segments(timeline):
            steps[segment.sub_skill] += segment.steps
            kept[segment.sub_skill] += 1
        np.add.at(transitions, (timeline[:-1], timeline[1:]), 1)
    return Usage(
        episodes=len(timelines),
        steps=int(steps.sum()),
        shares=steps / max(1, steps.sum()),
        dwell=np.divide(steps, kept, out=np.full(sub_skills, np.nan), where=kept > 0),
        switches=float(transitions.sum() - transitions.trace()) / max(1, len(timelines)),
        transitions=transitions,
    )
