"""Several runs of one kind of robot on the same tasks, and their policies before and after adaptation."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import NamedTuple

import torch

from dmil_core.demonstrations import Demonstration
from dmil_core.errors import UserError
from dmil_core.methods.base import Policy
from dmil_core.settings import sub_skills_of
from services.distributed.runner import LocalRunner
from services.experiments.experiment import Experiment
from services.experiments.finished_run import FinishedRun

MOST_TASKS = 4
"""So many of a run's meta-testing tasks are shown, unless tasks are named."""
ADAPTATIONS = ("before", "after")
"""Before adaptation a policy has taken no fine-tuning step on the support set."""


class Shots(NamedTuple):
    """A task's held-out demonstrations, as they are used."""

    support: Sequence[Demonstration]
    """Those that are adapted to."""
    others: Sequence[Demonstration]
    """Those whose states are shown."""


@dataclass(frozen=True)
class RunGroup:
    """Runs by their labels, and the tasks and demonstrations that they are shown on."""

    runs: Mapping[str, FinishedRun]
    experiment: Experiment
    """The first run's, on the tasks that are shown."""
    held_out: Mapping[str, Sequence[Demonstration]]
    """Of each task that is shown, the demonstrations that meta-training has not seen."""

    def shots(self, task: str, count: int, others: int | None = None) -> Shots:
        """Return the first support set of a task, and the demonstrations after it, at most so many.

        Raises:
            UserError: if no demonstration is left besides the support set.
        """
        held_out = self.held_out[task]
        if len(held_out) <= count:
            raise UserError(
                f"--shots: got {count}; wanted fewer than the {len(held_out)} held-out demonstrations of {task}, so "
                "that some are left to show"
            )
        return Shots(held_out[:count], held_out[count:][:others])


def group_runs(runs: Mapping[str, FinishedRun], tasks: Sequence[str] | None = None) -> RunGroup:
    """Put runs side by side on some tasks.

    The tasks are of their kind of robot, the runs' own or others; the first run's meta-testing tasks, at most
    `MOST_TASKS`, if none are named.

    Raises:
        UserError: if the runs are of different robots, or their demonstrations made or held out otherwise, or for a
            task that there is not.
    """
    (first, run), *others = runs.items()
    for label, other in others:
        _check_alike(first, run, label, other)
    wanted = tuple(dict.fromkeys(tasks or run.experiment.suite.test_tasks[:MOST_TASKS]))
    if set(wanted) <= {task for _, task in run.experiment.tasks}:
        experiment, data = run.experiment, run.demonstrations
    else:
        suite = run.config.suite.model_copy(update={"test_tasks": wanted})
        experiment = Experiment(run.config.model_copy(update={"suite": suite}), run.experiment.store)
        with closing(LocalRunner(experiment.suite)) as runner:
            data = experiment.collect(runner)
    held_out = experiment.held_out_sets(data)
    return RunGroup(runs, experiment, {task: held_out[task] for task in wanted})


def _check_alike(first: str, run: FinishedRun, label: str, other: FinishedRun) -> None:
    settings = [
        {
            "robot": each.experiment.suite.family,
            "protocol": each.experiment.suite.protocol,
            **each.config.demonstrations.model_dump(),
        }
        for each in (run, other)
    ]
    if differing := [field for field in settings[0] if settings[0][field] != settings[1][field]]:
        got = ", ".join(f"{field} {settings[1][field]!r}" for field in differing)
        wanted = ", ".join(repr(settings[0][field]) for field in differing)
        raise UserError(f"{label}: got {got}; wanted {wanted}, as {first} has; show them on pages of their own")


def has_sub_skills(run: FinishedRun) -> bool:
    """Tell whether the high level of a run's method has a choice."""
    return sub_skills_of(run.config.method) > 1


def policy_after(run: FinishedRun, support: Sequence[Demonstration], steps: int) -> Policy:
    """Return a run's policy for a support set after some fine-tuning steps of its newest checkpoint."""
    method = run.checkpoint.method(run.experiment.suite.action_dim)
    parameters = {name: torch.from_numpy(array) for name, array in run.checkpoint.parameters.items()}
    return method.adapt(parameters, support, run.config.evaluation.fine_tuning._replace(steps=steps))


def policies(run: FinishedRun, support: Sequence[Demonstration]) -> dict[str, Policy]:
    """Return a run's policies before and after adaptation to a support set, by the fine-tuning of its evaluation."""
    counts = (0, run.config.evaluation.fine_tuning_steps)
    return {name: policy_after(run, support, count) for name, count in zip(ADAPTATIONS, counts, strict=True)}
