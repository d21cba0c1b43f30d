"""Macro-steps and batches of whole trajectories, against counting."""

import numpy as np
import pytest
import torch

from dmil_core.methods.mlsh.macro_steps import draw_batch, macro_steps


@pytest.mark.parametrize("size", [1, 2, 3, 5])
@pytest.mark.parametrize("lengths", [[1], [3], [4], [7, 3, 9, 1, 6], [1, 1, 2], [5, 5]])
def test_macro_steps_never_cross_the_end_of_a_trajectory(lengths: list[int], size: int) -> None:
    first, of_step, counts, step = [], [], [], 0
    for length in lengths:
        before = len(first)
        for position in range(length):
            if position % size == 0:
                first.append(step)
            of_step.append(len(first) - 1)
            step += 1
        counts.append(len(first) - before)
    found = macro_steps(torch.tensor(lengths), size)
    assert (found.first.tolist(), found.of_step.tolist(), found.lengths.tolist()) == (first, of_step, counts)


@pytest.mark.parametrize("size", [1, 4, 9, 17, 40])
@pytest.mark.parametrize("lengths", [[1], [4, 2, 3], [5, 1, 1, 2]])
def test_a_batch_is_whole_trajectories_in_turn_and_one_cut_off(lengths: list[int], size: int) -> None:
    ends = np.cumsum(lengths)
    whole = [list(range(end - length, end)) for end, length in zip(ends, lengths, strict=True)]
    orders = set()
    for seed in range(20):
        index, drawn = draw_batch(torch.tensor(lengths), size, torch.Generator().manual_seed(seed))
        assert len(index) == size
        pieces = [piece.tolist() for piece in index.split(drawn.tolist())]
        trajectories = [next(i for i, steps in enumerate(whole) if piece[0] in steps) for piece in pieces]
        for piece, trajectory in zip(pieces[:-1], trajectories, strict=False):
            assert piece == whole[trajectory]
        assert pieces[-1] == whole[trajectories[-1]][: len(pieces[-1])]
        for turn in range(0, len(trajectories), len(lengths)):
            in_turn = trajectories[turn : turn + len(lengths)]
            assert len(set(in_turn)) == len(in_turn)
        orders.add(tuple(trajectories))
    assert len(orders) > 1 or len(lengths) == 1
