"""One experiment, put together from its config once, for all programs: collect, meta-train, evaluate."""

import logging
import time
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from dmil_core.configs import ExperimentConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.errors import RunError, UserError
from dmil_core.methods.base import MetaLearner, Method, PractisingLearner, Standardised
from dmil_core.methods.registry import method_type
from dmil_core.networks import Parameters, flatten, unflatten
from dmil_core.outer_loop import OuterState
from dmil_core.seeding import stream
from services.cli.live_view import Figures
from services.cli.progress import Bar
from services.demonstrations.collection import DemonstrationCollection
from services.demonstrations.store import DemoStore, TaskDemonstrations
from services.distributed.failures import keeping_failures
from services.distributed.metrics import CHECKPOINT_TIME, SPOOL_RECORDS
from services.distributed.ray_runner import RayRunner
from services.distributed.runner import LocalRunner, Plan, Runner
from services.evaluation.evaluator import Evaluations, Evaluator, Tallies, write_evaluation
from services.evaluation.summary import AGAINST_COLLAPSE, COLLAPSED, Evaluation
from services.experiments.iteration_metrics import figures_of, iteration_metrics, nonfinite_in_words, shares_of
from services.rollouts.adaptations import AdaptationOutcome
from services.storage.checkpoints import Checkpoint, CheckpointError, Checkpoints, Manifest
from services.storage.provenance import library_versions
from services.suites.base import Split, TaskSuite
from services.suites.registry import open_suite
from services.tracking import Tracker

logger = logging.getLogger(__name__)

RunnerKind = Literal["ray", "local"]
OnNonfinite = Literal["stop", "skip"]
RECENT = 50
"""So many iterations are behind the losses and the use of sub-skills on the screen."""
COLLAPSED_ITERATIONS = 100
"""So long may one sub-skill take nearly all states before a warning."""


@contextmanager
def open_runner(kind: RunnerKind, suite: TaskSuite, workers: int | None) -> Iterator[Runner]:
    """Open a runner and close it in the end, whatever happens.

    Raises:
        UserError: if there is nobody to work.
    """
    if workers is not None and workers < 1:
        raise UserError(f"--workers: got {workers}; wanted at least 1; leave it out for one for each CPU")
    runner: Runner = LocalRunner(suite) if kind == "local" else RayRunner(suite, workers)
    try:
        yield runner
    finally:
        runner.close()


class NonFiniteError(RunError):
    """A loss or a gradient that is not finite."""

    def __init__(self, told: str, folder: Path) -> None:
        """Say what is to be done about it."""
        super().__init__(
            f"{told}; the step is not taken, the state before it is checkpointed; look at these demonstrations, or go "
            f"on without such steps: python -m services.meta_train --resume {folder} --on-nonfinite skip"
        )


class CollapseWatch:
    """Notices that one sub-skill takes nearly all states for long, and says so once."""

    def __init__(self) -> None:
        """Nothing is noticed yet."""
        self._iterations, self._told = 0, False

    def look(self, iteration: int, metrics: Mapping[str, float]) -> str | None:
        """Return the warning, when it is due after an iteration with these metrics."""
        shares = shares_of(metrics)
        collapsed = len(shares) > 1 and shares.max() > COLLAPSED
        self._iterations = self._iterations + 1 if collapsed else 0
        if self._told or self._iterations < COLLAPSED_ITERATIONS:
            return None
        self._told = True
        return (
            f"sub-skill {shares.argmax()} has taken over {COLLAPSED:.0%} of the states for {COLLAPSED_ITERATIONS} "
            f"iterations, up to {iteration}: the hierarchy is not used; {AGAINST_COLLAPSE}"
        )


class Experiment:
    """What a config describes: its suite, its demonstrations, its method, and the phases that use them."""

    def __init__(self, config: ExperimentConfig, store: DemoStore) -> None:
        """Put the experiment together; nothing runs yet.

        Args:
            config: all settings.
            store: where its demonstrations are, or will be.

        Raises:
            UserError: for a suite, a method, a task or a source of demonstrations that there is not, or iterations of a
                method without meta-training.
        """
        name, iterations = config.method.name, config.training.iterations
        kind = method_type(name)
        if iterations and not issubclass(kind, MetaLearner):
            raise UserError(f"training.iterations: got {iterations}; wanted 0: {name} has no meta-training")
        self.config = config
        self.suite: TaskSuite = open_suite(config.suite)
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

    def collect(self, runner: Runner) -> dict[str, TaskDemonstrations]:
        """Return every task's demonstrations, see `DemonstrationCollection`.

        Raises:
            DemonstrationError: if an expert hardly ever succeeds, a task has none, or a data set cannot be used.
        """
        return self._collection.collect(runner)

    def training_sets(self, data: Mapping[str, TaskDemonstrations]) -> dict[str, Sequence[Demonstration]]:
        """Return what meta-training may see: the demonstrations of its tasks, without those held out."""
        held_out = self.config.demonstrations.held_out
        return {task: data[task].demonstrations[:-held_out] for task in self.suite.train_tasks}

    def held_out_sets(self, data: Mapping[str, TaskDemonstrations]) -> dict[str, Sequence[Demonstration]]:
        """Return what support sets are drawn from, for the tasks of both splits."""
        held_out = self.config.demonstrations.held_out
        return {task: data[task].demonstrations[-held_out:] for _, task in self.tasks}

    # Meta-training

    def method(self, training_sets: Mapping[str, Sequence[Demonstration]]) -> Standardised[Any]:
        """Return the method, with what it learns once from the training demonstrations."""
        settings, demonstrations = self.config.method, [d for task in training_sets.values() for d in task]
        return method_type(settings.name).prepared(settings, self.suite.action_dim, demonstrations)

    def meta_learner(self, training_sets: Mapping[str, Sequence[Demonstration]]) -> MetaLearner[Any]:
        """Return the method, as one that is meta-trained."""
        method = self.method(training_sets)
        assert isinstance(method, MetaLearner)
        return method

    def initial_parameters(self, method: Method) -> Parameters:
        """Draw the parameters that meta-training starts from."""
        return method.initial_parameters(stream(self.config.seed, "initial parameters"))

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
        """Meta-train to the set number of iterations and return the last checkpoint.

        Stopped by Ctrl-C, SIGTERM or a fault, it writes a checkpoint first, and drops an evaluation that is under way;
        who resumes makes that up.

        Args:
            runner: does the work.
            data: every task's demonstrations.
            checkpoints: where to keep them; evaluations on the way are kept in ``evaluations`` beside.
            tracker: takes the metrics of each iteration.
            resume: go on from here.
            overlap_evaluation: go on with meta-training during evaluations on the way.
            on_nonfinite: what to do where a loss or a gradient is not finite: stop, or count the iteration as done
                without its step.

        Raises:
            CheckpointError: if the checkpoint to go on from was trained on other demonstrations.
            RunError: where numbers are not finite, or for an error in a slot, which is named.
        """
        settings = self.config.training
        sets = self.training_sets(data)
        method = self.method(sets)
        initial = self.initial_parameters(method)
        shapes = {name: tensor.shape for name, tensor in initial.items()}
        digests = {task: dataset.digest for task, dataset in data.items()}
        _same_data(resume, digests, self.store)
        state = OuterState.start(flatten(initial).numpy()) if resume is None else resume.state
        environment_steps = 0 if resume is None else resume.manifest.environment_steps

        def save(state: OuterState, loss: float | None) -> Path:
            parameters = unflatten(torch.tensor(state.parameters), shapes)
            manifest = Manifest(
                iteration=state.iteration,
                loss=loss,
                config=self.config,
                shapes={name: tuple(shape) for name, shape in shapes.items()},
                environment_steps=environment_steps,
                data=digests,
                versions=library_versions(),
                mlflow_run_id=tracker.identify(patience=20.0 if state.iteration == settings.iterations else 0.0),
            )
            arrays = {name: tensor.numpy() for name, tensor in parameters.items()}
            path = checkpoints.save(state, arrays, method.constants(), manifest)
            runner.meter.record(CHECKPOINT_TIME, time.time())
            logger.info(f"checkpoint: {path}")
            return path

        evaluations = Evaluations(
            runner,
            self.evaluator(runner, data),
            checkpoints,
            tracker,
            overlap=overlap_evaluation,
        )
        evaluations.make_up()
        if state.iteration >= settings.iterations:
            evaluations.finish()
            return resume or Checkpoint(save(state, None))
        assert isinstance(method, MetaLearner)
        skip = on_nonfinite == "skip"
        suite = self.suite if isinstance(method, PractisingLearner) else None  # takes a worker seconds to import
        plan = Plan(method, shapes, sets, state, settings, self.config.seed, skip, suite)
        training = runner.meta_train(plan)
        collapse = CollapseWatch()
        losses: list[float] = []
        recent: deque[Mapping[str, float]] = deque(maxlen=RECENT)
        path, saved = None, -1

        def figures() -> Figures:
            return figures_of(list(recent))._replace(**evaluations.found, workers=runner.worker_counts)

        def save_now() -> Path | None:
            state = training.state()
            if state.iteration == saved:
                return path
            return save(state, float(np.mean(losses)) if losses else None)

        try:
            runner.meter.record(CHECKPOINT_TIME, time.time())
            with (
                Bar("meta-training", settings.iterations, state.iteration, "iterations", figures) as bar,
                keeping_failures(checkpoints.folder.parent, self.config, save_now),
            ):
                for iteration in training.iterations(settings.iterations - state.iteration):
                    done = iteration.number
                    metrics = iteration_metrics(iteration)
                    environment_steps += int(metrics.get("environment_steps", 0))
                    if not iteration.stepped:
                        told = nonfinite_in_words(iteration)
                        if on_nonfinite == "stop":
                            save_now()
                            raise NonFiniteError(told, checkpoints.folder.parent)
                        logger.warning(f"{told}; the step is not taken")
                    else:
                        losses.append(metrics["loss"])
                    tracker.metrics(done, {name: value for name, value in metrics.items() if np.isfinite(value)})
                    runner.meter.record(SPOOL_RECORDS, float(tracker.waiting))
                    recent.append(metrics)
                    bar.advance(1)
                    if warning := collapse.look(done, metrics):
                        logger.warning(warning)
                        tracker.tags({"warning.collapse": warning})
                    evaluations.look()
                    last = done == settings.iterations
                    if done % settings.checkpoint_every == 0 or last:
                        path, saved = save(training.state(), float(np.mean(losses)) if losses else None), done
                        losses.clear()
                        if evaluations.is_due(done):
                            evaluations.begin(Checkpoint(path))
                evaluations.finish()
            assert path is not None
            return Checkpoint(path)
        except KeyboardInterrupt:
            save_now()
            raise
        finally:
            training.close()

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

        Args:
            runner: does the work.
            data: every task's demonstrations.
            checkpoint: what is adapted.
            folder: the rows are also written to ``episodes.jsonl`` and ``adaptations.jsonl`` in it.
            only: of all tasks, those to adapt to.
        """
        evaluator = self.evaluator(runner, data, only)
        outcomes: dict[int, AdaptationOutcome] = {}
        tallies, at = Tallies(runner.meter), ""

        def figures() -> Figures:
            return Figures(success=list(tallies), workers=runner.worker_counts, at=at)

        with (
            Bar("evaluating", sum(len(each.episodes) for each in evaluator.adaptations), 0, "episodes", figures) as bar,
            keeping_failures(folder, self.config, lambda: checkpoint.path),
        ):
            for index, outcome in runner.simulate("try_out", evaluator.calls(checkpoint)):
                outcomes[index] = outcome
                adaptation = evaluator.adaptations[index]
                tallies.add(adaptation, outcome)
                at = adaptation.task
                bar.advance(len(adaptation.episodes))
        tallies.finish()
        evaluation = evaluator.evaluation(checkpoint, [outcomes[index] for index in range(len(evaluator.adaptations))])
        write_evaluation(evaluation, folder)
        return evaluation

    def evaluator(
        self, runner: Runner, data: Mapping[str, TaskDemonstrations], only: Collection[str] | None = None
    ) -> Evaluator:
        """Return what evaluates the checkpoints of this experiment, on some tasks only if they are given."""
        tasks = [named for named in self.tasks if only is None or named[1] in only]
        return Evaluator(runner, self.config, self.suite, tasks, data, self.held_out_sets(data))


def _same_data(resume: Checkpoint | None, digests: Mapping[str, str], store: DemoStore) -> None:
    """Refuse to go on with other demonstrations.

    Raises:
        CheckpointError: names the tasks whose demonstrations differ.
    """
    if resume is not None and resume.manifest.data != digests:
        changed = [task for task in digests if resume.manifest.data.get(task) != digests[task]]
        raise CheckpointError(
            f"{resume.path}: trained on other demonstrations of {', '.join(changed)} than the store {store.root} "
            "holds; point DMIL_DATA to those it was trained on"
        )
