"""The logged model does what the method does here, without a pickle, and says what is wrong with its input."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mlflow
import numpy as np
import pytest
from mlflow import MlflowClient
from mlflow.artifacts import download_artifacts
from mlflow.pyfunc.model import PythonModelContext

import dmil_core as dmil
from dmil_core.checkpoint import Checkpoint
from dmil_core.configs import preset_of
from dmil_core.errors import RunError, UserError
from dmil_core.methods.base import FineTuning
from dmil_core.methods.registry import OURS
from services.demonstrations.store import DemoStore
from services.distributed.runner import LocalRunner
from services.experiments.experiment import Experiment
from services.storage.checkpoints import Checkpoints
from services.tracking import tracker as tracking
from services.tracking.delivery import Identity
from services.tracking.imitator import POLICIES_KEPT, Imitator
from services.tracking.models import checkpoint_in, models_of
from services.tracking.packing import packed
from services.tracking.tracker import Tracker
from tests.services.tracking import old_imitator

GUIDE = Path(__file__).parents[3] / "docs" / "mlflow.md"
STEPS = FineTuning(1, 0.01)


@pytest.fixture
def untrained(store: DemoStore, data, tmp_path: Path, no_mlflow: None, monkeypatch: pytest.MonkeyPatch):
    """Returns a checkpoint of a method's first parameters, and three support demonstrations."""
    monkeypatch.setattr(tracking, "LINGER_SECONDS", 0.01)

    def make(method: str):
        config = preset_of("ml10", "smoke", method)
        experiment = Experiment(
            config.model_copy(update={"training": config.training.model_copy(update={"iterations": 0})}), store
        )
        tracker = Tracker(tmp_path, "models")
        checkpoint = experiment.train(LocalRunner(experiment.suite), data, Checkpoints(tmp_path / "c", 1), tracker)
        tracker.model(checkpoint.path, experiment.held_out_sets(data)["door-close"][:2])
        tracker.close("FINISHED")
        return checkpoint, experiment.held_out_sets(data)["door-close"][:3]

    return make


def policy_of(checkpoint: Checkpoint, support):
    """Return the policy that the method itself adapts to a support set."""
    method = checkpoint.method(support[0].actions.shape[1])
    return method.adapt(checkpoint.tensors(), support, STEPS)


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        *((Imitator, method) for method in OURS),
        *((old_imitator.Imitator, method) for method in OURS if method != "tracking"),  # version 0.1 had none
    ],
)
def test_it_acts_as_the_adapted_policy_step_by_step(untrained, kind: type[Imitator], method: str):
    checkpoint, support = untrained(method)
    context = PythonModelContext({"checkpoint": str(checkpoint.path)}, {"action_dim": 4})
    imitator = kind()
    imitator.load_context(context)
    policy = policy_of(checkpoint, support)
    memory, remembered = policy.start(1), None
    for observation in support[0].observations[:3]:
        decision = policy.act(observation[None], memory)
        asked = packed(support, observation) | {"memory": remembered}
        answer = imitator.answer(asked, STEPS)
        rounding = 0 if kind is Imitator else 1e-5  # version 0.1 laid its parameters out in another order
        np.testing.assert_allclose(np.float32(answer["action"]), decision.actions[0], rounding, rounding)
        assert answer["sub_skill"] == decision.sub_skills[0]
        if "support_id" in answer:
            by_id = imitator.answer(asked | {"support": None, "support_id": answer["support_id"]}, STEPS)
            assert by_id == answer
        memory, remembered = decision.memory, answer["memory"]
        assert remembered == memory[0].tolist()


@pytest.fixture
def own_mlflow(mlflow_file: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """MLflow itself receives its address, as a user does, and forgets it after the test."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    yield mlflow_file
    mlflow.set_tracking_uri(None)  # pyright: ignore[reportArgumentType]  so it is forgotten


def test_mlflow_loads_it_without_pickle_and_predicts(untrained, own_mlflow: str, tmp_path: Path, monkeypatch):
    checkpoint, support = untrained("dmil")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", own_mlflow)
    for _ in range(2):  # the second one finds it there
        tracker = Tracker(tmp_path, "models")
        tracker.model(checkpoint.path, support[:1])
        assert tracker.close("FINISHED")
    run_id = Identity.of(tmp_path).run_id
    client = MlflowClient(own_mlflow)
    (model,) = models_of(client, client.get_run(str(run_id)))
    monkeypatch.setenv("MLFLOW_ALLOW_PICKLE_DESERIALIZATION", "false")
    loaded = mlflow.pyfunc.load_model(f"runs:/{run_id}/model")
    folder = Path(download_artifacts(f"models:/{model.model_id}", dst_path=str(tmp_path / "m")))
    assert not [path for path in folder.rglob("*") if path.suffix in {".pkl", ".pickle", ".pt"}]
    assert Checkpoint(checkpoint_in(folder)).digest == checkpoint.digest
    inputs, outputs = loaded.metadata.get_input_schema(), loaded.metadata.get_output_schema()
    assert inputs is not None
    assert outputs is not None
    assert inputs.input_names() == ["support", "support_id", "observation", "memory"]
    assert outputs.input_names() == ["action", "sub_skill", "memory", "support_id"]
    for address in (f"models:/{model.model_id}", f"runs:/{run_id}/model"):
        assert dmil.load(address).checkpoint.digest == checkpoint.digest
    with pytest.raises(UserError, match=r"nobody@champion: got no model at sqlite:.*; wanted models:/NAME@"):
        dmil.load("models:/nobody@champion")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "nowhere://models")
    with pytest.raises(UserError, match=r"got no model at nowhere:.*unsupported"):
        dmil.load("models:/nobody@champion")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", own_mlflow)

    observation = support[0].observations[5]
    params = {"fine_tuning_steps": STEPS.steps, "learning_rate": STEPS.learning_rate}
    wanted = policy_of(checkpoint, support).act(observation[None], np.zeros((1, 0), np.int64))
    for asked in (packed(support, observation), packed(support, observation) | {"observation": observation}):
        (answer,) = loaded.predict(asked, params=params)
        np.testing.assert_array_equal(np.float32(answer["action"]), wanted.actions[0])
    asked = {"support_id": answer["support_id"], "observation": observation}
    assert loaded.predict(asked, params=params) == [answer]
    with pytest.raises(UserError, match=r"got 'nothing'; wanted one of the last 16 .*; send the support again"):
        loaded.predict(asked | {"support_id": "nothing"}, params=params)
    (shown,) = loaded.predict(loaded.input_example, params=params)
    assert len(shown["action"]) == 4
    (snippet,) = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    for placeholder, own in (("ml10@champion", model.model_id), ("sqlite:///mlflow.db", own_mlflow)):
        assert snippet.count(placeholder) == 1
        snippet = snippet.replace(placeholder, own)
    namespace: dict[str, Any] = {}
    exec(snippet, namespace)
    assert (len(namespace["action"]), namespace["memory"]) == (4, [])
    with pytest.raises(UserError, match=r"observation: got the shape \(2,\); wanted 39 numbers"):
        loaded.predict(packed(support, observation[:2]))


def test_it_says_when_adaptation_diverged_and_keeps_a_few_policies(untrained):
    checkpoint, support = untrained("dmil")
    imitator = Imitator()
    imitator.load_context(PythonModelContext({"checkpoint": str(checkpoint.path)}, {"action_dim": 4}))
    asked = packed(support[:1], support[0].observations[0])
    with pytest.raises(RunError, match=r"not finite after 50 steps of adaptation at 1000\.0; wanted"):
        imitator.answer(asked, FineTuning(50, 1e3))
    for steps in range(POLICIES_KEPT + 2):
        imitator.answer(packed([support[0].window(steps, 2)], support[0].observations[0]), STEPS)
    assert len(imitator.policies) == POLICIES_KEPT


def test_a_checkpoint_that_is_gone_does_not_hold_up_the_others(untrained, mlflow_file: str, tmp_path, monkeypatch):
    checkpoint, _ = untrained("nearest-neighbour")
    (checkpoint.path / "parameters.safetensors").write_bytes(b"")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    tracker = Tracker(tmp_path, "models")
    assert tracker.close("FINISHED")
    client = MlflowClient(mlflow_file)
    run = client.get_run(str(tracker.run_id))
    assert "parameters.safetensors: got damaged" in run.data.tags[f"missing.c/{checkpoint.path.name}"]
    assert models_of(client, run) == []
