"""A toy with known skills for all methods: a point that goes east or north, in an order and up to a line of its task's.

Both skills are the same in every task. Which comes first, and on which line x + y = c the other takes over, a method
has to see from the support set.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dmil_core.configs import TrainingConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import Decision, MetaLearner, Policy
from dmil_core.networks import Parameters, flatten, unflatten
from dmil_core.outer_loop import CollectRollouts, OuterState, OuterStep, group_gradient, groups, tasks_of
from dmil_core.seeding import named_rng
from dmil_core.trajectories import Rollout

STEPS, SPEED = 40, 0.05
DIRECTIONS = np.array([[1.0, 0.0], [0.0, 1.0]])
GAINS = 0.1 * np.array([[[0.0, 1.0], [-1.0, 0.0]], [[0.0, -1.0], [1.0, 0.0]]])


class Recorded(NamedTuple):
    """Demonstrations of one task, and the skill that acted at each step of each."""

    demonstrations: list[Demonstration]
    skills: list[np.ndarray]


def _task(number: int) -> tuple[int, float]:
    """Return which skill comes first, and the line where the other takes over."""
    return number % 2, float(named_rng(number, "line").uniform(-0.3, 0.3))


def _start(random: np.random.Generator) -> np.ndarray:
    return random.uniform([-0.7, -0.7], [-0.3, -0.3])


def _skill(task: int, place: np.ndarray) -> int:
    first, line = _task(task)
    return first if place.sum() < line else 1 - first


def record(task: int, episodes: int) -> Recorded:
    """Demonstrate a task."""
    demonstrations, skills = [], []
    for episode in range(episodes):
        place, places, actions, acted = _start(named_rng(task, "start", episode)), [], [], []
        for _ in range(STEPS):
            skill = _skill(task, place)
            places.append(place)
            actions.append(DIRECTIONS[skill] + GAINS[skill] @ place)
            acted.append(skill)
            place = place + SPEED * actions[-1]
        name = f"task-{task}"
        demonstrations.append(
            Demonstration(f"d{episode}", name, np.array(places, np.float32), np.array(actions, np.float32))
        )
        skills.append(np.array(acted))
    return Recorded(demonstrations, skills)


def training_sets(tasks: int = 8, episodes: int = 16) -> dict[str, Sequence[Demonstration]]:
    """Return the demonstrations of tasks 0, 1, and so on, half of either order, by name."""
    return {f"task-{task}": record(task, episodes).demonstrations for task in range(tasks)}


def act_along(policy: Policy, demonstration: Demonstration) -> list[Decision]:
    """Let a policy choose at each state of a demonstration in turn, whatever comes of it there."""
    memory, decisions = policy.start(1), []
    for observation in demonstration.observations:
        decisions.append(policy.act(observation[None], memory))
        memory = decisions[-1].memory
    return decisions


def collect_rollouts(policy: Policy, task: str, seed: int, steps: int) -> list[Rollout]:
    """Let a policy act in a task, `steps` in all; it succeeds where at the end it stands where the expert would."""
    number, rollouts, left = int(task.removeprefix("task-")), [], steps
    while left > 0:
        place = expert = _start(named_rng(seed, "start", len(rollouts)))
        memory, places, actions, chosen = policy.start(1), [place], [], []
        for _ in range(min(STEPS, left)):
            decision = policy.act(place[None].astype(np.float32), memory)
            memory = decision.memory
            actions.append(decision.actions[0])
            chosen.append(decision.sub_skills[0])
            place = place + SPEED * np.clip(actions[-1], -2, 2)
            skill = _skill(number, expert)
            expert = expert + SPEED * (DIRECTIONS[skill] + GAINS[skill] @ expert)
            places.append(place)
        left -= len(actions)
        ended = len(actions) == STEPS
        success = ended and bool(np.linalg.norm(place - expert) < 0.2)
        rollouts.append(
            Rollout(
                np.array(places, np.float32),
                np.array(actions, np.float32),
                solved_at=STEPS - 1 if success else None,
                sub_skills=np.array(chosen),
                ended=ended,
            )
        )
    return rollouts


def meta_trained(
    method: MetaLearner[Any, Any],
    sets: dict[str, Sequence[Demonstration]],
    training: TrainingConfig,
    collect_rollouts: CollectRollouts = collect_rollouts,
) -> Parameters:
    """Meta-train in this process, from seed 0, and return the parameters."""
    initial = method.initial_parameters(named_rng(0, "initial parameters"))
    shapes = {name: tensor.shape for name, tensor in initial.items()}
    step = OuterStep(OuterState.start(flatten(initial).numpy()), training)
    for iteration in range(training.iterations):
        tasks = tasks_of(iteration, list(sets), 0, training.tasks_per_iteration)
        (slots,) = groups(training.model_copy(update={"slots_per_group": training.tasks_per_iteration}))
        parameters = unflatten(step.parameters, shapes)
        step(group_gradient(method, sets, parameters, 0, iteration, tasks, slots, collect_rollouts).gradient)
    return unflatten(step.parameters, shapes)


def recovered(skills: Sequence[np.ndarray], chosen: Sequence[np.ndarray]) -> float:
    """Return the share of steps where two sub-skills are the two skills, named the better way round."""
    agreement = float((np.concatenate(skills) == np.concatenate(chosen)).mean())
    return max(agreement, 1 - agreement)
