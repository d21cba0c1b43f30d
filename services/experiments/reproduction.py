"""A work item in which a program failed, put together once more from what was kept of the failure."""

from collections.abc import Callable
from pathlib import Path

from dmil_core.checkpoint import Checkpoint
from dmil_core.errors import RunError
from dmil_core.methods.base import MetaLearner
from dmil_core.outer_loop import group_gradient, tasks_of
from services.demonstrations.store import open_store
from services.distributed.failures import Failure
from services.distributed.runner import LocalRunner
from services.distributed.simulation_worker import SimulationWorker
from services.distributed.work_items import AdaptationRollouts, ExpertAttempts
from services.experiments.experiment import Experiment, check_data


def work_again(failure: Failure) -> Callable[[], object]:
    """Return what does the failure's work again, in this process.

    Raises:
        RunError: if what it began from is gone.
    """
    experiment = Experiment(failure.config, open_store())
    work = _attempt if "attempt" in failure.piece else _slot if "slot" in failure.piece else _adaptation
    return work(failure, experiment)


def _attempt(failure: Failure, experiment: Experiment) -> Callable[[], object]:
    worker, piece = SimulationWorker(experiment.suite), failure.piece
    attempt = ExpertAttempts(str(piece["task"]), [int(piece["attempt"])], failure.config.demonstrations)
    return lambda: worker.run(attempt)


def _slot(failure: Failure, experiment: Experiment) -> Callable[[], object]:
    data = experiment.collect(LocalRunner(experiment.suite))
    sets = experiment.training_sets(data)
    checkpoint, config = _checkpoint(failure), failure.config
    check_data(checkpoint, data, experiment.store)
    method, parameters = checkpoint.method(experiment.suite.action_dim), checkpoint.tensors()
    assert isinstance(method, MetaLearner)
    iteration = int(failure.piece["iteration"])
    if checkpoint.manifest.iteration != iteration:
        raise RunError(f"{checkpoint.path}: got iteration {checkpoint.manifest.iteration}; wanted {iteration}")
    tasks = tasks_of(iteration, list(sets), config.seed, config.training.tasks_per_iteration)
    slot, worker = int(failure.piece["slot"]), SimulationWorker(experiment.suite)
    return lambda: group_gradient(
        method, sets, parameters, config.seed, iteration, tasks, [slot], worker.collect_rollouts
    )


def _adaptation(failure: Failure, experiment: Experiment) -> Callable[[], object]:
    runner = LocalRunner(experiment.suite)
    data, checkpoint = experiment.collect(runner), _checkpoint(failure)
    check_data(checkpoint, data, experiment.store)
    items = experiment.evaluator(runner, data).items(checkpoint, AdaptationRollouts)
    (item,) = (item for item in items if item.key == failure.piece)
    return lambda: list(runner.simulate([item]))


def _checkpoint(failure: Failure) -> Checkpoint:
    if failure.checkpoint is None:
        raise RunError("the state it began from was not checkpointed; run the program again with the same settings")
    return Checkpoint(Path(failure.checkpoint))
