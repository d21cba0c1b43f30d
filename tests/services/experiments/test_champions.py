"""The registry's champion: the first model, a worse one, a better one, and what cannot be compared."""

import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest
from mlflow import MlflowClient

from dmil_core.errors import RunError
from services import evaluate, meta_train
from services.demonstrations.store import DemoStore
from services.evaluation.comparison import Difference
from services.evaluation.results import EpisodeResult, read_rows
from services.experiments.champions import is_better
from services.storage.run_folders import IDENTITY
from services.tracking.__main__ import run as tracking_program
from tests.services.conftest import without_pictures
from tests.services.programs import Server

NAME = "ml10-part"
TASKS = ("--suite.train-tasks", "drawer-close", "--suite.test-tasks", "door-close")
OPTIMISERS = {"behaviour-cloning": "adam", "nearest-neighbour": "sgd"}
EVALUATION = ("--evaluation.shots", "1", "--evaluation.episodes", "2")


@pytest.fixture(scope="module")
def runs(
    mlflow_server: Server, store: DemoStore, free_port: Callable[[], int], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Mapping[str, Path]]:
    """A network that has learned nothing, and the nearest neighbour, which can close a door; MLflow was away then."""
    runs = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as environment:
        without_pictures(environment)
        environment.chdir(runs)
        environment.setenv("DMIL_DATA", str(store.root))
        environment.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{free_port()}")
        for method in OPTIMISERS:
            arguments = ["--preset", "ml10-smoke", "--method", method, "--runner", "local", "--name", method]
            arguments += ["--training.iterations", "0", "--evaluation.optimiser", OPTIMISERS[method]]
            meta_train.run([*arguments, *TASKS, *EVALUATION, "--runs", str(runs)])
        environment.setenv("MLFLOW_TRACKING_URI", mlflow_server.uri)
        yield {"worse": runs / "behaviour-cloning", "better": runs / "nearest-neighbour"}


@pytest.fixture
def promote(runs: Mapping[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[[str], list[str]]:
    """Evaluates a run, has its model promoted, and returns the lines that say what was decided."""

    def promote(which: str) -> list[str]:
        output = ["--output", str(tmp_path / f"evaluation-{len(list(tmp_path.iterdir()))}")]
        capsys.readouterr()
        evaluate.run(["--checkpoint", str(runs[which]), "--runner", "local", *output, "--promote"])
        return capsys.readouterr().out.partition("its page: ")[2].splitlines()[1:]

    return promote


@pytest.mark.thorough
def test_the_alias_moves_to_what_is_better_outside_its_interval_only(
    promote, runs: Mapping[str, Path], complaint, tmp_path: Path
):
    arguments = ["--runner", "local", "--promote"]
    message = complaint(evaluate.run, "--checkpoint", str(runs["worse"]), *arguments)
    assert "which has no MLflow run; wanted the last checkpoint of a finished run" in message
    for run in runs.values():
        tracking_program(["flush", str(run)])

    client = MlflowClient()
    assert promote("worse") == [f"{NAME}: version 1 is the first champion"]
    assert promote("worse") == [f"{NAME}: version 1 is the champion already"]
    pair, decision = promote("better")
    (champion,) = tmp_path.glob("*/champion/episodes.jsonl")
    assert {row.optimiser for row in read_rows(champion, EpisodeResult)} == {"adam"}
    assert pair == (
        "version 2 against version 1, meta-testing 1-shot: +1.000 "
        "(95% interval +1.000 to +1.000; 2 pairs of episodes), higher? yes, higher"
    )
    assert decision == f"{NAME}: the champion is now version 2, in place of version 1"
    pair, decision = promote("worse")
    assert pair.startswith("version 1 against version 2, meta-testing 1-shot: -1.000")
    assert decision == f"{NAME}: the champion stays version 2; version 1 is no better"
    assert client.get_model_version_by_alias(NAME, "champion").version == "2"
    versions = {version.version: version for version in client.search_model_versions(f"name = '{NAME}'")}
    assert {number: version.tags["method"] for number, version in versions.items()} == {
        "1": "behaviour-cloning",
        "2": "nearest-neighbour",
    }


def test_what_cannot_be_promoted_is_reported_before_the_evaluation(
    promote, runs: Mapping[str, Path], tmp_path: Path, complaint, monkeypatch: pytest.MonkeyPatch
):
    for run in runs.values():
        tracking_program(["flush", str(run)])
    promote("better")
    arguments = ["--runner", "local", "--promote", "--runs", str(tmp_path / "none")]
    message = complaint(evaluate.run, "--checkpoint", str(runs["worse"]), *arguments, "--tasks", "reach")
    assert "--promote: got --tasks or --demos with it" in message

    other = tmp_path / "other"
    shutil.copytree(runs["worse"], other)
    shutil.copy(runs["better"] / IDENTITY, other)
    message = complaint(evaluate.run, "--checkpoint", str(other), *arguments)
    assert "has no model, and 1 of others; wanted" in message

    checkpoint = ["--checkpoint", str(runs["worse"])]
    uri = os.environ["MLFLOW_TRACKING_URI"]
    monkeypatch.setenv("MLFLOW_REGISTRY_URI", "nowhere://models")
    with pytest.raises(RunError, match=r"does not answer as one with a registry of models: .*nowhere"):
        evaluate.run([*checkpoint, *arguments])
    monkeypatch.delenv("MLFLOW_REGISTRY_URI")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri.rpartition(":")[0] + ":1")
    with pytest.raises(RunError, match=r"MLflow at http://127\.0\.0\.1:1 does not answer"):
        evaluate.run([*checkpoint, *arguments])
    assert not list(tmp_path.rglob("evaluations/*/episodes.jsonl"))


def test_better_is_higher_somewhere_and_lower_nowhere():
    def pair(differs: str) -> Difference:
        return Difference.model_validate(
            {
                "row": "a", "baseline": "b", "suite": "s", "split": "meta-testing", "shots": 1, "seeds": [0],
                "pairs": 2, "mean": 0.0, "low": 0.0, "high": 0.0, "differs": differs,
            }
        )  # fmt: skip

    for answers, better in (
        (["not decided"], False),
        (["yes, higher", "not decided"], True),
        (["yes, higher", "yes, lower"], False),
        ([], False),
    ):
        assert is_better([pair(answer) for answer in answers]) == better
