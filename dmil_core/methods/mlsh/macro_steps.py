"""Macro-steps, for which a high level picks one sub-skill, and batches of whole trajectories to cut them from."""

from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor


class MacroSteps(NamedTuple):
    """How the steps of trajectories are cut into macro-steps."""

    first: Int[Tensor, " macro_steps"]
    """The step with which each begins."""
    of_step: Int[Tensor, " steps"]
    """The macro-step that each step belongs to."""
    lengths: Int[Tensor, " trajectories"]
    """Macro-steps in each trajectory."""


def macro_steps(lengths: Int[Tensor, " trajectories"], size: int) -> MacroSteps:
    """Cut each trajectory into macro-steps of `size` steps from its start on; its last one may be shorter."""
    starts = lengths.cumsum(0) - lengths
    position = torch.arange(int(lengths.sum())) - starts.repeat_interleave(lengths)
    begins = position % size == 0
    return MacroSteps(begins.nonzero().squeeze(1), begins.cumsum(0) - 1, (lengths + size - 1) // size)


def draw_batch(
    lengths: Int[Tensor, " trajectories"], size: int, generator: torch.Generator
) -> tuple[Int[Tensor, " size"], Int[Tensor, " drawn"]]:
    """Draw whole trajectories in random order, each once before any comes again, the last cut off at `size` steps.

    Returns:
        The steps drawn, and how many of them each drawn trajectory has.
    """
    rounds = -(-size // int(lengths.sum()))
    order = torch.cat([torch.randperm(len(lengths), generator=generator) for _ in range(rounds)])
    before = lengths[order].cumsum(0) - lengths[order]
    order, before = order[before < size], before[before < size]
    counts = torch.minimum(lengths[order], size - before)
    starts = (lengths.cumsum(0) - lengths)[order]
    return (starts - before).repeat_interleave(counts) + torch.arange(size), counts
