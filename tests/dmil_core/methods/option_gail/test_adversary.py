"""OptionGAIL's discriminator, the advantages of both levels, and PPO: one by one, and on a known reward."""

import numpy as np
import pytest
import torch

from dmil_core.losses import Steps
from dmil_core.methods.option_gail.adversary import (
    OptionSteps,
    Targets,
    decisions,
    discriminate,
    discriminator_logits,
    discriminator_loss,
    high_values,
    imitation_rewards,
    improve,
    low_values,
    orthogonal,
    ppo_targets,
)
from dmil_core.methods.option_gail.method import OptionGail
from dmil_core.methods.option_gail.option_model import options_before
from dmil_core.seeding import named_rng
from tests.dmil_core.methods.conftest import PLAYING, drawn_parameters, model_of
from tests.dmil_core.methods.toys import STEPS, collect_rollouts, record


@pytest.fixture
def batch(playing, rollouts) -> OptionSteps:
    return OptionSteps.of_rollouts(rollouts, playing.normalise, 3)


def test_orthogonal_weights_keep_lengths() -> None:
    drawn = orthogonal("critic", [4, 8, 8, 3], np.random.default_rng(0))
    first, second, last = (drawn[f"critic.{layer}.weight"] for layer in range(3))
    torch.testing.assert_close(first.T @ first, 2 * torch.eye(4))
    torch.testing.assert_close(second.T @ second, 2 * torch.eye(8))
    torch.testing.assert_close(last @ last.T, torch.eye(3))


def test_loss_and_reward_are_those_of_the_sigmoid() -> None:
    of_policy, of_expert = torch.tensor([2.0, -1.0]), torch.tensor([0.5])
    expected = -of_policy.sigmoid().log().mean() - (1 - of_expert.sigmoid()).log().mean()
    torch.testing.assert_close(discriminator_loss(of_policy, of_expert), expected)
    torch.testing.assert_close(imitation_rewards(of_policy), -of_policy.sigmoid().log())
    assert imitation_rewards(torch.tensor([200.0, 0.0])).tolist() == pytest.approx([0.0, np.log(2)])


def test_rollouts_lie_one_after_the_other(playing, batch, rollouts) -> None:
    assert batch.steps.lengths.tolist() == [5, 1, 3]
    assert [batch.before[t].item() for t in (0, 5, 6)] == [3, 3, 3]
    assert torch.equal(batch.before, options_before(batch.options, batch.steps.lengths, 3))
    np.testing.assert_allclose(batch.steps.states[6:], playing.normalise(rollouts[2].observations[:3]))
    np.testing.assert_allclose(batch.steps.actions[6:], rollouts[2].actions)
    some = batch.at(torch.tensor([6, 1]))
    assert some.before.tolist() == [3, batch.options[0].item()]
    assert torch.equal(some.steps.actions, batch.steps.actions[[6, 1]])


def test_logits_are_indexed_by_the_option_before_and_at(playing, batch, plain_mlp) -> None:
    parameters = drawn_parameters(playing)
    judge = tuple((parameters[f"discriminator.{n}.weight"], parameters[f"discriminator.{n}.bias"]) for n in range(3))
    found = discriminator_logits(parameters, batch, 3)
    for t, logit in enumerate(found):
        outputs = plain_mlp(judge, torch.cat([batch.steps.states[t], batch.steps.actions[t]])).view(4, 3)
        torch.testing.assert_close(logit, outputs[batch.before[t], batch.options[t]])


def test_the_discriminator_learns_to_tell_them_apart(playing, batch, demonstrations) -> None:
    steps = Steps.of(demonstrations, playing.normalise)
    expert = OptionSteps.of(
        steps._replace(actions=steps.actions + 3), torch.zeros(len(steps.states), dtype=torch.int64), 3
    )
    config = PLAYING.model_copy(update={"discriminator_passes": 100, "learning_rate": 1e-2})
    moved = {name: tensor.clone().requires_grad_() for name, tensor in drawn_parameters(playing).items()}
    before = {name: tensor.detach().clone() for name, tensor in moved.items()}
    metrics = discriminate(moved, batch, expert, config, torch.Generator().manual_seed(0))
    assert metrics["discriminator_accuracy"] == 1
    with torch.no_grad():
        of_policy, of_expert = (discriminator_logits(moved, side, 3) for side in (batch, expert))
    assert imitation_rewards(of_expert).min() > imitation_rewards(of_policy).max()
    for name, tensor in moved.items():
        assert torch.equal(tensor, before[name]) == (not name.startswith("discriminator"))


def test_targets_follow_from_the_values_of_both_levels(playing, batch, rollouts) -> None:
    parameters, discount, both = drawn_parameters(playing), PLAYING.discount, PLAYING.discount * PLAYING.smoothing
    rewards = torch.rand(9, generator=torch.Generator().manual_seed(0))
    beyond = torch.from_numpy(playing.normalise(np.stack([one.observations[-1] for one in rollouts])))
    found = ppo_targets(parameters, batch, rewards, beyond, PLAYING)

    with torch.no_grad():
        low = low_values(parameters, batch)
        high = high_values(parameters, batch.steps.states, batch.before, PLAYING)
        chances = model_of(parameters).log_high(batch.steps.states).exp()
        for t in range(9):
            of_each = [
                low_values(parameters, batch.at(torch.tensor([t]))._replace(options=torch.tensor([option])))
                for option in range(3)
            ]
            torch.testing.assert_close(high[t], (chances[t, batch.before[t]] * torch.cat(of_each)).sum())
        last = high_values(parameters, beyond, batch.options[[4, 5, 8]], PLAYING)

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


def test_improvement_follows_the_advantages_of_each_level(playing, batch) -> None:
    liked = (batch.options == 1).float() * 2 - 1
    high_up = batch.steps.actions[:, 0].sign()
    targets = Targets(liked, high_up, torch.full((9,), 0.5))
    config = PLAYING.model_copy(update={"policy_epochs": 30, "learning_rate": 1e-3})
    moved = {name: tensor.clone().requires_grad_() for name, tensor in drawn_parameters(playing).items()}
    before = {name: tensor.detach().clone() for name, tensor in moved.items()}
    metrics = improve(moved, batch, targets, config, torch.Generator().manual_seed(0))
    with torch.no_grad():
        old, new = (decisions(parameters, batch, config) for parameters in (before, moved))
        errors = [low_values(parameters, batch) - 0.5 for parameters in (before, moved)]
    assert ((new.high - old.high) * liked).mean() > 0
    assert ((new.low - old.low) * high_up).mean() > 0
    assert errors[1].square().mean() < errors[0].square().mean()
    assert metrics["value_error"] == pytest.approx(errors[1].square().mean().item())
    for name, tensor in moved.items():
        assert torch.equal(tensor, before[name]) == name.startswith("discriminator")


@pytest.mark.usefixtures("unchecked")
def test_practice_improves_a_known_reward() -> None:
    """Exploration, advantages and PPO learn a known reward, in place of the discriminator's: where to go, and how."""
    demonstrations = record(0, 2).demonstrations
    config = PLAYING.model_copy(
        update={"sub_skills": 2, "hidden_layers": 1, "hidden_units": 16, "output_scale": 0.1}
        | {"learning_rate": 3e-3, "minibatch": 64, "policy_epochs": 4, "discount": 0.9}
    )
    method = OptionGail.prepared(config, 2, demonstrations)
    moved = {
        name: tensor.requires_grad_() for name, tensor in method.initial_parameters(named_rng(0, "initial")).items()
    }
    means = []
    for iteration in range(25):
        batch = method.sample(demonstrations, config.offline_iterations, named_rng(0, "batch", iteration))
        rollouts = collect_rollouts(method.exploration_policy(moved, batch), "task-0", iteration, 5 * STEPS)
        batch = OptionSteps.of_rollouts(rollouts, method.normalise, 2)
        rewards = -(batch.steps.actions - torch.tensor([-1.0, 0.5])).square().sum(1) + 2.0 * (batch.options == 1)
        last = torch.from_numpy(method.normalise(np.stack([one.observations[-1] for one in rollouts])))
        targets = ppo_targets(moved, batch, rewards, last, config)
        improve(moved, batch, targets, config, torch.Generator().manual_seed(iteration))
        means.append(rewards.mean().item())
    # At first −(1² + 0.5² + 2σ²) + 1 = −2.25; at best 2, less 2σ².
    assert means[0] == pytest.approx(-2.25, abs=0.5)
    assert means[-1] > 0.5
