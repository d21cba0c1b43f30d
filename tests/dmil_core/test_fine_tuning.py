"""Fine-tuning by Adam on batches."""

import math

import pytest
import torch

from dmil_core.configs import TrainingConfig
from dmil_core.fine_tuning import BATCH, fixed, free, mean_error, on_batches
from dmil_core.losses import Steps
from dmil_core.methods.dmil.adaptation import Hierarchy, adapt_by_adam
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.networks import initialise, mlp, network
from dmil_core.outer_loop import OuterState, OuterStep
from dmil_core.seeding import named_rng
from dmil_core.settings import FineTuning


def steps_of(count: int) -> Steps:
    generator = torch.Generator().manual_seed(3)
    states, actions = torch.randn(count, 4, generator=generator), torch.randn(count, 2, generator=generator)
    return Steps(states, actions, torch.tensor([count]))


def test_it_is_adam_on_random_states_at_a_falling_rate() -> None:
    steps, tuning = steps_of(50), FineTuning(4, 0.02, "adam")
    start = network(initialise("policy", [4, 8, 2], named_rng(0, "initial")), "policy")
    adapted = free(start)
    on_batches([adapted], lambda batch: mean_error(mlp(adapted, batch.states), batch.actions), steps, tuning)
    tensors = [tensor.clone().requires_grad_() for layer in start for tensor in layer]
    first, second = [torch.zeros_like(t) for t in tensors], [torch.zeros_like(t) for t in tensors]
    generator = torch.Generator().manual_seed(0)
    for step in range(4):
        rate = 0.02 * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / 4)))
        drawn = torch.randint(50, (BATCH,), generator=generator)
        hidden = torch.relu(steps.states[drawn] @ tensors[0].T + tensors[1])
        loss = ((hidden @ tensors[2].T + tensors[3] - steps.actions[drawn]) ** 2).sum(1).mean()
        for n, gradient in enumerate(torch.autograd.grad(loss, tensors)):
            first[n] = 0.9 * first[n] + 0.1 * gradient
            second[n] = 0.999 * second[n] + 0.001 * gradient**2
            moved = first[n] / (1 - 0.9 ** (step + 1)) / ((second[n] / (1 - 0.999 ** (step + 1))).sqrt() + 1e-8)
            tensors[n] = (tensors[n] - rate * moved).detach().requires_grad_()
    got = [tensor for layer in fixed(adapted) for tensor in layer]
    for ours, twin in zip(got, tensors, strict=True):
        torch.testing.assert_close(ours, twin, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("adapted", ["both", "high", "low"])
def test_both_levels_go_down_and_what_stays_stays(adapted) -> None:
    config = DmilConfig(sub_skills=2, adapted=adapted)
    draw = named_rng(1, "initial")
    parameters = {**initialise("high", [4, 8, 2], draw), **initialise("low", [4, 8, 2], draw, copies=2)}
    before, steps = Hierarchy.of(parameters), steps_of(60)
    after = adapt_by_adam(before, steps, config, FineTuning(30, 0.01, "adam"))
    again = adapt_by_adam(before, steps, config, FineTuning(30, 0.01, "adam"))
    for level, moves in (("high", adapted != "low"), ("low", adapted != "high")):
        tensors = [{n: t for n, t in h.parameters.items() if n.startswith(level)} for h in (before, after, again)]
        assert any(not torch.equal(tensors[0][n], tensors[1][n]) for n in tensors[0]) is moves
        assert all(torch.equal(tensors[1][n], tensors[2][n]) for n in tensors[1])


def test_the_outer_rate_falls_along_a_cosine() -> None:
    training = TrainingConfig(iterations=10, learning_rate=0.1, schedule="cosine")
    moves = []
    for done in (0, 5, 10, 20):
        state = OuterState.start(torch.zeros(3).numpy())._replace(iteration=done)
        step = OuterStep(state, training)
        step(torch.ones(3).numpy())
        bias = math.sqrt(1 - 0.999 ** (done + 1)) / (1 - 0.9 ** (done + 1))
        moves.append(-float(step.parameters[0]) / (bias * 0.1 / math.sqrt(0.001)))
    assert moves == pytest.approx([0.1, 0.1 * (0.01 + 0.99 / 2), 0.001, 0.001], rel=1e-3)
