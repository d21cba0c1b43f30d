"""The champion of each suite: in MLflow's registry, the model under the suite's name that has the alias ``champion``.

A model takes it over where it is better in meta-testing tasks outside the interval of the difference: both adapt to the
same support sets and act in the same episodes, each with fine-tuning as it was made for.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dmil_core.checkpoint import Checkpoint
from dmil_core.errors import RunError, UserError
from services.demonstrations.store import TaskDemonstrations
from services.distributed.runner import Runner
from services.evaluation.comparison import Comparison, Difference, SeedEvaluation, Unpaired
from services.evaluation.results import EvaluationFolder
from services.evaluation.summary import Evaluation
from services.experiments.experiment import Experiment
from services.storage.redaction import error_line, redacted
from services.storage.run_folders import IDENTITY
from services.suites.registry import open_suite
from services.tracking.client import connect
from services.tracking.delivery import Identity
from services.tracking.links import tracking_uri
from services.tracking.models import CHECKPOINT_TAG, download, models_of

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import LoggedModel
    from mlflow.entities.model_registry import ModelVersion

ALIAS = "champion"


@contextmanager
def _asking(uri: str) -> Iterator[None]:
    try:
        yield
    except (UserError, RunError):
        raise
    except Exception as error:  # noqa: BLE001  MLflow and what is below it raise many kinds
        raise RunError(
            f"--promote: MLflow at {redacted(uri)} does not answer as one with a registry of models: "
            f"{error_line(error)}; wanted the MLflow that the run was tracked by; set MLFLOW_TRACKING_URI to it"
        ) from None  # its text may hold secrets


def open_promotion(checkpoint: Checkpoint, experiment: Experiment, folder: Path) -> "Promotion":
    """Find the model of a checkpoint, and the champion that it is to be compared with in `folder`.

    Raises:
        UserError: if MLflow has no model of the checkpoint, or the champion is of another protocol.
        RunError: if MLflow does not answer, or has no registry.
    """
    uri, name = tracking_uri(), experiment.suite.name
    with _asking(uri):
        client = connect(uri)
        challenger = _model_of(client, checkpoint)
        registered = client.search_registered_models(f"name = '{name}'")
        has_one = bool(registered) and ALIAS in registered[0].aliases
        champion = client.get_model_version_by_alias(name, ALIAS) if has_one else None
        if champion is None or champion.source == _address(challenger.model_id):
            return Promotion(client, uri, experiment, challenger, champion, None, folder)
        champion_checkpoint = Checkpoint(_downloaded(client, champion, uri, folder / "model"))
    theirs = open_suite(champion_checkpoint.manifest.config.suite).protocol
    if theirs != experiment.suite.protocol:
        raise UserError(
            f"--promote: got the protocol {experiment.suite.protocol!r}; wanted that of {name}'s champion, {theirs!r}; "
            f"take the alias {ALIAS} from it in MLflow, and the next model has it"
        )
    return Promotion(client, uri, experiment, challenger, champion, champion_checkpoint, folder)


def _model_of(client: "MlflowClient", checkpoint: Checkpoint) -> "LoggedModel":
    run_id, home = checkpoint.manifest.mlflow_run_id, checkpoint.path.absolute().parents[1]
    if run_id is None and (home / IDENTITY).exists():  # MLflow was away when the checkpoint was written
        run_id = Identity.of(home).run_id
    models = [] if run_id is None else models_of(client, client.get_run(run_id))
    for model in models:
        if model.tags.get(CHECKPOINT_TAG) == checkpoint.digest:
            return model
    if run_id is None:
        got = "which has no MLflow run"
    else:
        got = f"of which MLflow run {run_id} has no model, and {len(models)} of others"
    raise UserError(
        f"--checkpoint: got {checkpoint.path}, {got}; wanted the last checkpoint of a finished run of "
        "dmil meta-train; what MLflow did not take while the run was on it takes by: "
        f"dmil tracking flush {home}"
    )


def _address(model_id: str) -> str:
    """Return the source that a version records; its model id is not always recorded."""
    return f"models:/{model_id}"


def _downloaded(client: "MlflowClient", version: "ModelVersion", uri: str, folder: Path) -> Path:
    """Return the folder of a version's checkpoint."""
    folder.mkdir(parents=True, exist_ok=True)
    return download(client, uri, client.get_logged_model((version.source or "").removeprefix(_address(""))), folder)


@dataclass(frozen=True)
class Promotion:
    """A model, and the one that it would take the alias from."""

    client: "MlflowClient"
    uri: str
    experiment: Experiment
    challenger: "LoggedModel"
    champion: "ModelVersion | None"
    champion_checkpoint: Checkpoint | None
    """The champion's, if there is a champion and it is another model."""
    folder: Path

    def evaluate_champion(self, runner: Runner, data: Mapping[str, TaskDemonstrations]) -> None:
        """Evaluate the champion, if it is another model, in the challenger's episodes."""
        if self.champion_checkpoint is None:
            return
        ours, theirs = self.experiment.config, self.champion_checkpoint.manifest.config
        names = ("fine_tuning_steps", "learning_rate", "optimiser", "displaced")
        fine_tuning = {name: getattr(theirs.evaluation, name) for name in names}
        config = theirs.model_copy(
            update={
                "seed": ours.seed,  # names the episodes
                "suite": ours.suite,
                "demonstrations": ours.demonstrations,
                "evaluation": ours.evaluation.model_copy(update=fine_tuning),
            }
        )
        Experiment(config, self.experiment.store).evaluate(runner, data, self.champion_checkpoint, self.folder)

    def decide(self, evaluation: Evaluation, folder: Path) -> list[str]:
        """Register the challenger, move the alias if it is due, and return in words what was decided and why.

        Raises:
            RunError: if MLflow does not answer.
        """
        name, champion = self.experiment.suite.name, self.champion
        with _asking(self.uri):
            version = self._registered(name)
            if champion is None:
                self.client.set_registered_model_alias(name, ALIAS, version)
                return [f"{name}: version {version} is the first {ALIAS}"]
            if self.champion_checkpoint is None:
                return [f"{name}: version {version} is the {ALIAS} already"]
            pairs = self._pairs(evaluation, folder, version)
            lines = [_describe(pair) for pair in pairs]
            if not is_better(pairs):
                return [*lines, f"{name}: the {ALIAS} stays version {champion.version}; version {version} is no better"]
            self.client.set_registered_model_alias(name, ALIAS, version)
            return [*lines, f"{name}: the {ALIAS} is now version {version}, in place of version {champion.version}"]

    def _registered(self, name: str) -> str:
        """Return the number of the challenger's version, which is made if there is none."""
        if not self.client.search_registered_models(f"name = '{name}'"):
            self.client.create_registered_model(name, description=f"Models of the suite {name}; see the alias {ALIAS}.")
        model_id, run_id, tags = self.challenger.model_id, self.challenger.source_run_id, self.challenger.tags
        for version in self.client.search_model_versions(f"name = '{name}'"):
            if version.source == _address(model_id):
                return version.version
        made = self.client.create_model_version(name, _address(model_id), run_id, dict(tags), model_id=model_id)
        return made.version

    def _pairs(self, evaluation: Evaluation, folder: Path, version: str) -> Sequence[Difference | Unpaired]:
        """Return how the challenger differs from the champion in meta-testing tasks, by the size of support sets."""
        assert self.champion is not None
        assert self.champion_checkpoint is not None
        config, name = self.experiment.config, self.experiment.suite.name
        ours, theirs = f"version {version}", f"version {self.champion.version}"
        evaluations = [
            SeedEvaluation(
                measured=EvaluationFolder(rows),
                row=row,
                suite=name,
                seed=config.seed,
                name=row,
                config=checkpoint.manifest.config,
                environment_steps=0,
                home=rows,
            )
            for row, checkpoint, rows in (
                (ours, evaluation.checkpoint, folder),
                (theirs, self.champion_checkpoint, self.folder),
            )
        ]
        return Comparison(
            rows=[ours, theirs],
            suites=[name],
            splits=["meta-testing"],
            shots=config.evaluation.shots,
            metric="score" if evaluation.best_score > 1 else "success_rate",
            by="variants",
            baseline=theirs,
            evaluations=evaluations,
            published={},
        ).pairs


def is_better(pairs: Sequence[Difference | Unpaired]) -> bool:
    """Tell whether a model is better outside the interval for some size of support sets, and worse so for none."""
    answers = {pair.differs if isinstance(pair, Difference) else "not decided" for pair in pairs}
    return "yes, higher" in answers and "yes, lower" not in answers


def _describe(pair: Difference | Unpaired) -> str:
    where = f"{pair.row} against {pair.baseline}, {pair.split} {pair.shots}-shot"
    if isinstance(pair, Unpaired):
        return f"{where}: not compared: {pair.why}"
    interval = f"95% interval {pair.low:+.3f} to {pair.high:+.3f}"
    return f"{where}: {pair.mean:+.3f} ({interval}; {pair.pairs} pairs of episodes), higher? {pair.differs}"
