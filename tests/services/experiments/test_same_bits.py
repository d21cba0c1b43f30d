"""Runs come to the digests that were written down, on the kind of processor that they were written down for."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from dmil_core.checkpoint import Checkpoint
from dmil_core.methods.base import FineTuning, MetaLearner, OnlineMetaLearner
from dmil_core.methods.registry import OURS, method_type
from services import meta_train
from services.demonstrations.store import DemoStore
from services.evaluation.results import EpisodeResult, read_rows
from services.storage.checkpoints import Checkpoints
from tests.services.experiments.same_bits import METHODS, RUNS, processor, train
from tests.services.programs import QUICK_EVALUATION

pytestmark = pytest.mark.usefixtures("plain_pages")
KNOWN = json.loads(Path(__file__).with_name("same_bits.json").read_text())
OLD = Path(__file__).with_name("old_checkpoints")
QUICK = [f"{method}-0" for method in METHODS]
"""The runs of `make test`: one of each method."""


@pytest.fixture(scope="module")
def runs(store: DemoStore, mlflow_file: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of all runs here: each is trained once."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("DMIL_DATA", str(store.root))
        environment.setenv("MLFLOW_TRACKING_URI", mlflow_file)
        environment.chdir(runs := tmp_path_factory.mktemp("runs"))
        yield runs


def finished(runs: Path, method: str) -> Checkpoint:
    """Return the last checkpoint of a method's run, which is trained if no other test has done so."""
    folder = runs / f"{method}-0"
    if not folder.exists():
        train(folder.name, runs)
    return Checkpoints(folder / "checkpoints", kept=1).newest()


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.thorough) for name in RUNS],
)
def test_a_run_comes_to_the_same_bits_as_ever(runs: Path, name: str):
    if processor() not in KNOWN:
        pytest.skip(f"no digests for {processor()}; write them down by python -m tests.services.experiments.same_bits")
    assert train(name, runs) == KNOWN[processor()][name]


@pytest.mark.parametrize("method", METHODS)
def test_a_run_of_each_method_comes_to_its_table(runs: Path, method: str):
    whole, folder = finished(runs, method), runs / f"{method}-0"
    rows = read_rows(folder / "episodes.jsonl", EpisodeResult)
    assert {row.method for row in rows} == {method}
    assert len({row.task for row in rows}) == 4
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["method"] == method
    kind = OURS[method]
    assert bool(summary["environment_steps"]) == issubclass(kind, OnlineMetaLearner)
    if not issubclass(kind, MetaLearner):
        assert whole.manifest.iteration == 0


@pytest.mark.thorough
@pytest.mark.parametrize(
    "method",
    [method for method, kind in OURS.items() if issubclass(kind, MetaLearner)],
)
def test_a_run_that_is_resumed_comes_to_the_same_bits(runs: Path, workplace: Path, method: str):
    whole = finished(runs, method)
    begin = ("--method", method, "--preset", "ml10-smoke", "--name", "parts", "--training.iterations", "7")
    for arguments in (begin, ("--resume", "parts", "--training.iterations", str(whole.manifest.iteration))):
        meta_train.run([*arguments, "--runner", "local", *QUICK_EVALUATION])
    parts = Checkpoints(workplace / "runs" / "parts" / "checkpoints", kept=1).newest()
    assert parts.manifest.environment_steps == whole.manifest.environment_steps
    for one, other in zip(parts.state, whole.state, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("method", sorted(path.name for path in OLD.iterdir()))
def test_a_checkpoint_of_version_0_1_opens_and_adapts(data, method: str):
    """Written at commit 40f9c62, with 4 hidden units where the method has a network."""
    checkpoint = Checkpoint(OLD / method)
    config = checkpoint.manifest.config
    learner = method_type(config.method.name).restored(config.method, 4, checkpoint.constants)
    parameters = {name: torch.tensor(array) for name, array in checkpoint.parameters.items()}
    demonstrations = data["door-close"].demonstrations
    policy = learner.adapt(parameters, demonstrations[:1], FineTuning(2, 0.01))
    decision = policy.act(demonstrations[1].observations[:1], policy.start(1))
    assert np.isfinite(decision.actions).all()
    assert checkpoint.digest == KNOWN["checkpoints"][method]
