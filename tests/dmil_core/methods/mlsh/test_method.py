"""MLSH: what a slot learns from its task and hands back, and that the sub-skills serve a new one."""

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from dmil_core.configs import ExperimentConfig, TrainingConfig
from dmil_core.demonstrations import DemonstrationError
from dmil_core.losses import Steps
from dmil_core.methods.base import FineTuning, MetaLearner
from dmil_core.methods.mlsh import learning as mlsh
from dmil_core.methods.mlsh import method as mlsh_method
from dmil_core.methods.mlsh.config import MlshConfig
from dmil_core.methods.mlsh.macro_steps import draw_batch, macro_steps
from dmil_core.methods.mlsh.method import Mlsh
from dmil_core.methods.ppo import clipped_surrogate
from dmil_core.networks import flatten, mlp, unflatten
from dmil_core.seeding import named_rng
from tests.dmil_core.methods.conftest import SMALL_MLSH
from tests.dmil_core.methods.toys import act_along, meta_trained, record, recovered, training_sets


@pytest.fixture
def method(demonstrations) -> Mlsh:
    return Mlsh.prepared(SMALL_MLSH, 3, demonstrations)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_it_is_a_meta_learner(method) -> None:
    assert isinstance(method, MetaLearner)


def test_initial_parameters_are_the_bank_with_a_value_each(method) -> None:
    shapes = {name: tuple(tensor.shape) for name, tensor in method.initial_parameters(named_rng(0, "initial")).items()}
    assert shapes == {
        "low.0.weight": (3, 8, 4),
        "low.0.bias": (3, 8),
        "low.1.weight": (3, 8, 8),
        "low.1.bias": (3, 8),
        "low.2.weight": (3, 4, 8),
        "low.2.bias": (3, 4),
    }


@pytest.mark.parametrize("size", ["paper", "quick", "smoke"])
def test_the_sizes_are_settings(size: str) -> None:
    own = MlshConfig.presets[size]
    config = MlshConfig.model_validate(own.get("method", {}))
    training = TrainingConfig.model_validate(own["training"])
    assert (training.outer_step, training.learning_rate, training.gradient_clip) == ("average", 1.0, None)
    sections = set(ExperimentConfig.model_fields)
    assert set(own) <= sections
    if size == "paper":
        assert config == MlshConfig()


def test_a_sample_is_of_different_demonstrations(method, demonstrations) -> None:
    one, two = (method.sample(demonstrations, 0, named_rng(0, "batch", slot)) for slot in range(2))
    assert len(one.ids) == len(set(one.ids)) == SMALL_MLSH.trajectories
    assert one.ids != two.ids
    assert one.seed != two.seed
    assert len(method.sample(demonstrations[:2], 0, named_rng(0, "batch")).ids) == 2
    with pytest.raises(DemonstrationError, match="got none"):
        method.sample([], 0, named_rng(0, "batch"))


def test_a_task_gradient_is_the_same_bits_again_and_leaves_the_parameters(method, demonstrations) -> None:
    parameters = method.initial_parameters(named_rng(0, "initial"))
    before, batch = flatten(parameters), method.sample(demonstrations, 0, named_rng(0, "batch"))
    torch.manual_seed(0)
    one = method.task_gradient(parameters, batch)
    torch.manual_seed(1)
    two = method.task_gradient(parameters, batch)
    assert torch.equal(one.gradient, two.gradient)
    assert one.metrics == two.metrics
    assert torch.equal(flatten(parameters), before)
    other = method.task_gradient(parameters, method.sample(demonstrations, 0, named_rng(1, "batch")))
    assert not torch.equal(one.gradient, other.gradient)


def test_parameters_minus_the_gradient_are_where_the_slot_arrived(demonstrations, monkeypatch) -> None:
    """One joint update is one step of Adam from zero moments: each number goes by the learning rate, or not at all."""
    method = Mlsh.prepared(SMALL_MLSH.model_copy(update={"joint_updates": 1}), 3, demonstrations)
    parameters = method.initial_parameters(named_rng(0, "initial"))
    learned = []

    class Watched(mlsh.Learner):
        def descend(self, loss) -> None:
            super().descend(loss)
            if "low.0.weight" in self.parameters:
                learned.append(flatten({n: t.detach() for n, t in self.parameters.items()}))

    monkeypatch.setattr(mlsh_method, "Learner", Watched)
    gradient = method.task_gradient(parameters, method.sample(demonstrations, 0, named_rng(0, "batch"))).gradient
    assert len(learned) == 1
    torch.testing.assert_close(flatten(parameters) - gradient, learned[-1], rtol=0, atol=1e-6)
    assert gradient.abs().max() <= SMALL_MLSH.sub_skill_learning_rate * 1.01
    assert gradient.abs().max() >= SMALL_MLSH.sub_skill_learning_rate * 0.99


def test_the_metrics_are_those_of_the_policy_of_the_slot(method, demonstrations) -> None:
    parameters = method.initial_parameters(named_rng(0, "initial"))
    found = method.task_gradient(parameters, method.sample(demonstrations, 0, named_rng(0, "batch")))
    metrics = found.metrics
    assert sum(metrics[f"sub_skill_share/{k}"] for k in range(3)) == pytest.approx(1)
    assert 0 <= metrics["loss_of_best"] <= metrics["loss"]
    assert 0 <= metrics["agreement"] <= 1
    assert torch.isfinite(found.gradient).all()


@pytest.mark.parametrize("updates", [1, 3, 4, 7])
def test_as_many_updates_as_asked_in_passes_over_each_batch(method, demonstrations, monkeypatch, updates: int) -> None:
    taken, batches = [], []

    class Counted(mlsh.Learner):
        def descend(self, loss) -> None:
            taken.append(loss.item())
            super().descend(loss)

    def counted(*arguments):
        batches.append(len(taken))
        return draw_batch(*arguments)

    monkeypatch.setattr(mlsh_method, "Learner", Counted)
    monkeypatch.setattr(mlsh, "draw_batch", counted)
    method.adapt(method.initial_parameters(named_rng(0, "initial")), demonstrations[:1], FineTuning(updates, 1e-3))
    assert len(taken) == updates
    assert batches == list(range(0, updates, SMALL_MLSH.passes))


def test_at_a_batchs_first_update_the_loss_of_the_high_level_is_plain_policy_gradient(demonstrations) -> None:
    """ρ = 1: the gradient is that of −mean A log π(z) + c mean (V − R)², R_m = −Σ of the errors in m, scaled."""
    config = SMALL_MLSH.model_copy(update={"value_weight": 0.7})
    method = Mlsh.prepared(config, 3, demonstrations)
    steps = Steps.of(demonstrations[:3], method.normalise)  # 19 steps: macro-steps of 3, 3, 1 | 3 | 3, 3, 3
    task = mlsh.TaskLearning(steps, config, generator())
    high = method._fresh_high(np.random.default_rng(0), 1e-3)
    picks = task._pick(high, steps.states, steps.lengths)
    errors = torch.rand(19, generator=generator(1))
    outcome = task._outcome_of_picks(picks, errors)
    bounds = [0, 3, 6, 7, 10, 13, 16, 19]
    returns = torch.stack([-errors[a:b].sum() for a, b in itertools.pairwise(bounds)])
    returns = returns / returns.square().mean().sqrt()
    outputs = mlp(mlsh.network(high.parameters, "high"), steps.states[bounds[:-1]])
    raw = (returns - outputs[:, -1]).detach()
    advantages = (raw - raw.mean()) / raw.std(correction=0)
    log_probabilities = outputs[:, :-1].log_softmax(-1)[range(7), picks.chosen]
    plain = -(advantages * log_probabilities).mean() + 0.7 * (outputs[:, -1] - returns).square().mean()
    leaves = list(high.parameters.values())
    expected = torch.autograd.grad(plain, leaves)
    found = torch.autograd.grad(task._high_loss(high, picks, outcome), leaves)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)


def test_a_joint_update_goes_down_the_policy_gradients_of_both_levels(demonstrations, plain_mlp) -> None:
    """Against plain autograd on the same draws, each step run on all sub-skills and picked from."""
    config = SMALL_MLSH.model_copy(update={"value_weight": 0.7, "batch_size": 19})
    method = Mlsh.prepared(config, 3, demonstrations)
    steps = Steps.of(demonstrations[:3], method.normalise)  # 19 steps: one batch takes each trajectory once
    bank = mlsh.Learner(method.initial_parameters(named_rng(0, "initial")), 1e-4)
    high = method._fresh_high(np.random.default_rng(0), 1e-3)
    levels = [high, bank]
    before = [
        {name: tensor.detach().clone().requires_grad_() for name, tensor in level.parameters.items()}
        for level in levels
    ]
    mlsh.TaskLearning(steps, config, generator()).learn(high, bank, 1)

    again = mlsh.TaskLearning(steps, config, generator())
    index, lengths = again._draw_batch()
    fresh = mlsh.Learner(before[0], 1e-3)
    picks = again._pick(fresh, steps.states[index], lengths)
    z = picks.chosen[macro_steps(lengths, 3).of_step]
    assert len(set(z.tolist())) > 1
    states, demonstrated = steps.states[index], steps.actions[index]
    outputs = torch.stack([plain_mlp(sub_skill, states) for sub_skill in mlsh.bank(before[1], "low")])[z, range(19)]
    means, values = outputs[:, :-1], outputs[:, -1]
    actions = (means + 0.3 * torch.randn(19, 3, generator=again.generator)).detach()
    rewards = -(actions - demonstrated).square().sum(-1)
    rewards = rewards / rewards.square().mean().sqrt()
    log_densities = torch.distributions.Normal(means, 0.3).log_prob(actions).sum(-1)
    low_loss = -(_standard(rewards - values) * log_densities).mean() + 0.7 * (values - rewards).square().mean()

    errors = (means - demonstrated).square().sum(-1).detach()
    bounds = [*picks.macro.first.tolist(), 19]
    returns = torch.stack([-errors[a:b].sum() for a, b in itertools.pairwise(bounds)])
    returns = returns / returns.square().mean().sqrt()
    high_outputs = plain_mlp(mlsh.network(before[0], "high"), states[bounds[:-1]])
    log_probabilities = high_outputs[:, :-1].log_softmax(-1)[range(len(returns)), picks.chosen]
    values = high_outputs[:, -1]
    high_loss = -(_standard(returns - values) * log_probabilities).mean() + 0.7 * (values - returns).square().mean()
    for level, start, loss in zip(levels, before, (high_loss, low_loss), strict=True):
        expected = torch.autograd.grad(loss, list(start.values()))
        for tensor, gradient in zip(level.parameters.values(), expected, strict=True):
            torch.testing.assert_close(tensor.grad, gradient, rtol=1e-3, atol=1e-5)
        assert all(not torch.equal(tensor, start[name]) for name, tensor in level.parameters.items())


def _standard(advantages: torch.Tensor) -> torch.Tensor:
    return ((advantages - advantages.mean()) / advantages.std(correction=0)).detach()


def test_sub_skills_are_drawn_as_often_as_the_high_level_says(demonstrations) -> None:
    method = Mlsh.prepared(SMALL_MLSH, 3, demonstrations)
    task = mlsh.TaskLearning(Steps.of(demonstrations, method.normalise), SMALL_MLSH, generator())
    high = method._fresh_high(np.random.default_rng(0), 1e-3)
    with torch.no_grad():
        high.parameters["high.2.weight"].zero_()
        high.parameters["high.2.bias"].copy_(torch.tensor([0.6, 0.3, 0.1, 1.0]).log())
    picks = task._pick(high, torch.zeros(30_000, 4), torch.tensor([30_000]))
    shares = torch.bincount(picks.chosen, minlength=3) / 10_000
    torch.testing.assert_close(shares, torch.tensor([0.6, 0.3, 0.1]), rtol=0, atol=0.02)
    torch.testing.assert_close(picks.log_probabilities, torch.tensor([0.6, 0.3, 0.1]).log()[picks.chosen])


def test_parameters_that_are_not_finite_are_reported_and_not_raised(method, demonstrations) -> None:
    initial = method.initial_parameters(named_rng(0, "initial"))
    parameters = {name: torch.full_like(tensor, torch.nan) for name, tensor in initial.items()}
    found = method.task_gradient(parameters, method.sample(demonstrations, 0, named_rng(0, "batch")))
    assert found.gradient.isnan().any()


def test_sub_skills_go_down_the_expected_squared_error(demonstrations) -> None:
    """Averaged over what is drawn, the surrogate's gradient at ρ = 1 is that of E r = −‖μ − a‖² − dσ², without V."""
    config = SMALL_MLSH.model_copy(update={"deviation": 0.2})
    method = Mlsh.prepared(config, 3, demonstrations)
    steps = Steps.of(demonstrations[:1], method.normalise)
    task = mlsh.TaskLearning(steps, config, generator())
    means = torch.randn(7, 3, generator=generator(1)).requires_grad_()
    (expected,) = torch.autograd.grad(-(means - steps.actions).square().sum(-1).mean(), means)
    draws = 40_000
    noise = torch.randn(draws, 7, 3, generator=generator(2))
    actions = (means + 0.2 * noise).detach().reshape(-1, 3)
    repeated = means.repeat(draws, 1)
    rewards = -(actions - steps.actions.repeat(draws, 1)).square().sum(-1)
    baseline = -(means - steps.actions).square().sum(-1).detach().repeat(draws) - 3 * 0.2**2
    log_densities = task._log_densities(repeated, actions)
    surrogate = clipped_surrogate(log_densities - log_densities.detach(), rewards - baseline, config.clip)
    (found,) = torch.autograd.grad(surrogate, means)
    torch.testing.assert_close(found, expected, rtol=0.05, atol=0.01)


@pytest.mark.parametrize("discount", [0.0, 0.99])
@pytest.mark.parametrize("lengths", [[1], [1, 1], [2, 7, 1, 4]])
def test_it_learns_from_one_step_or_ragged_trajectories(
    make_demonstrations, lengths: Sequence[int], discount: float
) -> None:
    demonstrations = make_demonstrations(0, lengths)
    method = Mlsh.prepared(SMALL_MLSH.model_copy(update={"discount": discount}), 3, demonstrations)
    parameters = method.initial_parameters(named_rng(0, "initial"))
    found = method.task_gradient(parameters, method.sample(demonstrations, 0, named_rng(0, "batch")))
    assert torch.isfinite(found.gradient).all()
    assert found.gradient.any()
    assert all(np.isfinite(value) for value in found.metrics.values())
    policy = method.adapt(parameters, demonstrations[:1], FineTuning(4, 0.05))
    assert len(policy.sub_skill_use(demonstrations[0]).chosen) == lengths[0]


def test_the_bits_do_not_depend_on_where_the_parameters_lie(method, demonstrations) -> None:
    parameters = method.initial_parameters(named_rng(0, "initial"))
    shapes = {name: tensor.shape for name, tensor in parameters.items()}
    views = [unflatten(flatten(parameters), shapes) for _ in range(2)]
    batch = method.sample(demonstrations, 0, named_rng(0, "batch"))
    one, two = (method.task_gradient(view, batch).gradient for view in views)
    assert torch.equal(one, two)


@pytest.mark.usefixtures("unchecked")
def test_learns_two_skills_that_a_fresh_high_level_puts_to_use_in_a_new_task() -> None:
    """A sub-skill changes only with a macro-step, so up to 2 of a demonstration's 40 steps cannot be right."""
    config = MlshConfig(
        sub_skills=2,
        hidden_layers=1,
        hidden_units=32,
        output_scale=0.1,
        high_learning_rate=1e-2,
        sub_skill_learning_rate=1e-3,
        warm_up_updates=60,
        joint_updates=30,
        batch_size=300,
        trajectories=16,
    )
    sets = training_sets()
    method = Mlsh.prepared(config, 2, list(itertools.chain(*sets.values())))
    training = TrainingConfig(iterations=20, tasks_per_iteration=4, outer_step="average", learning_rate=1.0)
    parameters = meta_trained(method, sets, training)
    demonstrations, skills = record(101, 12)
    found, errors = [], []
    for steps in (0, 200):
        policy = method.adapt(parameters, demonstrations[:2], FineTuning(steps, 1e-2))
        use = [policy.sub_skill_use(one) for one in demonstrations[2:]]
        found.append(recovered(skills[2:], [of.chosen for of in use]))
        best = recovered(skills[2:], [of.best for of in use])
        assert best >= 0.95  # the sub-skills are shared: they do not wait for the new task
        acted = [np.concatenate([did.actions for did in act_along(policy, one)]) for one in demonstrations[2:]]
        pairs = zip(acted, demonstrations[2:], strict=True)
        errors.append(np.mean([np.square(did - one.actions).sum(1).mean() for did, one in pairs]))
    assert found[0] < 0.95 <= found[1]
    assert errors[1] < 0.2 * errors[0]
