"""The path network: its input, its gradient and its part in a policy."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch

from dmil_core.configs import TrainingConfig
from dmil_core.demonstrations import Demonstration, PathBatch
from dmil_core.errors import UserError
from dmil_core.methods.base import FineTuning, Policy
from dmil_core.methods.behaviour_cloning.config import BehaviourCloningConfig
from dmil_core.methods.behaviour_cloning.method import BehaviourCloning
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.method import Dmil
from dmil_core.methods.path_context import PathContext, combined, path_gradient, sample_path_batch, view_of
from dmil_core.networks import Layer, mlp, network, unflatten, zeros_like
from dmil_core.seeding import named_rng
from tests.dmil_core.carrying import POINTS, demonstrate
from tests.dmil_core.methods.toys import meta_trained

SMALL: dict[str, Any] = {
    "hidden_layers": 2,
    "hidden_units": 48,
    "features": "relative",
    "context": "path",
}
DEMONSTRATIONS = [demonstrate(3, seed) for seed in range(5)]


@pytest.fixture
def dmil() -> Dmil:
    return Dmil.prepared(DmilConfig(**SMALL, trajectories=2, window=8, order="first"), 4, DEMONSTRATIONS, POINTS)


def test_a_demonstration_finds_itself_and_what_it_did(dmil: Dmil) -> None:
    view, one = view_of(dmil), DEMONSTRATIONS[0]
    assert view is not None
    rows = PathContext.of([one], view).rows(one.observations)
    actions = rows[:, 6 * 18 : 6 * 18 + 4]
    same = (actions.numpy() == one.actions).all(1)
    assert same[:30].all(), "before it waits at the goal, each state is its own"
    assert not rows[same, 6 * 18 + 4 + 6].any(), "how far the match is"
    ahead = one.observations[1:31, :3] - one.observations[:30, :3]
    np.testing.assert_allclose(rows[:30, 3:6].numpy(), ahead / 0.1, atol=1e-5)  # one step on, in the hand's own frame


def test_rows_are_the_same_wherever_the_scene_stands(dmil: Dmil) -> None:
    view, (one, other, *_) = view_of(dmil), DEMONSTRATIONS
    assert view is not None
    context, moved = PathContext.of([one], view), other.observations.copy()
    moved[:, [0, 4, 7, 11, 14]] += 0.4
    np.testing.assert_allclose(context.rows(moved), context.rows(other.observations), atol=5e-3)


def test_the_gradient_is_that_of_the_error_at_other_demonstrations(dmil: Dmil) -> None:
    parameters = dmil.initial_parameters(named_rng(0, "initial"))
    batch, view = PathBatch(tuple(DEMONSTRATIONS[:3]), tuple(DEMONSTRATIONS[3:]), 5), view_of(dmil)
    assert view is not None
    found = path_gradient(network(parameters, "path"), batch, view)
    layers = tuple(Layer(*(t.clone().requires_grad_() for t in layer)) for layer in network(parameters, "path"))
    rng = np.random.default_rng(5)
    states = np.concatenate([one.observations for one in batch.query])
    chosen = rng.integers(0, len(states), 64)
    outputs = mlp(layers, PathContext.of(batch.context, view).rows(states[chosen], rng)).view(64, 3, 5)
    weights = torch.stack([outputs[:, k, 4].exp() for k in range(3)], 1)
    mean = sum(weights[:, k, None] * outputs[:, k, :4] for k in range(3)) / weights.sum(1, keepdim=True)
    wanted = torch.from_numpy(np.concatenate([one.actions for one in batch.query])[chosen])
    loss = ((mean - wanted) ** 2).sum(1).mean()
    gradients = torch.autograd.grad(loss, [tensor for layer in layers for tensor in layer])
    _, views = zeros_like(parameters)
    found.add_to(network(views, "path"))
    got = [tensor for layer in network(views, "path") for tensor in layer]
    for ours, twin in zip(got, gradients, strict=True):
        torch.testing.assert_close(ours, twin, rtol=1e-4, atol=1e-6)
    assert found.loss.value.item() == pytest.approx(loss.item(), rel=1e-5)


def test_the_other_networks_learn_as_without_it(dmil: Dmil) -> None:
    """The levels' gradient is the same to the bit, and the path network's is beside it."""
    parameters, batch = dmil.initial_parameters(named_rng(0, "initial")), dmil.sample(
        DEMONSTRATIONS, 0, named_rng(0, "batch")
    )  # fmt: skip
    plain = Dmil.prepared(dmil.config.model_copy(update={"context": "none"}), 4, DEMONSTRATIONS, POINTS)
    levels = {name: tensor for name, tensor in parameters.items() if not name.startswith("path")}
    without = plain.task_gradient(levels, batch)
    result = dmil.task_gradient(parameters, batch)
    assert torch.equal(result.gradient[: len(without.gradient)], without.gradient)
    assert result.gradient[len(without.gradient) :].any()
    assert result.metrics["path_loss"] > 0
    assert list(unflatten(result.gradient, {n: t.shape for n, t in parameters.items()})) == list(parameters)


def test_a_set_never_sees_itself() -> None:
    for seed in range(20):
        batch = sample_path_batch(DEMONSTRATIONS, named_rng(seed, "draw"))
        ids = [one.id for one in batch.context]
        assert len(ids) in (1, 3)
        assert not set(ids) & {one.id for one in batch.query}
        assert batch.query


def test_no_episode_at_all_is_acted_in_too(dmil: Dmil) -> None:
    policy = dmil.adapt(dmil.initial_parameters(named_rng(0, "initial")), DEMONSTRATIONS[:3], FineTuning(1, 0.1))
    decision = policy.act(DEMONSTRATIONS[0].observations[:0], policy.start(0))
    assert decision.actions.shape == (0, 4)


def test_equal_demonstrations_share_the_weight() -> None:
    outputs = torch.tensor([[1.0, 2.0, 0.0], [3.0, 4.0, 0.0], [5.0, 0.0, 90.0], [7.0, 8.0, 0.0]])
    torch.testing.assert_close(combined(outputs, 2), torch.tensor([[2.0, 3.0], [5.0, 0.0]]))


@pytest.mark.usefixtures("unchecked")
def test_a_new_task_is_imitated_from_one_demonstration_without_a_step() -> None:
    """On which side to pass is seen in the demonstration alone."""
    sets: dict[str, Sequence[Demonstration]] = {
        f"task-{task}": [demonstrate(task, seed) for seed in range(6)] for task in (0, 2, 4, 6)
    }
    everything = [one for task in sets.values() for one in task]
    method = BehaviourCloning.prepared(
        BehaviourCloningConfig(**SMALL, trajectories=2, context_share=1.0), 4, everything, POINTS
    )
    training = TrainingConfig(iterations=40, tasks_per_iteration=4, learning_rate=3e-3, schedule="cosine")
    parameters = meta_trained(method, sets, training)
    own, another = (method.adapt(parameters, [demonstrate(task, 50)], FineTuning(0, 0.1)) for task in (3, 7))
    wanted = demonstrate(3, 51)
    assert _error(own, wanted) < 0.7 * _error(another, wanted)


def _error(policy: Policy, demonstration: Demonstration) -> float:
    decision = policy.act(demonstration.observations, policy.start(len(demonstration)))
    return float(np.square(decision.actions - demonstration.actions).sum(1).mean())


def test_without_points_there_is_no_path() -> None:
    method = Dmil.prepared(DmilConfig(context="path", hidden_units=8), 4, DEMONSTRATIONS)
    with pytest.raises(UserError, match=r"method\.context: got path .* wanted suite\.points"):
        method.initial_parameters(named_rng(0, "initial"))
