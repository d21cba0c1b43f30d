"""MLSH at test: the high level learned anew, and the policy that holds a sub-skill for a macro-step."""

import itertools

import numpy as np
import pytest
import torch

from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import FineTuning
from dmil_core.methods.mlsh.config import MlshConfig
from dmil_core.methods.mlsh.method import Mlsh
from dmil_core.methods.mlsh.policy import MlshPolicy
from dmil_core.networks import flatten, initialise, mlp, network
from dmil_core.seeding import named_rng
from tests.dmil_core.methods.conftest import SMALL_MLSH
from tests.dmil_core.methods.toys import act_along


@pytest.fixture
def method(demonstrations) -> Mlsh:
    return Mlsh.prepared(SMALL_MLSH, 3, demonstrations)


@pytest.fixture
def policy(method) -> MlshPolicy:
    """Return a policy of random networks, its choice anything but constant."""
    bank = method.initial_parameters(named_rng(1, "initial"))
    adapted = method.adapt(bank, [demonstration_of(np.zeros((1, 4)))], FineTuning(0, 0.1))
    high = network(initialise("high", [4, 8, 3], named_rng(0, "high")), "high")
    return MlshPolicy(high, adapted.low, adapted.macro_step, adapted.normalise)


def demonstration_of(observations: np.ndarray) -> Demonstration:
    return Demonstration("d", "reach", observations.astype(np.float32), np.zeros((len(observations), 3), np.float32))


def test_a_sub_skill_is_held_for_a_macro_step_and_then_chosen_anew(policy) -> None:
    """Episodes differ, one ends early, and each goes on as if it were alone."""
    observations = np.random.default_rng(0).normal(size=(3, 11, 4)).astype(np.float32)
    memory, acted, going = policy.start(3), [[], [], []], [0, 1, 2]
    for step in range(11):
        if step == 5:
            memory, going = memory[[0, 2]], [0, 2]
        decision = policy.act(observations[going, step], memory)
        memory = decision.memory
        for row, episode in enumerate(going):
            acted[episode].append((decision.sub_skills[row], decision.actions[row]))
    switches = 0
    for episode, steps in enumerate(acted):
        states = torch.from_numpy(policy.normalise(observations[episode]))
        modes = mlp(policy.high, states).argmax(-1).tolist()
        chosen = [int(sub_skill) for sub_skill, _ in steps]
        assert chosen == [modes[t - t % 3] for t in range(len(steps))]
        assert chosen != modes[: len(chosen)]
        switches += sum(a != b for a, b in itertools.pairwise(chosen))
        for state, (sub_skill, action) in zip(states, steps, strict=False):
            np.testing.assert_allclose(action, mlp(policy.low[sub_skill], state[None])[0], rtol=1e-5, atol=1e-6)
    assert switches > 3


def test_the_memory_is_the_steps_done_and_the_sub_skill(policy) -> None:
    observations, memory = np.ones((2, 4), np.float32), policy.start(2)
    assert memory.dtype == np.int64
    for done in (1, 2, 0, 1):
        before = memory.copy()
        decision = policy.act(observations, memory)
        assert np.array_equal(memory, before)
        memory = decision.memory
        assert memory[:, 0].tolist() == [done] * 2
        assert np.array_equal(memory[:, 1], decision.sub_skills)


def test_sub_skill_use_is_the_choice_along_the_demonstration_and_the_best_fit(policy) -> None:
    random = np.random.default_rng(0)
    observations, actions = (random.normal(size=(10, size)).astype(np.float32) for size in (4, 3))
    demonstration = Demonstration("d", "reach", observations, actions)
    use = policy.sub_skill_use(demonstration)
    assert use.chosen.tolist() == [decision.sub_skills.item() for decision in act_along(policy, demonstration)]
    states = torch.from_numpy(policy.normalise(observations))
    errors = [np.square(mlp(sub_skill, states).numpy() - actions).sum(1) for sub_skill in policy.low]
    assert use.best.tolist() == np.argmin(errors, axis=0).tolist()
    assert len(set(use.best.tolist())) > 1


def test_no_episode_is_an_answer_too(policy) -> None:
    decision = policy.act(np.zeros((0, 4), np.float32), policy.start(0))
    assert decision.actions.shape == (0, 3)
    assert decision.memory.shape == (0, 2)


def test_adaptation_learns_a_high_level_and_leaves_the_sub_skills(method, demonstrations) -> None:
    parameters = method.initial_parameters(named_rng(0, "initial"))
    before = flatten(parameters)
    policies = [method.adapt(parameters, demonstrations[:2], FineTuning(steps, 0.1)) for steps in (0, 4, 4)]
    assert torch.equal(flatten(parameters), before)
    highs = [torch.cat([tensor.flatten() for layer in policy.high for tensor in layer]) for policy in policies]
    assert not torch.equal(highs[0], highs[1])
    assert torch.equal(highs[1], highs[2])
    for policy in policies:
        for k, sub_skill in enumerate(policy.low):
            for index, layer in enumerate(sub_skill):
                rows = 3 if index == 2 else 8
                assert torch.equal(layer.weight, parameters[f"low.{index}.weight"][k, :rows])
                assert torch.equal(layer.bias, parameters[f"low.{index}.bias"][k, :rows])


@pytest.mark.usefixtures("unchecked")
def test_a_fresh_high_level_finds_the_better_sub_skill(make_demonstrations) -> None:
    """Two sub-skills stand still at 0 and at 1; the demonstration wants 1 where its first coordinate is positive."""
    (drawn,) = make_demonstrations(0, [90])
    states = drawn.observations.repeat(3, axis=0)
    wanted = states[:, 0] > 0
    demonstration = Demonstration("d", "reach", states, wanted[:, None].astype(np.float32).repeat(3, axis=1))
    config = MlshConfig(sub_skills=2, hidden_layers=1, hidden_units=32, batch_size=270)
    method = Mlsh.prepared(config, 3, [demonstration])
    parameters = {
        name: torch.zeros_like(tensor) for name, tensor in method.initial_parameters(named_rng(0, "initial")).items()
    }
    parameters["low.1.bias"][1, :3] = 1.0
    policy = method.adapt(parameters, [demonstration], FineTuning(300, 1e-2))
    use = policy.sub_skill_use(demonstration)
    assert np.array_equal(use.best, wanted)
    assert (use.chosen == wanted).mean() >= 0.95
