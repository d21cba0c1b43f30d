"""OptionGAIL and its half without play: their gradients, what they do with practice, and that they learn."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from dmil_core.configs import BASE_PRESETS, EvaluationConfig, TrainingConfig
from dmil_core.losses import Steps
from dmil_core.methods.base import FineTuning, MetaLearner, OnlineMetaLearner, Policy
from dmil_core.methods.option_gail.method import (
    OptionBatch,
    OptionGail,
    OptionGailConfig,
    OptionGailOffline,
    OptionGailOfflineConfig,
)
from dmil_core.methods.option_gail.option_model import Chain, _forward, posterior, viterbi
from dmil_core.networks import Parameters, flatten, unflatten
from dmil_core.seeding import named_rng
from dmil_core.trajectories import Rollout
from tests.dmil_core.methods.conftest import OFFLINE, PLAYING, drawn_parameters, model_of
from tests.dmil_core.methods.toys import STEPS, collect_rollouts, meta_trained, record, recovered, training_sets


def like(gradient: torch.Tensor, parameters: Parameters) -> Parameters:
    return unflatten(gradient, {name: tensor.shape for name, tensor in parameters.items()})


def test_they_are_what_their_types_say(offline, playing) -> None:
    assert isinstance(offline, MetaLearner)
    assert not isinstance(offline, OnlineMetaLearner)
    assert isinstance(playing, OnlineMetaLearner)


@pytest.mark.parametrize("size", ["paper", "quick", "smoke"])
@pytest.mark.parametrize("config_type", [OptionGailOfflineConfig, OptionGailConfig])
def test_every_size_has_all_of_its_phases(config_type, size: str) -> None:
    own = config_type.presets[size]
    config = config_type(**own.get("method", {}))
    common = BASE_PRESETS[size]
    training = TrainingConfig(**common.training.model_dump() | own.get("training", {}))
    EvaluationConfig(**common.evaluation.model_dump() | own["evaluation"])
    assert training.iterations % training.checkpoint_every == 0
    if isinstance(config, OptionGailConfig):
        assert 0 < config.likelihood_iterations < config.offline_iterations < training.iterations
        assert (training.outer_step, training.learning_rate, training.gradient_clip) == ("average", 1.0, None)
    else:
        assert 0 < config.likelihood_iterations < training.iterations
        assert training.outer_step == "adam"


def test_initial_parameters_have_the_sizes_of_the_settings(offline, playing) -> None:
    model = {
        "high.0.weight": (8, 4),
        "high.0.bias": (8,),
        "high.1.weight": (8, 8),
        "high.1.bias": (8,),
        "high.2.weight": (12, 8),
        "high.2.bias": (12,),
        "low.0.weight": (3, 8, 4),
        "low.0.bias": (3, 8),
        "low.1.weight": (3, 8, 8),
        "low.1.bias": (3, 8),
        "low.2.weight": (3, 3, 8),
        "low.2.bias": (3, 3),
        "log_deviations": (3, 3),
    }
    others = {
        "critic.0.weight": (8, 4),
        "critic.0.bias": (8,),
        "critic.1.weight": (8, 8),
        "critic.1.bias": (8,),
        "critic.2.weight": (3, 8),
        "critic.2.bias": (3,),
        "discriminator.0.weight": (8, 7),
        "discriminator.0.bias": (8,),
        "discriminator.1.weight": (8, 8),
        "discriminator.1.bias": (8,),
        "discriminator.2.weight": (12, 8),
        "discriminator.2.bias": (12,),
    }
    for method, expected in ((offline, model), (playing, model | others)):
        drawn = method.initial_parameters(named_rng(0, "initial"))
        assert {name: tuple(tensor.shape) for name, tensor in drawn.items()} == expected
        again = method.initial_parameters(named_rng(0, "initial"))
        assert torch.equal(flatten(drawn), flatten(again))


@pytest.mark.parametrize(
    ("iteration", "phase", "steps"),
    [(0, "likelihood", 0), (1, "likelihood", 0), (2, "hard", 0), (3, "hard", 0), (4, "adversarial", 9)],
)
def test_an_iteration_decides_of_the_phase(offline, playing, demonstrations, iteration, phase, steps) -> None:
    batch = playing.sample(demonstrations, iteration, named_rng(0, "batch"))
    assert batch.phase == phase
    assert playing.environment_steps(iteration) == steps
    assert len(set(batch.ids)) == 3
    assert offline.sample(demonstrations, iteration, named_rng(0, "batch")).phase == phase.replace(
        "adversarial", "hard"
    )
    assert len(offline.sample(demonstrations[:2], iteration, named_rng(0, "batch")).ids) == 2


def test_gradient_is_that_of_the_likelihood(offline, demonstrations) -> None:
    parameters = {name: tensor.requires_grad_() for name, tensor in drawn_parameters(offline).items()}
    batch = offline.sample(demonstrations, 0, named_rng(0, "batch"))
    steps, model = Steps.of(batch.demonstrations, offline.normalise), model_of(parameters)
    chain = Chain.of(model.log_high(steps.states), model.log_low(steps.states, steps.actions), steps.lengths)
    loss = -_forward(chain)[-1].logsumexp(-1).sum() / len(steps.states)
    expected = torch.autograd.grad(loss, list(parameters.values()))
    found = offline.task_gradient(parameters, batch)
    assert found.metrics["loss"] == pytest.approx(loss.item(), rel=1e-5)
    assert sum(found.metrics[f"sub_skill_share/{k}"] for k in range(3)) == pytest.approx(1)
    for of, gradient in zip(like(found.gradient, parameters).values(), expected, strict=True):
        torch.testing.assert_close(of, gradient, rtol=1e-4, atol=1e-5)


def test_gradient_of_hard_em_is_that_of_the_labelled_demonstrations(offline, demonstrations, plain_mlp) -> None:
    parameters = {name: tensor.requires_grad_() for name, tensor in drawn_parameters(offline).items()}
    batch = offline.sample(demonstrations, 2, named_rng(0, "batch"))
    steps, model = Steps.of(batch.demonstrations, offline.normalise), model_of(parameters)
    labels = viterbi(
        Chain.of(model.log_high(steps.states), model.log_low(steps.states, steps.actions), steps.lengths)
    ).tolist()
    total, firsts = torch.zeros(()), (steps.lengths.cumsum(0) - steps.lengths).tolist()
    for t, label in enumerate(labels):
        before = 3 if t in firsts else labels[t - 1]
        total = total + plain_mlp(model.high, steps.states[t]).view(4, 3)[before].log_softmax(-1)[label]
        mean = plain_mlp(model.low[label], steps.states[t])
        total = total + Normal(mean, model.log_deviations[label].exp()).log_prob(steps.actions[t]).sum()
    loss = -total / len(labels)
    found = offline.task_gradient(parameters, batch)
    assert found.metrics["loss"] == pytest.approx(loss.item(), rel=1e-5)
    assert [found.metrics[f"sub_skill_share/{k}"] for k in range(3)] == pytest.approx(
        [labels.count(k) / len(labels) for k in range(3)]
    )
    for of, gradient in zip(
        like(found.gradient, parameters).values(), torch.autograd.grad(loss, list(parameters.values())), strict=True
    ):
        torch.testing.assert_close(of, gradient, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("iteration", [0, 2])
def test_an_offline_slot_goes_one_step_of_adam(offline, playing, demonstrations, iteration: int) -> None:
    parameters = drawn_parameters(playing)
    batch = playing.sample(demonstrations, iteration, named_rng(0, "batch"))
    model = {name: tensor for name, tensor in parameters.items() if not name.startswith(("critic", "discriminator"))}
    gradients = like(offline.task_gradient(model, batch).gradient, model)
    found = playing.task_gradient(parameters, batch)
    for name, way in like(found.gradient, parameters).items():
        gradient = gradients.get(name)
        if gradient is None:
            assert not way.any()
        else:  # Adam's first step
            torch.testing.assert_close(
                way, PLAYING.offline_learning_rate * gradient / (gradient.abs() + 1e-8), rtol=1e-2, atol=1e-6
            )


@pytest.mark.parametrize("iteration", [0, 2, 4])
def test_a_single_step_can_be_learned_from(make_demonstrations, rollouts, iteration: int) -> None:
    demonstrations = make_demonstrations(0, [1] * 3)
    for method in (
        OptionGailOffline.prepared(OFFLINE, 3, demonstrations),
        OptionGail.prepared(PLAYING, 3, demonstrations),
    ):
        parameters = method.initial_parameters(named_rng(0, "initial"))
        batch = method.sample(demonstrations, iteration, named_rng(0, "batch"))
        if isinstance(method, OptionGail) and method.environment_steps(iteration):
            batch = method.with_rollouts(batch, rollouts)
        found = method.task_gradient(parameters, batch)
        assert torch.isfinite(found.gradient).all()
        assert found.gradient.any()
        assert all(np.isfinite(value) for value in found.metrics.values())
        policy = method.adapt(parameters, demonstrations[:1], FineTuning(2, 0.05))
        assert policy.sub_skill_use(demonstrations[0]).chosen.shape == (1,)


@pytest.mark.parametrize("steps", [0, 3])
def test_adaptation_leaves_the_parameters(playing, demonstrations, steps: int) -> None:
    parameters = drawn_parameters(playing)
    before = flatten(parameters)
    policies = [playing.adapt(parameters, demonstrations[:2], FineTuning(steps, 0.01)) for _ in range(2)]
    assert torch.equal(flatten(parameters), before)
    (weight, again), old = (policy.model.high[0].weight for policy in policies), parameters["high.0.weight"]
    assert torch.equal(weight, again)
    assert torch.equal(weight, old) == (steps == 0)


def test_adaptation_raises_the_likelihood_of_the_support(offline, demonstrations) -> None:
    parameters, steps = drawn_parameters(offline), Steps.of(demonstrations[:2], offline.normalise)
    found = []
    for count in (0, 20):
        model = offline.adapt(parameters, demonstrations[:2], FineTuning(count, 0.01)).model
        chain = Chain.of(model.log_high(steps.states), model.log_low(steps.states, steps.actions), steps.lengths)
        found.append(posterior(chain)[0].sum().item())
    assert found[1] > found[0]


def test_a_round_is_pure_and_reports_what_it_took(playing, demonstrations, rollouts) -> None:
    parameters = drawn_parameters(playing)
    before = flatten(parameters)
    nothing = np.zeros((1, 4), np.float32), np.zeros((0, 3), np.float32)
    empty = Rollout(*nothing, sub_skills=np.zeros(0, np.int64), ended=False)

    def of_seed(seed: int) -> OptionBatch:
        batch = replace(playing.sample(demonstrations, 4, named_rng(0, "batch")), seed=seed)
        return playing.with_rollouts(batch, [rollouts[0], empty, *rollouts[1:]])

    found, again, other = (playing.task_gradient(parameters, of_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(flatten(parameters), before)
    assert torch.equal(found.gradient, again.gradient)
    assert found.metrics == again.metrics
    assert not torch.equal(found.gradient, other.gradient)
    assert found.metrics["environment_steps"] == 9
    assert found.metrics["practice_success"] == pytest.approx(1 / 3)
    assert all(way.any() for way in like(found.gradient, parameters).values())


@pytest.mark.usefixtures("unchecked")
def test_tells_two_skills_apart_in_a_new_task_offline() -> None:
    config = OptionGailOfflineConfig(
        sub_skills=2, hidden_layers=1, hidden_units=32, output_scale=0.1, trajectories=4, likelihood_iterations=0
    )
    sets = training_sets()
    method = OptionGailOffline.prepared(config, 2, list(itertools.chain(*sets.values())))
    training = TrainingConfig(iterations=300, tasks_per_iteration=4, learning_rate=1e-2)
    parameters = meta_trained(method, sets, training)
    demonstrations, skills = record(101, 8)
    policy = method.adapt(parameters, demonstrations[:2], FineTuning(100, 1e-2))
    assert recovered(skills, [policy.sub_skill_use(one).chosen for one in demonstrations]) >= 0.95
    successes = [rollout.success for rollout in collect_rollouts(policy, "task-101", 5, 10 * STEPS)]
    assert np.mean(successes) >= 0.9


@pytest.mark.thorough
@pytest.mark.usefixtures("unchecked")
def test_practice_against_the_discriminator_makes_more_of_a_poor_start() -> None:
    sets = {"task-0": training_sets(1)["task-0"]}
    config = OptionGailConfig(
        sub_skills=2,
        hidden_layers=1,
        hidden_units=32,
        output_scale=0.1,
        least_log_deviation=-1.5,
        trajectories=8,
        likelihood_iterations=0,
        offline_iterations=40,
        offline_steps=5,
        offline_learning_rate=1e-2,
        environment_steps=10 * STEPS,
        policy_epochs=4,
        discriminator_passes=4,
        discriminator_units=32,
        critic_units=32,
    )
    method = OptionGail.prepared(config, 2, sets["task-0"])
    training = TrainingConfig(iterations=64, tasks_per_iteration=2, outer_step="average", learning_rate=1.0)
    successes: list[float] = []

    def watched(policy: Policy, task: str, seed: int, steps: int) -> list[Rollout]:
        rollouts = collect_rollouts(policy, task, seed, steps)
        successes.append(float(np.mean([rollout.success for rollout in rollouts])))
        return rollouts

    meta_trained(method, sets, training, watched)
    assert len(successes) == 2 * 24
    assert np.mean(successes[16:]) > np.mean(successes[:16]) + 0.1
