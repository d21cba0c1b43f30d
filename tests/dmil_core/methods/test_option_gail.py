"""OptionGAIL and its half without play: their gradients, what they do with practice, and that they learn."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from dmil_core.configs import SIZES, EvaluationConfig, TrainingConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.losses import Steps
from dmil_core.methods.base import FineTuning, MetaLearner, Policy, PractisingLearner, Rollout
from dmil_core.methods.option_adversary import (
    Aims,
    Played,
    aims_of,
    decisions,
    discriminate,
    discriminator_logits,
    discriminator_loss,
    high_values,
    imitation_rewards,
    improve,
    low_values,
    orthogonal,
)
from dmil_core.methods.option_gail import (
    OptionGail,
    OptionGailConfig,
    OptionGailOffline,
    OptionGailOfflineConfig,
    OptionMaterial,
)
from dmil_core.methods.option_policies import OptionExplorer
from dmil_core.methods.options import Chain, OptionModel, log_likelihood, options_before, viterbi
from dmil_core.networks import Parameters, flatten, unflatten
from dmil_core.seeding import stream
from tests.dmil_core.methods.toys import STEPS, meta_trained, practise, record, recovered, training_sets

OFFLINE = OptionGailOfflineConfig(hidden_layers=2, hidden_units=8, trajectories=3, likelihood_iterations=2)
PLAYING = OptionGailConfig(
    hidden_layers=2,
    hidden_units=8,
    trajectories=3,
    likelihood_iterations=2,
    offline_iterations=4,
    offline_steps=1,
    environment_steps=9,
    minibatch=4,
    discriminator_passes=2,
    policy_epochs=2,
    discriminator_units=8,
    critic_units=8,
)


@pytest.fixture
def demonstrations(make_demonstrations) -> list[Demonstration]:
    return make_demonstrations(0, [7, 3, 9, 1, 6])


@pytest.fixture
def offline(demonstrations) -> OptionGailOffline:
    return OptionGailOffline.prepared(OFFLINE, 3, demonstrations)


@pytest.fixture
def playing(demonstrations) -> OptionGail:
    return OptionGail.prepared(PLAYING, 3, demonstrations)


@pytest.fixture
def rollouts() -> list[Rollout]:
    draw = np.random.default_rng(5)
    return [
        Rollout(
            draw.normal(size=(steps + 1, 4)).astype(np.float32),
            draw.normal(size=(steps, 3)).astype(np.float32),
            draw.integers(0, 3, steps),
            success,
            ended=True,
        )
        for steps, success in ((5, True), (1, False), (3, False))
    ]


def drawn_parameters(method: OptionGailOffline | OptionGail) -> Parameters:
    """Draw parameters of which none is zero."""
    generator = torch.Generator().manual_seed(1)
    drawn = method.initial_parameters(stream(0, "initial"))
    return {name: tensor + 0.3 * torch.randn(tensor.shape, generator=generator) for name, tensor in drawn.items()}


def like(gradient: torch.Tensor, parameters: Parameters) -> Parameters:
    return unflatten(gradient, {name: tensor.shape for name, tensor in parameters.items()})


def model_of(parameters: Parameters) -> OptionModel:
    return OptionModel.of(parameters, -20.0)


def test_they_are_what_their_types_say(offline, playing) -> None:
    assert isinstance(offline, MetaLearner)
    assert not isinstance(offline, PractisingLearner)
    assert isinstance(playing, PractisingLearner)


@pytest.mark.parametrize("size", ["paper", "quick", "smoke"])
@pytest.mark.parametrize("config_type", [OptionGailOfflineConfig, OptionGailConfig])
def test_every_size_has_all_of_its_phases(config_type, size: str) -> None:
    own = config_type.sizes[size]
    config = config_type(**own.get("method", {}))
    common = SIZES[size]
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
        drawn = method.initial_parameters(stream(0, "initial"))
        assert {name: tuple(tensor.shape) for name, tensor in drawn.items()} == expected
        again = method.initial_parameters(stream(0, "initial"))
        assert torch.equal(flatten(drawn), flatten(again))


def test_orthogonal_weights_keep_lengths() -> None:
    drawn = orthogonal("critic", [4, 8, 8, 3], np.random.default_rng(0))
    first, second, last = (drawn[f"critic.{layer}.weight"] for layer in range(3))
    torch.testing.assert_close(first.T @ first, 2 * torch.eye(4))
    torch.testing.assert_close(second.T @ second, 2 * torch.eye(8))
    torch.testing.assert_close(last @ last.T, torch.eye(3))


@pytest.mark.parametrize(
    ("iteration", "phase", "steps"),
    [(0, "likelihood", 0), (1, "likelihood", 0), (2, "hard", 0), (3, "hard", 0), (4, "adversarial", 9)],
)
def test_an_iteration_decides_of_the_phase(offline, playing, demonstrations, iteration, phase, steps) -> None:
    material = playing.sample(demonstrations, iteration, stream(0, "batch"))
    assert material.phase == phase
    assert playing.practice_steps(iteration) == steps
    assert len(set(material.ids)) == 3
    assert offline.sample(demonstrations, iteration, stream(0, "batch")).phase == phase.replace("adversarial", "hard")
    assert len(offline.sample(demonstrations[:2], iteration, stream(0, "batch")).ids) == 2


def test_gradient_is_that_of_the_likelihood(offline, demonstrations) -> None:
    parameters = {name: tensor.requires_grad_() for name, tensor in drawn_parameters(offline).items()}
    material = offline.sample(demonstrations, 0, stream(0, "batch"))
    steps, model = Steps.of(material.demonstrations, offline.standardise), model_of(parameters)
    chain = Chain.of(model.log_high(steps.states), model.log_low(steps.states, steps.actions), steps.lengths)
    loss = -log_likelihood(chain).sum() / len(steps.states)
    expected = torch.autograd.grad(loss, list(parameters.values()))
    found = offline.task_gradient(parameters, material)
    assert found.metrics["loss"] == pytest.approx(loss.item(), rel=1e-5)
    assert sum(found.metrics[f"sub_skill_share/{k}"] for k in range(3)) == pytest.approx(1)
    for of, gradient in zip(like(found.gradient, parameters).values(), expected, strict=True):
        torch.testing.assert_close(of, gradient, rtol=1e-4, atol=1e-5)


def test_gradient_of_hard_em_is_that_of_the_labelled_demonstrations(offline, demonstrations, plain_mlp) -> None:
    parameters = {name: tensor.requires_grad_() for name, tensor in drawn_parameters(offline).items()}
    material = offline.sample(demonstrations, 2, stream(0, "batch"))
    steps, model = Steps.of(material.demonstrations, offline.standardise), model_of(parameters)
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
    found = offline.task_gradient(parameters, material)
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
    material = playing.sample(demonstrations, iteration, stream(0, "batch"))
    model = {name: tensor for name, tensor in parameters.items() if not name.startswith(("critic", "discriminator"))}
    slopes = like(offline.task_gradient(model, material).gradient, model)
    found = playing.task_gradient(parameters, material)
    for name, way in like(found.gradient, parameters).items():
        slope = slopes.get(name)
        if slope is None:
            assert not way.any()
        else:  # Adam's first step
            torch.testing.assert_close(
                way, PLAYING.offline_learning_rate * slope / (slope.abs() + 1e-8), rtol=1e-2, atol=1e-6
            )


@pytest.mark.parametrize("iteration", [0, 2, 4])
def test_a_single_step_can_be_learned_from(make_demonstrations, rollouts, iteration: int) -> None:
    demonstrations = make_demonstrations(0, [1] * 3)
    for method in (
        OptionGailOffline.prepared(OFFLINE, 3, demonstrations),
        OptionGail.prepared(PLAYING, 3, demonstrations),
    ):
        parameters = method.initial_parameters(stream(0, "initial"))
        material = method.sample(demonstrations, iteration, stream(0, "batch"))
        if isinstance(method, OptionGail) and method.practice_steps(iteration):
            material = method.with_practice(material, rollouts)
        found = method.task_gradient(parameters, material)
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
    parameters, steps = drawn_parameters(offline), Steps.of(demonstrations[:2], offline.standardise)
    found = []
    for count in (0, 20):
        model = offline.adapt(parameters, demonstrations[:2], FineTuning(count, 0.01)).model
        chain = Chain.of(model.log_high(steps.states), model.log_low(steps.states, steps.actions), steps.lengths)
        found.append(log_likelihood(chain).sum().item())
    assert found[1] > found[0]


def test_the_most_probable_option_after_the_last_one_acts(offline, demonstrations, plain_mlp) -> None:
    parameters = drawn_parameters(offline)
    policy = offline.adapt(parameters, demonstrations[:1], FineTuning(0, 0.01))
    assert policy.start(2).tolist() == [[3], [3]]
    observations = np.concatenate([one.observations for one in demonstrations])
    last = np.random.default_rng(0).integers(0, 4, (len(observations), 1))
    decision = policy.act(observations, last)
    states, model = torch.from_numpy(offline.standardise(observations)), model_of(parameters)
    assert len(set(decision.sub_skills.tolist())) > 1
    for state, before, option, action in zip(states, last[:, 0], decision.sub_skills, decision.actions, strict=True):
        assert option == plain_mlp(model.high, state).view(4, 3)[before].argmax()
        np.testing.assert_allclose(action, plain_mlp(model.low[option], state), rtol=1e-4, atol=1e-5)
    assert np.array_equal(decision.memory[:, 0], decision.sub_skills)


def test_sub_skill_use_is_what_the_policy_takes_and_the_best_fit(offline, demonstrations) -> None:
    parameters, shown = drawn_parameters(offline), demonstrations[2]
    policy = offline.adapt(parameters, demonstrations[:1], FineTuning(0, 0.01))
    use, memory, taken = policy.sub_skill_use(shown), policy.start(1), []
    for observation in shown.observations:
        decision = policy.act(observation[None], memory)
        memory = decision.memory
        taken.append(decision.sub_skills.item())
    assert use.chosen.tolist() == taken
    steps, model = Steps.of([shown], offline.standardise), model_of(parameters)
    assert use.best.tolist() == model.log_low(steps.states, steps.actions).argmax(1).tolist()


def explorer_of(method: OptionGail, seed: int, demonstrations: list[Demonstration]) -> OptionExplorer:
    material = replace(method.sample(demonstrations, 4, stream(0, "batch")), seed=seed)
    return method.explorer(drawn_parameters(method), material)


def test_what_is_drawn_does_not_depend_on_who_else_acts(playing, demonstrations) -> None:
    explorer = explorer_of(playing, 7, demonstrations)
    observations = np.random.default_rng(1).normal(size=(4, 5, 4)).astype(np.float32)

    def act(dropped_at: dict[int, int]) -> dict[tuple[int, int], tuple[int, np.ndarray]]:
        alive, memory, done = np.arange(5), explorer.start(5), {}
        for step, seen in enumerate(observations):
            going = np.array([dropped_at.get(int(one), 9) > step for one in alive])
            alive, memory = alive[going], memory[going]
            decision = explorer.act(seen[alive], memory)
            memory = decision.memory
            for one, option, action in zip(alive.tolist(), decision.sub_skills, decision.actions, strict=True):
                done[one, step] = int(option), action
        return done

    everything = act({})
    some = act({0: 1, 3: 2, 4: 1})
    assert len(some) == 1 + 4 + 4 + 2 + 1
    for at, (option, action) in some.items():
        assert option == everything[at][0]
        np.testing.assert_allclose(action, everything[at][1], rtol=1e-5, atol=1e-6)


def test_episodes_begun_one_by_one_differ_by_their_first_observation(playing, demonstrations) -> None:
    explorer, other_seed = (explorer_of(playing, seed, demonstrations) for seed in (7, 8))
    first, second = np.random.default_rng(1).normal(size=(2, 1, 4)).astype(np.float32)

    def noise(policy: OptionExplorer, begun: np.ndarray) -> np.ndarray:
        """Draw two steps' actions, the second in the same state whatever came first."""
        memory = policy.act(begun, policy.start(1)).memory
        assert memory[0, 1] == 1
        decision = policy.act(first, memory)
        states = torch.from_numpy(policy.standardise(first))
        options = torch.from_numpy(decision.sub_skills)
        mean, deviation = policy.model.means(states, options), policy.model.log_deviations[options].exp()
        return (decision.actions - mean.numpy()) / deviation.numpy()

    np.testing.assert_allclose(noise(explorer, first), noise(explorer, first))
    assert not np.allclose(noise(explorer, first), noise(explorer, second))
    assert not np.allclose(noise(explorer, first), noise(other_seed, first))


def test_draws_are_from_the_model(playing, demonstrations) -> None:
    explorer, count = explorer_of(playing, 7, demonstrations), 4000
    observations = np.repeat(demonstrations[0].observations[:1], count, axis=0)
    memory = explorer.start(count)
    memory[:, 0] = 1
    decision = explorer.act(observations, memory)
    state = torch.from_numpy(explorer.standardise(observations[:1]))
    shares = np.bincount(decision.sub_skills, minlength=3) / count
    np.testing.assert_allclose(shares, explorer.model.log_high(state)[0, 1].exp().numpy(), atol=0.03)
    for k in range(3):
        own = decision.actions[decision.sub_skills == k]
        deviations = explorer.model.log_deviations[k].exp().numpy()
        np.testing.assert_allclose(
            (own.mean(0) - explorer.model.means(state, torch.tensor([k])).numpy()[0]) / deviations,
            np.zeros(3),
            atol=4 / len(own) ** 0.5,
        )
        np.testing.assert_allclose(own.std(0) / deviations, np.ones(3), atol=4 / len(own) ** 0.5)


def test_loss_and_reward_are_those_of_the_sigmoid() -> None:
    of_policy, of_expert = torch.tensor([2.0, -1.0]), torch.tensor([0.5])
    expected = -of_policy.sigmoid().log().mean() - (1 - of_expert.sigmoid()).log().mean()
    torch.testing.assert_close(discriminator_loss(of_policy, of_expert), expected)
    torch.testing.assert_close(imitation_rewards(of_policy), -of_policy.sigmoid().log())
    assert imitation_rewards(torch.tensor([200.0, 0.0])).tolist() == pytest.approx([0.0, np.log(2)])


@pytest.fixture
def played(playing, rollouts) -> Played:
    return Played.of_rollouts(rollouts, playing.standardise, 3)


def test_rollouts_lie_one_after_the_other(playing, played, rollouts) -> None:
    assert played.steps.lengths.tolist() == [5, 1, 3]
    assert [played.before[t].item() for t in (0, 5, 6)] == [3, 3, 3]
    assert torch.equal(played.before, options_before(played.options, played.steps.lengths, 3))
    np.testing.assert_allclose(played.steps.states[6:], playing.standardise(rollouts[2].observations[:3]))
    np.testing.assert_allclose(played.steps.actions[6:], rollouts[2].actions)
    some = played.at(torch.tensor([6, 1]))
    assert some.before.tolist() == [3, played.options[0].item()]
    assert torch.equal(some.steps.actions, played.steps.actions[[6, 1]])


def test_logits_are_indexed_by_the_option_before_and_at(playing, played, plain_mlp) -> None:
    parameters = drawn_parameters(playing)
    judge = tuple((parameters[f"discriminator.{n}.weight"], parameters[f"discriminator.{n}.bias"]) for n in range(3))
    found = discriminator_logits(parameters, played, 3)
    for t, logit in enumerate(found):
        outputs = plain_mlp(judge, torch.cat([played.steps.states[t], played.steps.actions[t]])).view(4, 3)
        torch.testing.assert_close(logit, outputs[played.before[t], played.options[t]])


def test_the_discriminator_learns_to_tell_them_apart(playing, played, demonstrations) -> None:
    steps = Steps.of(demonstrations, playing.standardise)
    expert = Played.of(steps._replace(actions=steps.actions + 3), torch.zeros(len(steps.states), dtype=torch.int64), 3)
    config = PLAYING.model_copy(update={"discriminator_passes": 100, "learning_rate": 1e-2})
    moved = {name: tensor.clone().requires_grad_() for name, tensor in drawn_parameters(playing).items()}
    before = {name: tensor.detach().clone() for name, tensor in moved.items()}
    metrics = discriminate(moved, played, expert, config, torch.Generator().manual_seed(0))
    assert metrics["discriminator_accuracy"] == 1
    with torch.no_grad():
        of_policy, of_expert = (discriminator_logits(moved, side, 3) for side in (played, expert))
    assert imitation_rewards(of_expert).min() > imitation_rewards(of_policy).max()
    for name, tensor in moved.items():
        assert torch.equal(tensor, before[name]) == (not name.startswith("discriminator"))


def test_aims_follow_from_the_values_of_both_levels(playing, played, rollouts) -> None:
    parameters, discount, both = drawn_parameters(playing), PLAYING.discount, PLAYING.discount * PLAYING.smoothing
    rewards = torch.rand(9, generator=torch.Generator().manual_seed(0))
    beyond = torch.from_numpy(playing.standardise(np.stack([one.observations[-1] for one in rollouts])))
    found = aims_of(parameters, played, rewards, beyond, PLAYING)

    with torch.no_grad():
        low = low_values(parameters, played)
        high = high_values(parameters, played.steps.states, played.before, PLAYING)
        chances = model_of(parameters).log_high(played.steps.states).exp()
        for t in range(9):
            of_each = [
                low_values(parameters, played.at(torch.tensor([t]))._replace(options=torch.tensor([option])))
                for option in range(3)
            ]
            torch.testing.assert_close(high[t], (chances[t, played.before[t]] * torch.cat(of_each)).sum())
        last = high_values(parameters, beyond, played.options[[4, 5, 8]], PLAYING)

    def advantages(values: torch.Tensor) -> torch.Tensor:
        each = []
        for first, end, after in ((0, 5, last[0]), (5, 6, last[1]), (6, 9, last[2])):
            later = torch.cat([values[first + 1 : end], after[None]])
            errors = (rewards - rewards.mean())[first:end] + discount * later - values[first:end]
            each += [sum(both**n * error for n, error in enumerate(errors[t:])) for t in range(end - first)]
        return torch.stack(each)

    for of_level, values in ((found.high, high), (found.low, low)):
        expected = advantages(values)
        expected = (expected - expected.mean()) / expected.std(correction=0)
        torch.testing.assert_close(of_level, expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.returns, advantages(low) + low, rtol=1e-4, atol=1e-5)


def test_improvement_follows_the_advantages_of_each_level(playing, played) -> None:
    liked = (played.options == 1).float() * 2 - 1
    high_up = played.steps.actions[:, 0].sign()
    aims = Aims(liked, high_up, torch.full((9,), 0.5))
    config = PLAYING.model_copy(update={"policy_epochs": 30, "learning_rate": 1e-3})
    moved = {name: tensor.clone().requires_grad_() for name, tensor in drawn_parameters(playing).items()}
    before = {name: tensor.detach().clone() for name, tensor in moved.items()}
    metrics = improve(moved, played, aims, config, torch.Generator().manual_seed(0))
    with torch.no_grad():
        old, new = (decisions(parameters, played, config) for parameters in (before, moved))
        errors = [low_values(parameters, played) - 0.5 for parameters in (before, moved)]
    assert ((new.high - old.high) * liked).mean() > 0
    assert ((new.low - old.low) * high_up).mean() > 0
    assert errors[1].square().mean() < errors[0].square().mean()
    assert metrics["value_error"] == pytest.approx(errors[1].square().mean().item())
    for name, tensor in moved.items():
        assert torch.equal(tensor, before[name]) == name.startswith("discriminator")


def test_a_round_is_pure_and_reports_what_it_took(playing, demonstrations, rollouts) -> None:
    parameters = drawn_parameters(playing)
    before = flatten(parameters)
    empty = Rollout(np.zeros((1, 4), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.int64), False, False)

    def of_seed(seed: int) -> OptionMaterial:
        material = replace(playing.sample(demonstrations, 4, stream(0, "batch")), seed=seed)
        return playing.with_practice(material, [rollouts[0], empty, *rollouts[1:]])

    found, again, other = (playing.task_gradient(parameters, of_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(flatten(parameters), before)
    assert torch.equal(found.gradient, again.gradient)
    assert found.metrics == again.metrics
    assert not torch.equal(found.gradient, other.gradient)
    assert found.metrics["environment_steps"] == 9
    assert found.metrics["practice_success"] == pytest.approx(1 / 3)
    assert all(way.any() for way in like(found.gradient, parameters).values())


@pytest.mark.usefixtures("unchecked")
def test_practice_improves_a_known_reward() -> None:
    """The explorer, the advantages and PPO, with a reward in place of the discriminator's: where to go, and how."""
    demonstrations = record(0, 2).demonstrations
    config = PLAYING.model_copy(
        update={"sub_skills": 2, "hidden_layers": 1, "hidden_units": 16, "output_scale": 0.1}
        | {"learning_rate": 3e-3, "minibatch": 64, "policy_epochs": 4, "discount": 0.9}
    )
    method = OptionGail.prepared(config, 2, demonstrations)
    moved = {name: tensor.requires_grad_() for name, tensor in method.initial_parameters(stream(0, "initial")).items()}
    means = []
    for iteration in range(25):
        material = method.sample(demonstrations, config.offline_iterations, stream(0, "batch", iteration))
        rollouts = practise(method.explorer(moved, material), "task-0", iteration, 5 * STEPS)
        played = Played.of_rollouts(rollouts, method.standardise, 2)
        rewards = -(played.steps.actions - torch.tensor([-1.0, 0.5])).square().sum(1) + 2.0 * (played.options == 1)
        last = torch.from_numpy(method.standardise(np.stack([one.observations[-1] for one in rollouts])))
        aims = aims_of(moved, played, rewards, last, config)
        improve(moved, played, aims, config, torch.Generator().manual_seed(iteration))
        means.append(rewards.mean().item())
    # At first −(1² + 0.5² + 2σ²) + 1 = −2.25; at best 2, less 2σ².
    assert means[0] == pytest.approx(-2.25, abs=0.5)
    assert means[-1] > 0.5


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
    successes = [rollout.success for rollout in practise(policy, "task-101", 5, 10 * STEPS)]
    assert np.mean(successes) >= 0.9


@pytest.mark.slow
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
        rollouts = practise(policy, task, seed, steps)
        successes.append(float(np.mean([rollout.success for rollout in rollouts])))
        return rollouts

    meta_trained(method, sets, training, watched)
    assert len(successes) == 2 * 24
    assert np.mean(successes[16:]) > np.mean(successes[:16]) + 0.1
