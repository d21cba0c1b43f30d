"""Evaluations on the way of meta-training: the same rows beside it, in pauses of it, and in one process."""

import json
from collections import Counter
from pathlib import Path

import pytest
from mlflow import MlflowClient

from services.evaluation.results import AdaptationResult, EpisodeResult, read_rows
from services.storage.checkpoints import Checkpoints

SCHEDULE = (
    "--training.iterations", "6", "--training.checkpoint-every", "2", "--training.checkpoints-kept", "1",
    "--evaluation.every", "2",
)  # fmt: skip
WAYS = {
    "local": ("--runner", "local"),
    "beside": ("--runner", "ray", "--workers", "1"),
    "in pauses": ("--runner", "ray", "--workers", "1", "--no-overlap-evaluation"),
}


def rows(folder: Path) -> list[EpisodeResult | AdaptationResult]:
    return [
        *read_rows(folder / "episodes.jsonl", EpisodeResult),
        *read_rows(folder / "adaptations.jsonl", AdaptationResult),
    ]


@pytest.mark.thorough
@pytest.mark.usefixtures("joined")
def test_the_rows_do_not_depend_on_when_and_where_they_are_made(workplace: Path, train, mlflow_file: str):
    found = {}
    for name, flags in WAYS.items():
        train(name, *SCHEDULE, *flags)
        run = workplace / "runs" / name
        evaluations = sorted(path.name for path in (run / "evaluations").iterdir())
        assert evaluations == ["0000002", "0000004"]
        found[name] = [*(rows(run / "evaluations" / iteration) for iteration in evaluations), rows(run)]
        assert [path.name for path in Checkpoints(run / "checkpoints", 1).all()][-1] == "iteration-0000006"

        client = MlflowClient(mlflow_file)
        run_id = json.loads((run / "mlflow_run.json").read_text())["run_id"]
        history = client.get_metric_history(run_id, "success_rate/meta-testing/1-shot")
        assert sorted(point.step for point in history) == [2, 4, 6]
    assert found["beside"] == found["in pauses"] == found["local"]
    assert [Counter(type(row).__name__ for row in made) for made in found["local"]] == 3 * [
        {"EpisodeResult": 4, "AdaptationResult": 4}
    ]
    assert found["local"][0] != found["local"][2]


def test_no_evaluation_is_made_on_the_way_unless_asked_for(workplace: Path, train):
    train("run", "--training.iterations", "4", "--training.checkpoint-every", "2")
    assert not (workplace / "runs" / "run" / "evaluations").exists()
