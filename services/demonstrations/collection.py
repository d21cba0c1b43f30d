"""Where an experiment's demonstrations come from: the store, data sets of one's own, or the scripted experts."""

import logging
from collections import Counter
from collections.abc import Collection, Generator, Sequence
from contextlib import closing
from functools import cached_property

from dmil_core.configs import ExperimentConfig
from dmil_core.demonstrations import DemonstrationError
from dmil_core.trajectories import Episode
from services.cli.live_view import Status
from services.cli.progress import Bar
from services.demonstrations.external import check_dimensions, demonstrations, places_of
from services.demonstrations.store import DemoStore, TaskDemonstrations
from services.distributed.failures import keeping_failures
from services.distributed.runner import Runner
from services.distributed.work_items import ExpertAttempts
from services.suites.base import TaskSuite

logger = logging.getLogger(__name__)

CHUNK = 10
"""Attempts of an expert in one call to a simulation worker."""
MOST_ATTEMPTS_EACH = 10
"""So many attempts for each wanted demonstration, then the expert is given up."""


class DemonstrationCollection:
    """The demonstrations of all tasks of an experiment."""

    def __init__(self, config: ExperimentConfig, suite: TaskSuite, store: DemoStore) -> None:
        """Find out where they are, the experts' in the store; nothing is read or made yet.

        Raises:
            DemonstrationError: for a source of demonstrations that there is not, or that is of no task of the suite.
        """
        self._config, self._suite, self._store = config, suite, store
        self._names = list(dict.fromkeys((*suite.train_tasks, *suite.test_tasks)))
        self._places = self._find_places()

    def collect(self, runner: Runner, only: Collection[str] | None = None) -> dict[str, TaskDemonstrations]:
        """Return the demonstrations of all tasks, or of some, letting the experts make those that are not in the store.

        The first successes in the order of the attempts' numbers are kept, so the outcome does not depend on who
        simulates what.

        Raises:
            DemonstrationError: if an expert hardly ever succeeds, a task has none, or a data set cannot be used.
        """
        settings = self._config.demonstrations
        self.check_recorded(only)
        names = [task for task in self._names if only is None or task in only]
        datasets = {task: dataset for task, dataset in self._recorded.items() if task in names}
        wanted = [task for task in names if task not in datasets]
        ids = {task: self._store.dataset_id(task, self._suite, settings) for task in wanted}
        missing = []
        for task, dataset_id in ids.items():
            if (dataset := self._store.load(dataset_id, task)) is not None:
                datasets[task] = self._checked(dataset)
            elif self._suite.expert(task) is None:
                raise DemonstrationError(
                    f"demonstrations.source: got nothing for {task}, which has no scripted expert; wanted a data set: "
                    f"--demos minari:{task}=ID"
                )
            else:
                missing.append(task)
        with closing(self._attempt(runner, missing)) as made:  # whatever happens here, its progress is off the screen
            for task, attempts in made:
                solved = [index for index, attempt in enumerate(attempts) if attempt.solved_at is not None]
                kept = solved[: settings.per_task]
                datasets[task] = self._store.save(
                    ids[task],
                    task,
                    [attempts[index] for index in kept],
                    failed=kept[-1] + 1 - len(kept),
                    settings={"protocol": self._suite.protocol, **settings.model_dump()},
                )
        return {task: datasets[task] for task in names}

    def _checked(self, dataset: TaskDemonstrations) -> TaskDemonstrations:
        """Return a stored data set that fits the suite, which may have been changed since."""
        try:
            check_dimensions(dataset.demonstrations[0], self._suite)
        except DemonstrationError as error:
            raise DemonstrationError(
                f"{self._store.root / dataset.id}: {error}; remove it, or name in the suite's protocol what has changed"
            ) from error
        return dataset

    def _find_places(self) -> dict[str, str]:
        """Return where the demonstrations of those tasks are that the settings name a data set for."""
        if self._config.demonstrations.source == "expert":
            return {}
        places = places_of(self._config.demonstrations.source)
        if unknown := [task for task in places if task not in self._names]:
            raise DemonstrationError(
                f"demonstrations.source: got data sets of {', '.join(unknown)}; {self._suite.name} has the tasks "
                f"{', '.join(self._names)}; name the task that a data set is of: TASK=ID"
            )
        return places

    @cached_property
    def _recorded(self) -> dict[str, TaskDemonstrations]:
        """The data sets that the settings name, read once."""
        evaluation, most = self._config.evaluation, self._config.demonstrations.per_task
        datasets = {task: demonstrations(task, at, self._suite, most) for task, at in self._places.items()}
        for task, dataset in datasets.items():
            got = len(dataset.demonstrations)
            if got < max(evaluation.shots) * evaluation.support_draws and task not in self._suite.train_tasks:
                sets = ", ".join(f"{got // size} of {size}" for size in evaluation.shots)
                logger.info(f"{dataset.id}: {got} demonstrations of {task} make these disjoint support sets: {sets}")
        return datasets

    def check_recorded(self, only: Collection[str] | None = None) -> None:
        """Read the data sets that the settings name, once, and see whether their demonstrations suffice.

        Where tasks are named, these are evaluated, and none is trained on.

        Raises:
            DemonstrationError: for one that cannot be used, or has too few demonstrations.
        """
        settings, shots = self._config.demonstrations, max(self._config.evaluation.shots)
        for task, dataset in self._recorded.items():
            wanted = settings.held_out + 1 if only is None and task in self._suite.train_tasks else shots
            if (got := len(dataset.demonstrations)) < wanted:
                raise DemonstrationError(
                    f"{dataset.id}: got {got} demonstrations of {task}; wanted at least {wanted}: {shots} for a "
                    "support set, and for a meta-training task one more than demonstrations.held_out; record more, or "
                    "lower that or evaluation.shots"
                )

    def _attempt(self, runner: Runner, tasks: Sequence[str]) -> Generator[tuple[str, list[Episode]]]:
        """Yield each task's attempts as soon as enough are successes, in the order of their numbers."""
        if not tasks:
            return
        settings = self._config.demonstrations
        attempts: dict[str, list[Episode]] = {task: [] for task in tasks}

        def lacking(task: str) -> int:
            return settings.per_task - sum(attempt.solved_at is not None for attempt in attempts[task])

        at = ""

        def status() -> Status:
            return Status(workers=runner.worker_counts, at=at)

        with Bar("collecting", len(tasks) * settings.per_task, 0, "demonstrations", status) as bar:
            while attempts:
                items: list[ExpertAttempts] = []
                for task in attempts:
                    first = len(attempts[task])
                    if first >= MOST_ATTEMPTS_EACH * settings.per_task:
                        raise DemonstrationError(
                            f"task {task}: its expert solved {settings.per_task - lacking(task)} of {first} attempts; "
                            f"wanted {settings.per_task} demonstrations; take less noise or a longer horizon"
                        )
                    for start in range(first, first + lacking(task), CHUNK):
                        numbers = range(start, min(start + CHUNK, first + lacking(task)))
                        items.append(ExpertAttempts(task, numbers, settings))
                results: dict[int, list[Episode]] = {}
                left = Counter(item.task for item in items)
                with keeping_failures(self._store.root, self._config):
                    for index, made in runner.simulate(items):
                        task = items[index].task
                        results[index] = made
                        left[task] -= 1
                        at = task
                        bar.advance(sum(attempt.solved_at is not None for attempt in made))
                        if not left[task]:
                            of_task = [number for number, item in enumerate(items) if item.task == task]
                            attempts[task] += [attempt for number in of_task for attempt in results.pop(number)]
                            if lacking(task) <= 0:
                                yield task, attempts.pop(task)
