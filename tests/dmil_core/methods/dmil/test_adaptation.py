"""The dual inner loop: one step by hand, many against a plain reference, and what it must leave alone."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from benchmarks.masked_reference import MaskedReference
from dmil_core.losses import Steps, bank_errors, sub_skill_labels
from dmil_core.methods.dmil.adaptation import (
    Hierarchy,
    InnerStep,
    act,
    adapt,
    choose,
    high_level_gradient,
    inner_loop,
    sub_skill_gradients,
)
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.networks import BLOCK, Network, Parameters, flatten

CONFIG = DmilConfig(inner_learning_rate=0.5, continuity_weight=0.3)


@pytest.fixture
def parameters(make_parameters) -> Parameters:
    return make_parameters(4, sub_skills=3)


@pytest.fixture
def hierarchy(parameters) -> Hierarchy:
    return Hierarchy.of(parameters)


@pytest.fixture
def support(make_steps) -> tuple[Steps, Steps]:
    return make_steps(1, [5, 1, 7]), make_steps(2, [4, 6])


def sub_skill(parameters: Parameters, k: int) -> list[torch.Tensor]:
    return [tensor[k] for name, tensor in parameters.items() if name.startswith("low.")]


def tensors(*networks: Network) -> list[torch.Tensor]:
    return [tensor for network in networks for layer in network for tensor in layer]


def flat(hierarchy: Hierarchy) -> torch.Tensor:
    return torch.cat([tensor.flatten() for tensor in tensors(hierarchy.high, *hierarchy.low)])


def losses(step: InnerStep) -> list[torch.Tensor]:
    return [step.high.loss.value, *(step.low[k].loss.value for k in sorted(step.low))]


class Reference:
    """The dual inner loop in plain autograd on whole banks, with masks; every label is worked out anew."""

    def __init__(self, parameters: Parameters, learning_rate: float, continuity_weight: float) -> None:
        self.tensors = {name: tensor.detach().clone().requires_grad_() for name, tensor in parameters.items()}
        self.learning_rate, self.continuity_weight = learning_rate, continuity_weight

    def __call__(self, states: torch.Tensor, k: int | None = None) -> torch.Tensor:
        own = [
            tensor if k is None else tensor[k]
            for name, tensor in self.tensors.items()
            if name.startswith("high" if k is None else "low")
        ]
        for weight, bias in zip(own[:-2:2], own[1:-2:2], strict=True):
            states = functional.relu(functional.linear(states, weight, bias))
        return functional.linear(states, own[-2], own[-1])

    def errors(self, steps: Steps) -> torch.Tensor:
        skills = range(len(self.tensors["low.0.bias"]))
        return torch.stack([((self(steps.states, k) - steps.actions) ** 2).sum(1) for k in skills])

    def descend(self, prefix: str, loss: torch.Tensor) -> float:
        names = [name for name in self.tensors if name.startswith(prefix)]
        gradients = torch.autograd.grad(loss, [self.tensors[name] for name in names])
        for name, gradient in zip(names, gradients, strict=True):
            self.tensors[name] = (self.tensors[name].detach() - self.learning_rate * gradient).requires_grad_()
        return loss.item()

    def step(self, one: Steps, two: Steps) -> tuple[list[int], float, list[int], float]:
        """Take a step and return the labels, L_h, the choices and Σ_k L_BC."""
        labels = self.errors(one).argmin(0)
        log_p = functional.log_softmax(self(one.states), 1)
        switches = [(1 - (p[:-1] * p[1:]).sum(1)).sum() / len(p) for p in log_p.exp().split(one.lengths.tolist())]
        loss = functional.nll_loss(log_p, labels) + self.continuity_weight * sum(switches) / len(switches)
        high = self.descend("high", loss)
        chosen = self(two.states).argmax(1)
        errors = self.errors(two)
        means = [errors[k][chosen == k].mean() for k in range(len(errors)) if (chosen == k).any()]
        return labels.tolist(), high, chosen.tolist(), self.descend("low", sum(means, torch.zeros(()).double()))


@pytest.mark.parametrize("order", [1, -1], ids=["high first", "low first"])
@pytest.mark.parametrize("hidden", [(), (8,), (5, 6, 7)], ids=lambda hidden: f"{len(hidden)} hidden")
@pytest.mark.parametrize("sub_skills", [1, 3])
def test_a_hierarchy_gives_its_parameters_back(make_parameters, sub_skills: int, hidden, order: int) -> None:
    drawn = make_parameters(0, sub_skills, hidden)
    parameters = dict(sorted(drawn.items(), key=lambda entry: entry[0].startswith("low"), reverse=order < 0))
    assert next(iter(parameters)).startswith("low") == (order < 0)
    hierarchy = Hierarchy.of(parameters)
    assert len(hierarchy.low) == sub_skills
    assert len(hierarchy.high) == len(hierarchy.low[0]) == len(hidden) + 1
    back = hierarchy.parameters
    assert set(back) == set(parameters)
    assert all(torch.equal(back[name], tensor) for name, tensor in parameters.items())
    assert list(back) == list(drawn), "high level first, layer by layer, weight before bias"


def test_a_hierarchy_is_made_of_views(parameters, hierarchy) -> None:
    for tensor in tensors(hierarchy.high, hierarchy.low[1]):
        tensor.zero_()
    for name, tensor in parameters.items():
        assert not (tensor if name.startswith("high") else tensor[1]).any()
    assert all(tensor[[0, 2]].any() for name, tensor in parameters.items() if name.startswith("low"))


@pytest.mark.parametrize("requires_grad", [False, True])
@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize("steps", [1, 3])
def test_inputs_stay_bit_for_bit(parameters, support, steps: int, keep: bool, requires_grad: bool) -> None:
    for tensor in parameters.values():
        tensor.requires_grad_(requires_grad)
    inputs = [*parameters.values(), *support[0], *support[1]]
    before = [tensor.detach().clone() for tensor in inputs]
    path = list(itertools.islice(inner_loop(Hierarchy.of(parameters), *support, config=CONFIG, keep=keep), steps))
    adapt(Hierarchy.of(parameters), *support, config=CONFIG, steps=steps)
    assert all(map(torch.equal, inputs, before))
    assert all(tensor.grad is None for tensor in inputs)
    assert not torch.equal(flat(path[-1].adapted), flat(Hierarchy.of(parameters)))


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), sub_skills=st.integers(1, 6), keep=st.booleans())
def test_the_start_stays_whenever_a_sub_skill_is_first_chosen(
    make_parameters, make_steps, seed: int, sub_skills: int, keep: bool
) -> None:
    parameters = make_parameters(seed, sub_skills)
    before, support = flatten(parameters), make_steps(seed, [3, 1])
    loop = inner_loop(Hierarchy.of(parameters), support, support, config=CONFIG, keep=keep)
    for _ in itertools.islice(loop, 5):
        assert torch.equal(flatten(parameters), before)


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_one_loss_of_each_level_for_each_step(parameters, hierarchy, support, steps: int) -> None:
    adapted = adapt(hierarchy, *support, config=CONFIG, steps=steps)
    assert list(adapted.parameters) == list(parameters)
    assert not torch.equal(flatten(adapted.parameters), flatten(parameters))


def test_no_step_changes_nothing(parameters, hierarchy, support) -> None:
    adapted = adapt(hierarchy, *support, config=CONFIG, steps=0)
    assert torch.equal(flatten(adapted.parameters), flatten(parameters))


def test_an_adaptation_carries_no_graph(parameters, support) -> None:
    origin = Hierarchy.of({name: tensor.requires_grad_() for name, tensor in parameters.items()})
    adapted = adapt(origin, *support, config=CONFIG, steps=2)
    moved = [k for k in range(3) if not torch.equal(adapted.low[k][0].weight, origin.low[k][0].weight)]
    assert moved
    assert not any(tensor.requires_grad for tensor in tensors(adapted.high, *(adapted.low[k] for k in moved)))


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), sub_skills=st.integers(1, 5))
def test_keeping_the_networks_changes_no_bit(make_parameters, make_steps, seed: int, sub_skills: int) -> None:
    hierarchy = Hierarchy.of(make_parameters(seed, sub_skills, dtype=torch.float32))
    support = make_steps(seed, [2, 4], torch.float32), make_steps(seed + 1, [5], torch.float32)
    config = DmilConfig(inner_learning_rate=0.1, continuity_weight=0.3)
    kept, overwritten = (inner_loop(hierarchy, *support, config=config, keep=keep) for keep in (True, False))
    for one, other in itertools.islice(zip(kept, overwritten, strict=False), 5):
        assert one.low.keys() == other.low.keys()
        assert all(map(torch.equal, losses(one), losses(other)))
        assert torch.equal(flat(one.adapted), flat(other.adapted))
        assert flat(one.adapted).isfinite().all()


def test_kept_gradients_hold_the_networks_of_their_own_step(hierarchy, support) -> None:
    path: list[InnerStep] = []
    arrived = [flat(hierarchy)]
    for step in itertools.islice(inner_loop(hierarchy, *support, config=CONFIG, keep=True), 5):
        path.append(step)
        arrived.append(flat(step.adapted))
    assert not any(torch.equal(*two) for two in itertools.pairwise(arrived))
    for before, step, start, end in zip(
        [hierarchy, *(s.adapted for s in path)], path, arrived, arrived[1:], strict=False
    ):
        assert step.high.network is before.high
        assert step.low
        assert all(step.low[k].network is before.low[k] for k in step.low)
        assert torch.equal(flat(before), start)
        assert torch.equal(flat(step.adapted), end)


def test_without_keeping_the_networks_are_overwritten(hierarchy, support) -> None:
    """What makes it fast: from its second step on a network's tensors are the same ones."""
    path = list(itertools.islice(inner_loop(hierarchy, *support, config=CONFIG), 6))
    assert len({id(step.adapted.high[0].weight) for step in path}) == 1
    stepped = [k for k in range(3) if sum(k in step.low for step in path) > 1]
    assert stepped
    for k in stepped:
        assert len({id(step.adapted.low[k][0].weight) for step in path if k in step.low}) == 1


@pytest.mark.parametrize("continuity_weight", [0.0, 0.3])
def test_one_step_is_that_of_algorithm_1(parameters, hierarchy, support, plain_mlp, continuity_weight: float) -> None:
    """The labels of τ1 come from the sub-skills before the step, the choice on τ2 from the high level after it."""
    first, second = support
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in parameters.items()}
    high = [tensor for name, tensor in leaves.items() if name.startswith("high")]
    low = [tensor for name, tensor in leaves.items() if name.startswith("low")]

    def run(own: list[torch.Tensor], states: torch.Tensor) -> torch.Tensor:
        return plain_mlp(tuple(zip(own[::2], own[1::2], strict=True)), states)

    def errors(k: int, steps: Steps) -> torch.Tensor:
        return ((run([tensor[k] for tensor in low], steps.states) - steps.actions) ** 2).sum(1)

    labels = torch.stack([errors(k, first) for k in range(3)]).argmin(0)
    logits = run(high, first.states)
    high_loss = functional.cross_entropy(logits, labels)
    for p in logits.softmax(1).split(first.lengths.tolist()):
        switches = sum(1 - p[t] @ p[t + 1] for t in range(len(p) - 1))
        high_loss = high_loss + continuity_weight * switches / len(p) / len(first.lengths)
    moved = [t.detach() - 0.5 * g for t, g in zip(high, torch.autograd.grad(high_loss, high), strict=True)]

    chosen = run(moved, second.states).argmax(1)
    assert not torch.equal(chosen, run(high, second.states).argmax(1)), "the order of the two steps must matter here"
    low_loss = sum(
        (errors(k, second)[chosen == k].mean() for k in range(3) if (chosen == k).any()), torch.zeros(()).double()
    )
    moved += [t.detach() - 0.5 * g for t, g in zip(low, torch.autograd.grad(low_loss, low), strict=True)]

    config = DmilConfig(inner_learning_rate=0.5, continuity_weight=continuity_weight)
    adapted = adapt(hierarchy, first, second, config, steps=1)
    expected = dict(zip(parameters, moved, strict=True))
    torch.testing.assert_close(adapted.parameters, expected, rtol=1e-12, atol=1e-12)
    step = next(inner_loop(hierarchy, first, second, config))
    assert step.high.loss.value.item() == pytest.approx(high_loss.item())
    assert sum(low.loss.value.item() for low in step.low.values()) == pytest.approx(low_loss.item())


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize("sub_skills", [1, 2, 4, 8])
def test_many_steps_equal_a_reference_that_labels_everything_anew(
    make_parameters, make_steps, sub_skills: int, keep: bool
) -> None:
    parameters, count = make_parameters(1, sub_skills), 12
    support = make_steps(1, [5, 1, 7]), make_steps(2, [3, 4])
    reference, seen, used = Reference(parameters, CONFIG.inner_learning_rate, CONFIG.continuity_weight), [], []
    for step in itertools.islice(inner_loop(Hierarchy.of(parameters), *support, config=CONFIG, keep=keep), count):
        labels, high, chosen, low = reference.step(*support)
        assert step.high.loss.value.item() == pytest.approx(high, rel=1e-9, abs=1e-12)
        assert set(step.low) == set(chosen)
        assert sum(of_low.loss.value.item() for of_low in step.low.values()) == pytest.approx(low, rel=1e-9)
        expected = {name: tensor.detach() for name, tensor in reference.tensors.items()}
        torch.testing.assert_close(step.adapted.parameters, expected, rtol=1e-9, atol=1e-11)
        seen.append(labels)
        used.append(set(chosen))
    if sub_skills > 1:
        assert len(set(map(tuple, seen))) > 1, "labels must change on the way"
    if sub_skills > 2:
        assert any(not (set(labels) <= skills) for labels, skills in zip(seen[1:], used, strict=False)), (
            "a label must come from a sub-skill that the step before left alone"
        )
    adapted = adapt(Hierarchy.of(parameters), *support, config=CONFIG, steps=count)
    expected = {name: tensor.detach() for name, tensor in reference.tensors.items()}
    torch.testing.assert_close(adapted.parameters, expected, rtol=1e-9, atol=1e-11)


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), sub_skills=st.integers(1, 6))
def test_labels_follow_the_sub_skills_of_their_step(make_parameters, make_steps, seed: int, sub_skills: int) -> None:
    """Of sub-skills that come and go: each step's L_h is that of labels from scratch."""
    parameters, support = make_parameters(seed, sub_skills), (make_steps(seed, [4, 1]), make_steps(seed + 1, [3]))
    reference = Reference(parameters, CONFIG.inner_learning_rate, CONFIG.continuity_weight)
    for step in itertools.islice(inner_loop(Hierarchy.of(parameters), *support, config=CONFIG), 4):
        _, high, chosen, low = reference.step(*support)
        assert step.high.loss.value.item() == pytest.approx(high, rel=1e-7, abs=1e-9)
        assert set(step.low) == set(chosen)
        assert sum(of_low.loss.value.item() for of_low in step.low.values()) == pytest.approx(low, rel=1e-7)


def test_label_and_choice_by_plain_loops(hierarchy, support, plain_mlp) -> None:
    steps = support[0]
    errors = torch.stack([(plain_mlp(own, steps.states) - steps.actions).norm(dim=-1) for own in hierarchy.low])
    labels = sub_skill_labels(bank_errors(hierarchy.low, steps))
    assert labels.tolist() == [int(column.argmin()) for column in errors.T]
    assert len(set(labels.tolist())) > 1
    logits = plain_mlp(hierarchy.high, steps.states)
    assert choose(hierarchy.high, steps.states).tolist() == [int(row.argmax()) for row in logits]


@pytest.mark.parametrize("sub_skills", [1, 3, 5])
@pytest.mark.parametrize("count", [1, 2, 20, 2 * BLOCK + 3])
def test_each_state_gets_the_action_of_its_sub_skill(
    make_parameters, make_steps, plain_mlp, count: int, sub_skills: int
) -> None:
    hierarchy, states = Hierarchy.of(make_parameters(1, sub_skills)), make_steps(5, [count]).states
    before = states.clone()
    actions, chosen = act(hierarchy, states)
    assert chosen.tolist() == plain_mlp(hierarchy.high, states).argmax(1).tolist()
    assert len(set(chosen.tolist())) > (count >= 20 and sub_skills > 1)
    expected = torch.stack([plain_mlp(hierarchy.low[k], s) for k, s in zip(chosen.tolist(), states, strict=True)])
    torch.testing.assert_close(actions, expected, rtol=1e-12, atol=1e-14)
    assert torch.equal(states, before)


@pytest.mark.parametrize("only", [[2], [0, 2], [1]], ids=str)
def test_unused_sub_skills_do_not_disturb_an_action(make_parameters, make_steps, plain_mlp, only: list[int]) -> None:
    parameters, states = make_parameters(2, 3), make_steps(5, [20]).states
    parameters["high.2.bias"][only] += 50
    hierarchy = Hierarchy.of(parameters)
    actions, chosen = act(hierarchy, states)
    assert set(chosen.tolist()) == set(only)
    expected = torch.stack([plain_mlp(hierarchy.low[k], s) for k, s in zip(chosen.tolist(), states, strict=True)])
    torch.testing.assert_close(actions, expected, rtol=1e-12, atol=1e-14)


def test_acting_carries_no_graph(parameters, support) -> None:
    hierarchy = Hierarchy.of({name: tensor.requires_grad_() for name, tensor in parameters.items()})
    assert not act(hierarchy, support[0].states)[0].requires_grad


@pytest.mark.parametrize("continuity_weight", [0.0, 0.7])
def test_the_high_level_goes_down_its_loss(hierarchy, support, plain_mlp, gradient_of, continuity_weight) -> None:
    steps, leaves = support[0], [tensor.clone().requires_grad_() for tensor in tensors(hierarchy.high)]
    labels = torch.tensor([0, 2, 1, 1, 0, 0, 2, 2, 1, 0, 1, 2, 2])
    p = plain_mlp(tuple(zip(leaves[::2], leaves[1::2], strict=True)), steps.states).softmax(1)
    switches = [sum(1 - own[t] @ own[t + 1] for t in range(len(own) - 1)) / len(own) for own in p.split([5, 1, 7])]
    loss = -p[torch.arange(13), labels].log().mean() + continuity_weight * sum(switches) / 3
    got = high_level_gradient(hierarchy.high, steps, labels, DmilConfig(continuity_weight=continuity_weight))
    torch.testing.assert_close(got.loss.value, loss.detach(), rtol=1e-12, atol=0)
    gradient = list(torch.autograd.grad(loss, leaves))
    torch.testing.assert_close(tensors(gradient_of(got)), gradient, rtol=1e-10, atol=1e-13)


def test_each_sub_skill_goes_down_the_average_over_its_own_states(hierarchy, support, plain_mlp, gradient_of) -> None:
    """One without a state has no gradient: no gradient, and no mean of nothing."""
    steps, chosen = support[1], torch.tensor([0, 2, 2, 0, 0, 0, 2, 2, 2, 2])
    gradients = sub_skill_gradients(hierarchy.low, steps, chosen)
    assert set(gradients) == {0, 2}
    for k, got in gradients.items():
        leaves = [tensor.clone().requires_grad_() for tensor in tensors(hierarchy.low[k])]
        predictions = plain_mlp(tuple(zip(leaves[::2], leaves[1::2], strict=True)), steps.states)
        loss = (predictions - steps.actions).square().sum(-1)[chosen == k].mean()
        torch.testing.assert_close(got.loss.value, loss.detach(), rtol=1e-12, atol=0)
        gradient = list(torch.autograd.grad(loss, leaves))
        torch.testing.assert_close(tensors(gradient_of(got)), gradient, rtol=1e-10, atol=1e-13)


def test_a_sub_skill_that_is_never_chosen_stays(parameters, support) -> None:
    biased = {**parameters, "high.2.bias": torch.tensor([0.0, 50.0, 0.0]).double()}
    config = DmilConfig(inner_learning_rate=0.01, continuity_weight=0.0)
    adapted = adapt(Hierarchy.of(biased), *support, config=config, steps=2).parameters
    for k in (0, 2):
        assert all(map(torch.equal, sub_skill(adapted, k), sub_skill(parameters, k)))
    assert not any(map(torch.equal, sub_skill(adapted, 1), sub_skill(parameters, 1)))


def test_acting_in_no_states_is_no_action(parameters, support) -> None:
    actions, chosen = act(Hierarchy.of(parameters), support[0].states[:0])
    assert actions.shape == (0, support[0].actions.shape[1])
    assert len(chosen) == 0


@pytest.mark.parametrize(("adapted", "stays"), [("high", "low"), ("low", "high")])
def test_a_level_that_is_not_adapted_stays_bit_for_bit(parameters, support, adapted: str, stays: str) -> None:
    config = CONFIG.model_copy(update={"adapted": adapted})
    after = adapt(Hierarchy.of(parameters), *support, config=config, steps=3).parameters
    for name, tensor in parameters.items():
        if name.startswith(stays):
            assert torch.equal(after[name], tensor)
    assert any(not torch.equal(after[name], tensor) for name, tensor in parameters.items() if name.startswith(adapted))


@pytest.mark.parametrize("em", ["soft", "reference_soft"])
@pytest.mark.parametrize("adapted", ["both", "high", "low"])
def test_variants_adapt_as_the_plain_reference(make_parameters, make_steps, adapted: str, em: str) -> None:
    parameters, support = make_parameters(2, 3), make_steps(1, [5, 1, 7])
    config = DmilConfig.model_validate({"inner_learning_rate": 0.1, "adapted": adapted, "em": em})
    got = adapt(Hierarchy.of(parameters), support, support, config, steps=4).parameters
    wanted = MaskedReference(config).adapt(parameters, support, 4, 0.1)
    torch.testing.assert_close(got, {name: wanted[name].detach() for name in got}, rtol=1e-10, atol=1e-12)
