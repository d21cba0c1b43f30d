"""One experiment, put together from its config once, for all programs: collect, meta-train, evaluate."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dmil_core.checkpoint import MANIFEST, Checkpoint, CheckpointError, Manifest, Range
from dmil_core.configs import ExperimentConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.errors import RunError, UserError, shorten
from dmil_core.methods.base import MetaLearner, Method, OnlineMetaLearner
from dmil_core.methods.registry import method_type
from dmil_core.networks import Parameters, flatten
from dmil_core.outer_loop import OuterState
from dmil_core.seeding import named_rng
from dmil_core.settings import OnNonfinite
from services.cli.composition import flat
from services.cli.live_view import Status
from services.cli.progress import Bar
from services.demonstrations.collection import DemonstrationCollection
from services.demonstrations.store import DemoStore, TaskDemonstrations
from services.distributed.failures import keeping_failures
from services.distributed.runner import Plan, Runner
from services.distributed.work_items import AdaptationRollouts
from services.evaluation.controls import ControlRow, control_items, control_rows
from services.evaluation.evaluator import Evaluations, Evaluator, Tallies, write_evaluation
from services.evaluation.results import write_rows
from services.evaluation.summary import Evaluation, faults_of
from services.experiments.meta_training import CheckpointWriter, IterationLog, meta_train
from services.rollouts.adaptations import AdaptationOutcome
from services.storage.checkpoints import Checkpoints
from services.storage.provenance import library_versions
from services.suites.base import Split, TaskSuite, action_space_of, with_points
from services.suites.registry import open_suite
from services.tracking.tracker import Tracker

MOST_FAULTS = 0.01
"""Of the episodes of an evaluation, those that a simulator may spoil."""
CHANGEABLE: dict[str, Any] = {"evaluation": True, "training": {"iterations", "checkpoint_every", "checkpoints_kept"}}
"""Settings that a run may change when it goes on, without becoming another."""


class Experiment:
    """What a config describes: its suite, its demonstrations, its method, and the phases that use them."""

    def __init__(self, config: ExperimentConfig, store: DemoStore) -> None:
        """Put the experiment together; nothing runs yet.

        Raises:
            UserError: for a suite, a method, a task or a source of demonstrations that there is not, or iterations of a
                method without meta-training.
        """
        name, iterations = config.method.name, config.training.iterations
        kind = method_type(name)
        if iterations and not issubclass(kind, MetaLearner):
            raise UserError(f"training.iterations: got {iterations}; wanted 0: {name} has no meta-training")
        self.suite: TaskSuite = open_suite(config.suite)
        self.config = config = with_points(config, self.suite)
        if "tracking" in config.evaluation.controls and config.suite.points is None:
            raise UserError(
                f"evaluation.controls: got tracking for {config.suite.name}, which declares no points; wanted "
                "suite.points, see docs/your-own-task.md; or leave it out"
            )
        self.store = store
        self._collection = DemonstrationCollection(config, self.suite, store)

    @property
    def tasks(self) -> list[tuple[Split, str]]:
        """All tasks with their split; one that is in both is a meta-testing task: its goals are unseen."""
        test = self.suite.test_tasks
        return [
            *(("meta-training", task) for task in self.suite.train_tasks if task not in test),
            *(("meta-testing", task) for task in test),
        ]

    # Demonstrations

    def read_sources(self, only: Collection[str] | None = None) -> None:
        """Read the data sets that the settings name, so that what is wrong with one is said before anything is made.

        Raises:
            DemonstrationError: as `collect`.
        """
        self._collection.check_recorded(self._to_collect(only))

    def collect(self, runner: Runner, only: Collection[str] | None = None) -> dict[str, TaskDemonstrations]:
        """Return every task's demonstrations, see `DemonstrationCollection`; or some tasks', where nothing is trained.

        Controls need those of the other tasks too.

        Raises:
            DemonstrationError: if an expert hardly ever succeeds, a task has none, or a data set cannot be used.
        """
        return self._collection.collect(runner, self._to_collect(only))

    def _to_collect(self, only: Collection[str] | None) -> Collection[str] | None:
        return None if self.config.evaluation.controls else only

    def training_sets(self, data: Mapping[str, TaskDemonstrations]) -> dict[str, Sequence[Demonstration]]:
        """Return what meta-training may see: the demonstrations of its tasks, without those held out."""
        held_out = self.config.demonstrations.held_out
        return {task: data[task].demonstrations[:-held_out] for task in self.suite.train_tasks}

    def held_out_sets(self, data: Mapping[str, TaskDemonstrations]) -> dict[str, Sequence[Demonstration]]:
        """Return what support sets are drawn from, for the tasks of both splits."""
        held_out = self.config.demonstrations.held_out
        return {task: data[task].demonstrations[-held_out:] for _, task in self.tasks if task in data}

    # Meta-training

    def method(self, training_sets: Mapping[str, Sequence[Demonstration]]) -> Method[Any]:
        """Return the method, with what it learns once from the training demonstrations."""
        settings, demonstrations = self.config.method, [d for task in training_sets.values() for d in task]
        kind, points = method_type(settings.name), self.config.suite.points
        return kind.prepared(settings, self.suite.action_dim, demonstrations, points)

    def initial_parameters(self, method: Method) -> Parameters:
        """Draw the parameters that meta-training starts from."""
        return method.initial_parameters(named_rng(self.config.seed, "initial parameters"))

    def train(
        self,
        runner: Runner,
        data: Mapping[str, TaskDemonstrations],
        checkpoints: Checkpoints,
        tracker: Tracker,
        resume: Checkpoint | None = None,
        *,
        overlap_evaluation: bool = True,
        on_nonfinite: OnNonfinite = "stop",
    ) -> Checkpoint:
        """Meta-train to the set number of iterations, from `resume` on, and return the last checkpoint.

        Whatever ends it, it writes a checkpoint first, and drops an evaluation that is under way, which a resumed run
        catches up on. Evaluations on the way are kept in ``evaluations`` beside the checkpoints. Where a loss or a
        gradient is not finite, it stops, or skips the step and counts the iteration as done.

        Raises:
            CheckpointError: if the checkpoint to go on from was trained on other demonstrations.
            RunError: where numbers are not finite, or for an error in a slot, which is named.
        """
        sets = self.training_sets(data)
        method = self.method(sets)
        evaluations = Evaluations(
            runner, self.evaluator(runner, data), checkpoints, tracker, overlap=overlap_evaluation
        )
        if resume is None:
            initial = self.initial_parameters(method)
            state, manifest = OuterState.start(flatten(initial).numpy()), self._manifest(initial, data, sets)
        else:
            check_data(resume, data, self.store)
            changed = {"config": self.config, "versions": library_versions(), **self._ranges(sets)}
            state, manifest = resume.state, resume.manifest.model_copy(update=changed)
        path = resume and resume.path
        writer = CheckpointWriter(checkpoints, manifest, method.constants(), runner, tracker, evaluations.pending, path)
        evaluations.catch_up()
        if state.iteration >= self.config.training.iterations:
            evaluations.finish()
            return resume or Checkpoint(writer.write(state))
        assert isinstance(method, MetaLearner)
        suite = self.suite if isinstance(method, OnlineMetaLearner) else None  # takes a worker seconds to import
        skip, seed = on_nonfinite == "skip", self.config.seed
        plan = Plan(method, manifest.torch_shapes, sets, state, self.config.training, seed, skip, suite)
        log = IterationLog(runner, tracker, evaluations)
        return Checkpoint(meta_train(runner, plan, writer, log, evaluations))

    def _manifest(
        self,
        initial: Parameters,
        data: Mapping[str, TaskDemonstrations],
        training_sets: Mapping[str, Sequence[Demonstration]],
    ) -> Manifest:
        """Return the manifest of the state before the first iteration."""
        return Manifest(
            iteration=0,
            loss=None,
            config=self.config,
            shapes={name: tuple(tensor.shape) for name, tensor in initial.items()},
            data=_digests(data),
            versions=library_versions(),
            mlflow_run_id=None,
            **self._ranges(training_sets),
        )

    def _ranges(self, training_sets: Mapping[str, Sequence[Demonstration]]) -> dict[str, Any]:
        """Return what whoever acts later is to know of actions and observations."""
        space = action_space_of(self.suite)
        ends = [(d.observations.min(0), d.observations.max(0)) for task in training_sets.values() for d in task]
        low, high = (np.array(values) for values in zip(*ends, strict=True))
        return {"actions": Range.of(space.low, space.high), "observed": Range.of(low.min(0), high.max(0))}

    # Evaluation

    def evaluate(
        self,
        runner: Runner,
        data: Mapping[str, TaskDemonstrations],
        checkpoint: Checkpoint,
        folder: Path,
        only: Collection[str] | None = None,
    ) -> Evaluation:
        """Adapt a checkpoint to every task of both splits, and return a row for each episode and adaptation.

        They are also written to ``episodes.jsonl`` and ``adaptations.jsonl`` in `folder`; `only` restricts the tasks.

        Raises:
            RunError: if the simulator spoiled more than `MOST_FAULTS` of the episodes.
        """
        evaluator = self.evaluator(runner, data, only)
        outcomes: dict[int, AdaptationOutcome] = {}
        tallies, at = Tallies(runner.meter), ""

        def status() -> Status:
            return Status(success=list(tallies), workers=runner.worker_counts, at=at)

        with (
            Bar("evaluating", sum(len(each.episodes) for each in evaluator.adaptations), 0, "episodes", status) as bar,
            keeping_failures(folder, self.config, lambda: checkpoint.path),
        ):
            for index, outcome in runner.simulate(evaluator.items(checkpoint, AdaptationRollouts)):
                outcomes[index] = outcome
                adaptation = evaluator.adaptations[index]
                tallies.add(adaptation, outcome)
                at = adaptation.task
                bar.advance(len(adaptation.episodes))
        tallies.finish()
        evaluation = evaluator.evaluation(checkpoint, [outcomes[index] for index in range(len(evaluator.adaptations))])
        write_evaluation(evaluation, folder)
        faulty = sum(row.fault is not None for row in evaluation.episodes)
        if faulty > MOST_FAULTS * len(evaluation.episodes):
            raise RunError(f"{faults_of(evaluation.episodes)}; wanted at most {MOST_FAULTS:.0%}; mend the environment")
        return evaluation

    def evaluate_controls(
        self,
        runner: Runner,
        data: Mapping[str, TaskDemonstrations],
        evaluation: Evaluation,
        folder: Path,
        only: Collection[str] | None = None,
    ) -> list[ControlRow]:
        """Return what the controls of the settings did beside an evaluation, on its meta-testing tasks.

        Their episodes are written to ``controls/NAME/episodes.jsonl`` in `folder`.
        """
        rows: list[ControlRow] = []
        if not (controls := self.config.evaluation.controls):
            return rows
        named = [of for of in self.tasks if of[0] == "meta-testing" and (only is None or of[1] in only)]
        sets, held_out = self.training_sets(data), self.held_out_sets(data)
        evaluator = Evaluator(runner, self.config, self.suite, named, data, held_out)
        items = evaluator.items(evaluation.checkpoint, AdaptationRollouts)
        total = len(controls) * sum(len(each.episodes) for each in evaluator.adaptations)
        with (
            Bar("controls", total, 0, "episodes") as bar,
            keeping_failures(folder, self.config, lambda: evaluation.checkpoint.path),
        ):
            for control in controls:
                outcomes: dict[int, AdaptationOutcome] = {}
                of_control = control_items(control, items, self.config, self.suite.action_dim, runner, sets, held_out)
                for index, outcome in runner.simulate(of_control):
                    outcomes[index] = outcome
                    bar.advance(len(evaluator.adaptations[index].episodes))
                done = [outcomes[index] for index in range(len(items))]
                episodes = evaluator.evaluation(evaluation.checkpoint, done).episodes
                write_rows(folder / "controls" / control / "episodes.jsonl", episodes)
                rows += control_rows(control, episodes, evaluation.episodes)
        return rows

    def evaluator(
        self, runner: Runner, data: Mapping[str, TaskDemonstrations], only: Collection[str] | None = None
    ) -> Evaluator:
        """Return what evaluates the checkpoints of this experiment, on some tasks only if they are given."""
        tasks = [named for named in self.tasks if only is None or named[1] in only]
        return Evaluator(runner, self.config, self.suite, tasks, data, self.held_out_sets(data))


def check_settings(resume: Checkpoint, config: ExperimentConfig, origin: Path) -> None:
    """Refuse to go on from a checkpoint with other settings, those of the file `origin`, than it was trained with.

    Raises:
        UserError: names file and keys, or the number of iterations where that was passed already.
    """
    if changed := changed_settings(resume.manifest.config, config):
        raise UserError(
            f"{origin}: got other settings than {resume.path / MANIFEST}, which was trained with "
            f"{', '.join(f'{key} {shorten(old)}, not {shorten(new)}' for key, (old, new) in changed.items())}; wanted "
            "one run's: restore the file, or remove the checkpoint if it is another run's"
        )
    if resume.manifest.iteration > config.training.iterations:
        raise UserError(
            f"--training.iterations: got {config.training.iterations}; wanted at least the {resume.manifest.iteration} "
            f"that are done: {resume.path}"
        )


def changed_settings(before: ExperimentConfig, now: ExperimentConfig) -> dict[str, tuple[Any, Any]]:
    """Return the settings that differ and make another run, by dotted key: the one before, and the one now.

    Points are compared where both have them: a suite's own are filled in when a method, or an evaluation, uses them.
    """
    both = before.suite.points is not None and now.suite.points is not None
    without = CHANGEABLE if both else CHANGEABLE | {"suite": {"points"}}
    old, new = (flat(config.model_dump(exclude=without)) for config in (before, now))
    return {key: (old.get(key), new.get(key)) for key in old | new if old.get(key) != new.get(key)}


def _digests(data: Mapping[str, TaskDemonstrations]) -> dict[str, str]:
    return {task: dataset.digest for task, dataset in data.items()}


def check_data(resume: Checkpoint, data: Mapping[str, TaskDemonstrations], store: DemoStore) -> None:
    """Refuse to go on with other demonstrations.

    Raises:
        CheckpointError: names the tasks whose demonstrations differ.
    """
    before = resume.manifest.data
    if before != _digests(data):
        changed = [task for task, dataset in data.items() if before.get(task) != dataset.digest]
        raise CheckpointError(
            f"{resume.path}: trained on other demonstrations of {', '.join(changed)} than the store {store.root} "
            "holds; point DMIL_DATA to those it was trained on"
        )
