"""Meta-World's steps and whole evaluations, as Meta-World does them and as this project does, side by side.

Steps: for each task the expert's episodes are recorded once. Then the stock environment and ours execute the recorded
actions, and bare physics (``mj_step`` for the same number of steps) the very same controls from the same states, in
alternation. Evaluations: the same policy for the same numbers of tasks and episodes, and the same horizon, through
``metaworld.evaluation`` on Meta-World's own asynchronous vector environment, and through this project's simulation
workers, one process for each core.
Everything shares the cores that the process may use, so ``taskset -c 0`` measures one core.
"""

import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from statistics import median
from typing import Any, NamedTuple

import gymnasium
import metaworld.evaluation
import mujoco as compiled_mujoco
import numpy as np
import torch
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

from benchmarks.harness import BenchmarkArguments, Row, alternate, lay_out, main
from dmil_core.configs import PRESETS, EvaluationConfig, SuiteConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import FineTuning, Policy
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.method import Dmil
from dmil_core.networks import Parameters, flatten
from dmil_core.seeding import named_rng
from services.cli.progress import console
from services.distributed.simulation_worker import SimulationWorker
from services.distributed.work_items import AdaptationRollouts
from services.rollouts.adaptations import AdaptationOutcome, plan_adaptations
from services.rollouts.episodes import demonstrate
from services.suites.metaworld import SPLITS, MetaWorldSuite, SeededEpisodes

mujoco: Any = compiled_mujoco  # compiled, so a type checker sees nothing of it

STEPS_TARGET, PHYSICS_TARGET, EVALUATION_TARGET = 1.8, 0.6, 2.5
"""Ours over stock steps/s; ours over bare physics; Meta-World's seconds of an evaluation over ours."""
DRAWS = 4
"""Adaptations that a task's episodes are spread over, as in this project's evaluations."""
EXPERT_STEPS = 300
"""In an expert's episode at most."""
TRAILING_STEPS = 10
"""An expert's episode goes on for so long after success, as when demonstrations are collected."""


@dataclass(frozen=True)
class Arguments(BenchmarkArguments):
    """Arguments of ``benchmarks.simulation``."""

    tasks: tuple[str, ...] = tuple(task for part in SPLITS["ml10"] for task in part)
    """Tasks whose steps are timed."""
    episodes: int = 3
    """Of the expert, in each task."""
    rounds: int = 7
    """Alternations of stock, ours and physics in each task."""
    evaluation_tasks: tuple[str, ...] = SPLITS["ml10"][1]
    """Tasks of the whole evaluations."""
    evaluation_episodes: int = 20
    """Of each task in an evaluation."""
    evaluation_rounds: int = 3
    """Alternations of the two evaluations; 0 leaves them out."""
    horizon: int = 500
    """Steps in an episode of an evaluation, Meta-World's own."""
    fine_tuning_steps: int = 300
    """Of the policy that both evaluations drive, on demonstrations of all evaluation tasks together."""
    quick: bool = False
    """Two tasks, one round, a small evaluation: to see that it runs."""


def run(args: Arguments) -> Sequence[Row]:
    """Run the benchmark."""
    if args.quick:
        args = Arguments(
            tasks=args.tasks[:2],
            episodes=1,
            rounds=1,
            evaluation_tasks=args.evaluation_tasks[:2],
            evaluation_episodes=2,
            evaluation_rounds=1,
            horizon=50,
            fine_tuning_steps=5,
        )
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    suite = MetaWorldSuite(SuiteConfig(train_tasks=args.tasks, test_tasks=args.evaluation_tasks))
    for task in args.tasks:
        rows.append(step_row(suite, task, args.episodes, args.rounds))
        console.print(f"{task}: {rows[-1]['ratio']:.2f} times stock")
    rows.append(median_row(rows))
    console.print(lay_out("Steps per second and core, driven by the experts", [step_cells(row) for row in rows]))
    verdict("steps/s over stock, median over tasks", rows[-1]["ratio"], STEPS_TARGET)
    verdict("steps/s over bare physics, median over tasks", rows[-1]["physics_share"], PHYSICS_TARGET)
    if args.evaluation_rounds:
        rows.append(evaluation_row(args))
        print_evaluation(rows[-1])
        verdict("whole evaluations over Meta-World's", rows[-1]["ratio"], EVALUATION_TARGET)
    return rows


def verdict(what: str, got: float, target: float) -> None:
    """Print a ratio beside its target."""
    console.print(f"{what}: {got:.2f}, target {target}: {'met' if got >= target else 'MISSED'}")


# Steps


class Episode(NamedTuple):
    """One recorded episode: its actions, and where its physics began and what drove it."""

    actions: list[np.ndarray]
    body_pos: np.ndarray
    start: np.ndarray
    controls: list[tuple[np.ndarray, np.ndarray]]
    """Actuator controls and position of the mocap body, for each step of the environment."""


def stock_env(task: str) -> Any:
    """Build Meta-World's own goal-visible environment, drawing episodes from its own stream."""
    env: Any = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"]()
    env._freeze_rand_vec, env.seeded_rand_vec = False, True
    return env


def record(suite: MetaWorldSuite, env: Any, task: str, seed: int) -> Episode:
    """Let the expert act in a stock environment until some steps after success, and keep all that drove it."""
    expert = suite.expert(task)
    observation, _ = env.reset(seed=seed)
    inner = env.unwrapped
    body_pos, start, actions, controls = inner.model.body_pos.copy(), state_of(inner), [], []
    end = EXPERT_STEPS
    while len(actions) < end:
        action = np.clip(expert.get_action(observation.copy()), -1, 1).astype(np.float32)
        observation, _, _, _, info = env.step(action)
        actions.append(action)
        controls.append((inner.data.ctrl.copy(), inner.data.mocap_pos.copy()))
        if info["success"] and end == EXPERT_STEPS:
            end = min(end, len(actions) + TRAILING_STEPS)
    return Episode(actions, body_pos, start, controls)


def state_of(env: Any) -> np.ndarray:
    """Return all that the next step of an environment's physics depends on."""
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(env.model, kind))
    mujoco.mj_getState(env.model, env.data, state, kind)
    return state


def rewind_physics(env: Any, episode: Episode) -> None:
    """Put an environment's physics where an episode began."""
    env.model.body_pos[:] = episode.body_pos
    mujoco.mj_resetData(env.model, env.data)
    mujoco.mj_setState(env.model, env.data, episode.start, mujoco.mjtState.mjSTATE_INTEGRATION)


def replay_physics(env: Any, episode: Episode) -> None:
    """Execute an episode's controls with ``mj_step`` alone."""
    model, data, ctrl, mocap = env.model, env.data, env.data.ctrl, env.data.mocap_pos
    for control, position in episode.controls:
        ctrl[:], mocap[:] = control, position
        mujoco.mj_step(model, data, nstep=env.frame_skip)


def replay(env: Any, episode: Episode) -> None:
    """Execute an episode's actions."""
    for action in episode.actions:
        env.step(action)


def step_row(suite: MetaWorldSuite, task: str, episodes: int, rounds: int) -> dict[str, Any]:
    """Time the steps of one task's recorded episodes: stock, ours and bare physics in alternation; resets apart."""
    stock, ours, physics = SeededEpisodes(stock_env(task)), suite.make_env(task), stock_env(task)
    seconds: dict[str, float] = {"stock": 0.0, "ours": 0.0, "physics": 0.0}
    steps = 0
    for seed in range(episodes):
        episode = record(suite, stock, task, seed)
        times = alternate(
            {
                "stock": partial(replay, stock, episode),
                "ours": partial(replay, ours, episode),
                "physics": partial(replay_physics, physics, episode),
            },
            rounds,
            prepare={
                "stock": partial(stock.reset, seed=seed),
                "ours": partial(ours.reset, seed=seed),
                "physics": partial(rewind_physics, physics, episode),
            },
        )
        seconds = {name: seconds[name] + median(values) for name, values in times.items()}
        steps += len(episode.actions)
    return {
        "task": task,
        "steps": steps,
        "rounds": rounds,
        **{f"{name}_steps_per_s": steps / value for name, value in seconds.items()},
        "ratio": seconds["stock"] / seconds["ours"],
        "physics_share": seconds["physics"] / seconds["ours"],
    }


def median_row(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the median over tasks of each column."""
    columns = [name for name in rows[0] if name not in ("task", "steps", "rounds")]
    return {"task": "median", "tasks": len(rows), **{name: median(row[name] for row in rows) for name in columns}}


def step_cells(row: Row) -> dict[str, str]:
    """Return the table's cells of a task, or of the median."""
    names = {"stock": "stock", "ours": "ours", "physics alone": "physics"}
    rates = {head: f"{row[f'{name}_steps_per_s']:.0f}" for head, name in names.items()}
    ratios = {"ours / stock": f"{row['ratio']:.2f}", "ours / physics": f"{row['physics_share']:.2f}"}
    return {"task": row["task"]} | rates | ratios


# Whole evaluations

worker: SimulationWorker
"""Of a process that rolls out, once it has started."""


class StockAgent:
    """A policy as Meta-World's evaluation wants it; counts its calls and their seconds."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self.calls, self.seconds = 0, 0.0

    def eval_action(self, observations: np.ndarray) -> np.ndarray:
        """Choose an action for each environment."""
        started = time.perf_counter()
        actions = self._policy.act(observations.astype(np.float32), self._policy.start(len(observations))).actions
        self.seconds += time.perf_counter() - started
        self.calls += 1
        return np.clip(actions, -1, 1)

    def reset(self, env_mask: np.ndarray) -> None:
        """Forget nothing."""


def one_policy(
    suite: MetaWorldSuite, tasks: Sequence[str], steps: int
) -> tuple[Dmil, Parameters, dict[str, list[Demonstration]]]:
    """Fine-tune a policy of the quick preset's size on demonstrations of all tasks together, from its first weights.

    Returns:
        The method, the policy's parameters, and four demonstrations of each task.
    """
    config = PRESETS["ml10-quick"]
    demonstrations: dict[str, list[Demonstration]] = {task: [] for task in tasks}
    for task, of_task in demonstrations.items():
        env, seed = suite.make_env(task), 0
        while len(of_task) < DRAWS:
            attempt = demonstrate(suite.expert(task), env, seed, EXPERT_STEPS, config.demonstrations)
            if attempt.solved_at is not None:
                of_task.append(Demonstration(str(seed), task, attempt.observations[:-1], attempt.actions))
            seed += 1
    support = [demonstration for of_task in demonstrations.values() for demonstration in of_task]
    assert isinstance(config.method, DmilConfig)
    method = Dmil.prepared(config.method, suite.action_dim, support, suite.points)
    initial = method.initial_parameters(named_rng(config.seed, "initial parameters"))
    policy = method.adapt(initial, support, FineTuning(steps, config.evaluation.learning_rate))
    return method, {**initial, **policy.hierarchy.parameters}, demonstrations


def start_worker(suite: MetaWorldSuite) -> None:
    """Make this process's simulation worker."""
    global worker
    worker = SimulationWorker(suite)


def run_item(item: AdaptationRollouts) -> AdaptationOutcome:
    """Run a work item on this process's simulation worker."""
    return worker.run(item)


def evaluation_row(args: Arguments) -> dict[str, Any]:
    """Time whole evaluations of one policy, Meta-World's and ours, in alternation."""
    cores = len(os.sched_getaffinity(0))
    tasks, episodes = args.evaluation_tasks, args.evaluation_episodes
    suite = MetaWorldSuite(SuiteConfig(test_tasks=tasks, horizon=args.horizon))
    method, parameters, demonstrations = one_policy(suite, tasks, args.fine_tuning_steps)
    policy = method.adapt(parameters, demonstrations[tasks[0]], FineTuning(0, 0.0))
    settings = EvaluationConfig(shots=(1,), episodes=episodes, support_draws=DRAWS, fine_tuning_steps=0)
    plan = plan_adaptations([("meta-testing", task) for task in tasks], settings)
    shapes = {name: tensor.shape for name, tensor in parameters.items()}
    flat = partial(np.array, flatten(parameters).numpy())
    held_out = {task: partial(list, of_task) for task, of_task in demonstrations.items()}
    items = [
        AdaptationRollouts(method, shapes, flat, adaptation, held_out[adaptation.task], settings, 0)
        for adaptation in plan
    ]
    agents: list[StockAgent] = []
    outcomes: list[AdaptationOutcome] = []
    envs: Any = gymnasium.make_vec(
        "Meta-World/custom-mt-envs",
        vector_strategy="async",
        envs_list=[f"{task}-v3" for task in tasks],
        max_episode_steps=args.horizon,
        seed=1,
    )

    def stock() -> None:
        agents.append(StockAgent(policy))
        metaworld.evaluation.evaluation(agents[-1], envs, episodes)

    # Processes that live on, as those of the vector environment do; an actor of Ray does this work in an experiment.
    with ProcessPoolExecutor(cores, get_context("spawn"), start_worker, (suite,)) as pool:

        def ours() -> None:
            outcomes[:] = pool.map(run_item, items)

        both = {"stock": stock, "ours": ours}
        alternate(both, 1)  # builds the environments
        agents.clear()
        times = alternate(both, args.evaluation_rounds)
    envs.close()
    act = alternate({"act": partial(StockAgent(policy).eval_action, np.zeros((episodes // DRAWS, 39)))}, 101)
    seconds = {name: median(values) for name, values in times.items()}
    ended = [episode for outcome in outcomes for episode in outcome.episodes]
    calls = sum(max(episode.steps for episode in outcome.episodes) for outcome in outcomes)
    return {
        "task": "evaluation",
        "tasks": len(tasks),
        "episodes": episodes,
        "horizon": args.horizon,
        "cores": cores,
        "rounds": args.evaluation_rounds,
        "stock_seconds": seconds["stock"],
        "ours_seconds": seconds["ours"],
        "ratio": seconds["stock"] / seconds["ours"],
        "stock_steps": median(agent.calls for agent in agents) * len(tasks),
        "ours_steps": sum(episode.steps for episode in ended),
        "ours_success_rate": sum(episode.success for episode in ended) / len(ended),
        "stock_policy_share": median(agent.seconds for agent in agents) / seconds["stock"],
        "ours_policy_share": calls * median(act["act"]) / cores / seconds["ours"],
    }


def print_evaluation(row: Row) -> None:
    """Print the row of the evaluations."""
    title = f"{row['episodes']} episodes x {row['tasks']} tasks of {row['horizon']} steps, cores: {row['cores']}"
    caption = (
        "An episode ends at success in both. Meta-World's go on in all environments until the slowest task has "
        "its episodes; ours are done when they are. Environments are built before."
    )
    cells = [
        {
            "": whose,
            "seconds": f"{row[f'{name}_seconds']:.2f}",
            "steps executed": f"{row[f'{name}_steps']:.0f}",
            "steps/s": f"{row[f'{name}_steps'] / row[f'{name}_seconds']:.0f}",
            "share of the policy": f"{row[f'{name}_policy_share']:.0%}",
        }
        for name, whose in (("stock", "metaworld.evaluation"), ("ours", "ours"))
    ]
    console.print(lay_out(title, cells, caption=caption))


if __name__ == "__main__":
    main(run, Arguments(), __doc__)
