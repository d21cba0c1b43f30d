"""The tree that gradients are added in, and how it is cut into blocks: no cut changes a bit."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dmil_core.configs import TrainingConfig
from dmil_core.outer_loop import BLOCKS_PER_WORKER, OuterState, OuterStep, add, blocks, tasks_of, tree_sum


def gradients_of(seed: int, count: int) -> list[np.ndarray]:
    """Draw vectors whose sum depends on the order of addition: magnitudes from 1e-4 to 1e4."""
    rng = np.random.default_rng(seed)
    return list((rng.normal(size=(count, 50)) * 10.0 ** rng.integers(-4, 5, (count, 50))).astype(np.float32))


def reduce(gradients: list[np.ndarray], fan_in: int) -> np.ndarray:
    while len(gradients) > 1:
        gradients = [add(gradients[first : first + fan_in]) for first in range(0, len(gradients), fan_in)]
    return gradients[0]


@given(seed=st.integers(0, 2**31), slots=st.integers(1, 40), tasks=st.integers(1, 12))
def test_every_task_comes_once_before_any_comes_again(seed: int, slots: int, tasks: int):
    names = [str(task) for task in range(tasks)]
    batch = tasks_of(3, names, seed, slots)
    assert len(batch) == slots
    rounds = [batch[first : first + tasks] for first in range(0, slots, tasks)]
    assert all(len(set(each)) == len(each) for each in rounds)
    assert batch == tasks_of(3, names, seed, slots)


@given(seed=st.integers(0, 2**31), count=st.integers(1, 40), fan_in=st.sampled_from([2, 4, 8, 16]))
def test_any_fan_in_that_is_a_power_of_two_gives_the_bits_of_the_tree(seed: int, count: int, fan_in: int):
    gradients = gradients_of(seed, count)
    wanted = tree_sum([torch.tensor(gradient) for gradient in gradients]).numpy()
    assert reduce(gradients, fan_in).tobytes() == wanted.tobytes()


def test_a_fan_in_that_is_no_power_of_two_does_not():
    """Else the test above would show nothing."""
    gradients = gradients_of(0, 9)
    assert not np.array_equal(reduce(gradients, 3), reduce(gradients, 2))


@given(
    seed=st.integers(0, 2**31), count=st.integers(1, 200), workers=st.integers(1, 5), fan_in=st.sampled_from([2, 4, 8])
)
def test_sums_of_blocks_add_up_to_the_bits_of_the_tree(seed: int, count: int, workers: int, fan_in: int):
    gradients = gradients_of(seed, count)
    wanted = reduce(gradients, 2)
    sums = [
        add([gradients[index] for group in block for index in group])
        for block in blocks([range(index, index + 1) for index in range(count)], workers)
    ]
    assert reduce(sums, fan_in).tobytes() == wanted.tobytes()


@given(count=st.integers(1, 200), workers=st.integers(1, 12))
def test_blocks_are_large_but_leave_every_worker_some(count: int, workers: int):
    groups = [range(2 * index, 2 * index + 2) for index in range(count)]
    cut = blocks(groups, workers)
    assert list(itertools.chain(*cut)) == groups
    if workers == 1:
        assert len(cut) == 1
    else:
        assert len(cut) >= min(BLOCKS_PER_WORKER * workers, count)
        assert len(cut[0]) == 1 or len(cut) < 2 * BLOCKS_PER_WORKER * workers + 1


@pytest.mark.parametrize("count", [1, 2, 5])
def test_adding_leaves_shared_memory_as_it_is(count: int):
    gradients = gradients_of(1, count)
    for gradient in gradients:
        gradient.flags.writeable = False
    add(gradients)
    assert all(map(np.array_equal, gradients, gradients_of(1, count)))


def test_the_way_to_the_mean_is_the_mean_of_the_ways():
    start = OuterState(3, *(gradients_of(seed, 1)[0] for seed in (1, 2, 3)))
    ways = gradients_of(4, 3)
    training = TrainingConfig(outer_step="average", learning_rate=0.5, tasks_per_iteration=3)
    step = OuterStep(start, training)
    total = add(ways)
    assert step(total) == pytest.approx(float(np.linalg.norm(total / 3)), rel=1e-5)
    np.testing.assert_allclose(step.state.parameters, start.parameters - 0.5 * np.mean(ways, axis=0), rtol=1e-3)
    assert step.state.iteration == 4
    assert np.array_equal(step.state.first_moment, start.first_moment)
    assert np.isnan(step(np.full_like(total, np.nan)))
    assert step.state.iteration == 4


def test_a_step_of_adam_is_that_of_torch():
    start = OuterState.start(gradients_of(1, 1)[0])
    training = TrainingConfig(learning_rate=0.1, gradient_clip=1.0)
    step = OuterStep(start, training)
    reference = torch.nn.Parameter(torch.tensor(start.parameters))
    adam = torch.optim.Adam([reference], lr=0.1)
    for gradient in gradients_of(2, 5):
        step(gradient)
        reference.grad = torch.tensor(gradient)
        torch.nn.utils.clip_grad_norm_([reference], 1.0)
        adam.step()
    np.testing.assert_allclose(step.state.parameters, reference.detach().numpy(), rtol=1e-5)
