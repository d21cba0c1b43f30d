"""How an option model acts: its most probable option at test, and draws that are its episode's own in practice."""

from dataclasses import replace

import numpy as np
import torch

from dmil_core.demonstrations import Demonstration
from dmil_core.losses import Steps
from dmil_core.methods.base import FineTuning
from dmil_core.methods.option_gail.method import OptionGail
from dmil_core.methods.option_gail.policy import OptionExplorationPolicy
from dmil_core.seeding import named_rng
from tests.dmil_core.methods.conftest import drawn_parameters, model_of
from tests.dmil_core.methods.toys import act_along


def test_the_most_probable_option_after_the_last_one_acts(offline, demonstrations, plain_mlp) -> None:
    parameters = drawn_parameters(offline)
    policy = offline.adapt(parameters, demonstrations[:1], FineTuning(0, 0.01))
    assert policy.start(2).tolist() == [[3], [3]]
    observations = np.concatenate([one.observations for one in demonstrations])
    last = np.random.default_rng(0).integers(0, 4, (len(observations), 1))
    decision = policy.act(observations, last)
    states, model = torch.from_numpy(offline.normalise(observations)), model_of(parameters)
    assert len(set(decision.sub_skills.tolist())) > 1
    for state, before, option, action in zip(states, last[:, 0], decision.sub_skills, decision.actions, strict=True):
        assert option == plain_mlp(model.high, state).view(4, 3)[before].argmax()
        np.testing.assert_allclose(action, plain_mlp(model.low[option], state), rtol=1e-4, atol=1e-5)
    assert np.array_equal(decision.memory[:, 0], decision.sub_skills)


def test_sub_skill_use_is_what_the_policy_takes_and_the_best_fit(offline, demonstrations) -> None:
    parameters, shown = drawn_parameters(offline), demonstrations[2]
    policy = offline.adapt(parameters, demonstrations[:1], FineTuning(0, 0.01))
    use = policy.sub_skill_use(shown)
    assert use.chosen.tolist() == [decision.sub_skills.item() for decision in act_along(policy, shown)]
    steps, model = Steps.of([shown], offline.normalise), model_of(parameters)
    assert use.best.tolist() == model.log_low(steps.states, steps.actions).argmax(1).tolist()


def explorer_of(method: OptionGail, seed: int, demonstrations: list[Demonstration]) -> OptionExplorationPolicy:
    batch = replace(method.sample(demonstrations, 4, named_rng(0, "batch")), seed=seed)
    return method.exploration_policy(drawn_parameters(method), batch)


def test_what_is_drawn_does_not_depend_on_who_else_acts(playing, demonstrations) -> None:
    exploration_policy = explorer_of(playing, 7, demonstrations)
    observations = np.random.default_rng(1).normal(size=(4, 5, 4)).astype(np.float32)

    def act(dropped_at: dict[int, int]) -> dict[tuple[int, int], tuple[int, np.ndarray]]:
        alive, memory, done = np.arange(5), exploration_policy.start(5), {}
        for step, seen in enumerate(observations):
            going = np.array([dropped_at.get(int(one), 9) > step for one in alive])
            alive, memory = alive[going], memory[going]
            decision = exploration_policy.act(seen[alive], memory)
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
    exploration_policy, other_seed = (explorer_of(playing, seed, demonstrations) for seed in (7, 8))
    first, second = np.random.default_rng(1).normal(size=(2, 1, 4)).astype(np.float32)

    def noise(policy: OptionExplorationPolicy, begun: np.ndarray) -> np.ndarray:
        """Draw two steps' actions, the second in the same state whatever came first."""
        memory = policy.act(begun, policy.start(1)).memory
        assert memory[0, 1] == 1
        decision = policy.act(first, memory)
        states = torch.from_numpy(policy.normalise(first))
        options = torch.from_numpy(decision.sub_skills)
        mean, deviation = policy.model.means(states, options), policy.model.log_deviations[options].exp()
        return (decision.actions - mean.numpy()) / deviation.numpy()

    np.testing.assert_allclose(noise(exploration_policy, first), noise(exploration_policy, first))
    assert not np.allclose(noise(exploration_policy, first), noise(exploration_policy, second))
    assert not np.allclose(noise(exploration_policy, first), noise(other_seed, first))


def test_draws_are_from_the_model(playing, demonstrations) -> None:
    exploration_policy, count = explorer_of(playing, 7, demonstrations), 4000
    observations = np.repeat(demonstrations[0].observations[:1], count, axis=0)
    memory = exploration_policy.start(count)
    memory[:, 0] = 1
    decision = exploration_policy.act(observations, memory)
    state = torch.from_numpy(exploration_policy.normalise(observations[:1]))
    shares = np.bincount(decision.sub_skills, minlength=3) / count
    np.testing.assert_allclose(shares, exploration_policy.model.log_high(state)[0, 1].exp().numpy(), atol=0.03)
    for k in range(3):
        own = decision.actions[decision.sub_skills == k]
        deviations = exploration_policy.model.log_deviations[k].exp().numpy()
        np.testing.assert_allclose(
            (own.mean(0) - exploration_policy.model.means(state, torch.tensor([k])).numpy()[0]) / deviations,
            np.zeros(3),
            atol=4 / len(own) ** 0.5,
        )
        np.testing.assert_allclose(own.std(0) / deviations, np.ones(3), atol=4 / len(own) ** 0.5)
