"""Controls: what simpler things do with the same support sets in the same episodes of new tasks.

A success rate says little of few-shot learning by itself: a policy may do as well without its demonstrations, and on a
task whose starts hardly differ so may a copy of them. So the run's policy is laid beside itself without fine-tuning,
with another task's support set, and with shuffled actions, and beside two methods that learn nothing. Differences are
of the same episodes; their intervals resample tasks, support sets and episodes.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel

from dmil_core.configs import Control, ExperimentConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.methods.registry import method_type
from dmil_core.seeding import named_rng
from dmil_core.statistics import interval_text, nested_bootstrap
from services.distributed.runner import Runner
from services.distributed.work_items import AdaptationRollouts
from services.evaluation.results import EpisodeResult

WORDS: Mapping[Control, str] = {
    "no-adaptation": "no fine-tuning",
    "other-support": "another task's demonstrations",
    "shuffled-actions": "shuffled actions",
    "nearest-neighbour": "nearest neighbour",
    "tracking": "tracking",
}
HEAD = ("control on new tasks", "shots", "successes", "success rate", "run − control", "95% interval")


class ControlRow(BaseModel):
    """A control with one size of support set, on all meta-testing tasks."""

    control: Control
    shots: int
    episodes: int
    success_rate: float
    difference: float
    """The run's success rate in the same episodes, minus this one."""
    low: float
    high: float

    @property
    def fields(self) -> list[str]:
        """Its row of a table, see `HEAD`."""
        successes = f"{round(self.success_rate * self.episodes)}/{self.episodes}"
        interval = interval_text(self.low, self.high, 3, "+")
        named = WORDS[self.control]
        return [named, str(self.shots), successes, f"{self.success_rate:.3f}", f"{self.difference:+.3f}", interval]


def control_items(
    control: Control,
    items: Sequence[AdaptationRollouts],
    config: ExperimentConfig,
    action_dim: int,
    runner: Runner,
    training_sets: Mapping[str, Sequence[Demonstration]],
    held_out: Mapping[str, Sequence[Demonstration]],
) -> list[AdaptationRollouts]:
    """Return the work items of a control, one for each of the run's own on meta-testing tasks.

    A method without learning takes the scale of observations from `training_sets`; support sets are drawn from
    `held_out`, the demonstrations of at least two tasks.
    """
    if control == "no-adaptation":
        evaluation = config.evaluation.model_copy(update={"fine_tuning_steps": 0, "displaced": 0})
        return [dataclasses.replace(item, evaluation=evaluation) for item in items]
    if control in ("other-support", "shuffled-actions"):
        change = _of_another_task if control == "other-support" else _shuffled
        tasks = dict.fromkeys(item.adaptation.task for item in items)
        shared = {task: runner.share(change(task, held_out)) for task in tasks}
        return [dataclasses.replace(item, held_out=shared[item.adaptation.task]) for item in items]
    kind = method_type(control)
    settings = kind.config_type(name=control, features=config.method.features)
    everything = [one for task in training_sets.values() for one in task]
    method = kind.prepared(settings, action_dim, everything, config.suite.points)
    nothing = runner.share(np.zeros(0, np.float32))
    return [dataclasses.replace(item, method=method, shapes={}, flat_parameters=nothing) for item in items]


def _of_another_task(task: str, held_out: Mapping[str, Sequence[Demonstration]]) -> Sequence[Demonstration]:
    """Return the demonstrations of the task that comes after one in order, the first after the last."""
    tasks = list(held_out)
    return held_out[tasks[(tasks.index(task) + 1) % len(tasks)]]


def _shuffled(task: str, held_out: Mapping[str, Sequence[Demonstration]]) -> Sequence[Demonstration]:
    """Return a task's demonstrations, the actions of each in another order."""
    rng = named_rng(0, "shuffled", task)
    return [dataclasses.replace(one, actions=one.actions[rng.permutation(len(one))]) for one in held_out[task]]


def control_rows(control: Control, episodes: Sequence[EpisodeResult], run: Sequence[EpisodeResult]) -> list[ControlRow]:
    """Return a row for each size of support set, from the control's episodes and the run's."""
    outcomes = {_key(row): row.success for row in run}
    rows = []
    for shots in sorted({row.shots for row in episodes}):
        of_shots = [row for row in episodes if row.shots == shots]
        nested = _nested({_key(row): float(outcomes[_key(row)]) - row.success for row in of_shots})
        mean, low, high, *_ = nested_bootstrap(nested, named_rng(0, "control", control, shots))
        rate = float(np.mean([row.success for row in of_shots]))
        rows.append(
            ControlRow(
                control=control,
                shots=shots,
                episodes=len(of_shots),
                success_rate=rate,
                difference=mean,
                low=low,
                high=high,
            )
        )
    return rows


def _key(row: EpisodeResult) -> tuple[Any, ...]:
    return row.shots, row.task, row.draw, row.episode


def _nested(values: Mapping[tuple[Any, ...], float]) -> list[list[list[float]]]:
    """Return values by task, support set and episode."""
    tasks: dict[str, dict[int, list[float]]] = {}
    for (_, task, draw, _), value in sorted(values.items()):
        tasks.setdefault(task, {}).setdefault(draw, []).append(value)
    return [list(draws.values()) for draws in tasks.values()]


def control_sentences(rows: Sequence[ControlRow]) -> list[str]:
    """Return in a sentence for each size of support set what fine-tuning added, and how the best control compares."""
    sentences = []
    for shots in sorted({row.shots for row in rows}):
        of_shots = {row.control: row for row in rows if row.shots == shots}
        parts = []
        if plain := of_shots.get("no-adaptation"):
            parts.append(f"fine-tuning adds {_signed(plain)}")
        others = [row for row in of_shots.values() if row.control != "no-adaptation"]
        if others:
            best = max(others, key=lambda row: row.success_rate)
            where = "above the run" if best.high < 0 else "below the run" if best.low > 0 else "not decided against it"
            parts.append(f"the best control, {WORDS[best.control]}, is {where}: run − control {_signed(best)}")
        sentences.append(f"{shots}-shot on new tasks: {'; '.join(parts)}")
    return sentences


def _signed(row: ControlRow) -> str:
    return f"{row.difference:+.3f} ({interval_text(row.low, row.high, 3, '+')})"
