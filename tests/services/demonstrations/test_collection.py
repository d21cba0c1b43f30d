"""Demonstrations are kept as each task has enough, and an expert that hardly ever succeeds is given up."""

from pathlib import Path

import numpy as np
import pytest

from dmil_core.configs import ExperimentConfig
from dmil_core.demonstrations import DemonstrationError
from dmil_core.errors import RunError
from services.demonstrations.collection import DemonstrationCollection
from services.demonstrations.store import DemoStore
from services.distributed.runner import LocalRunner
from services.suites.base import Expert
from services.suites.metaworld import MetaWorldSuite

SETTINGS = {
    "suite": {"train_tasks": ("reach", "push"), "test_tasks": ("reach",)},
    "demonstrations": {"per_task": 3, "held_out": 1},
    "evaluation": {"shots": (1,), "support_draws": 1},
}


class Broken:
    def get_action(self, obs: np.ndarray, /) -> np.ndarray:
        raise ArithmeticError("out of numbers")


class HalfBroken(MetaWorldSuite):
    def expert(self, task: str) -> Expert:
        return Broken() if task == "push" else super().expert(task)


def test_what_is_collected_before_a_fault_is_kept(tmp_path: Path):
    config, store = ExperimentConfig.model_validate(SETTINGS), DemoStore(tmp_path)
    suite = HalfBroken(config.suite)
    with pytest.raises(RunError, match=r"task push, attempt 0, seed \d+: ArithmeticError: out of numbers"):
        DemonstrationCollection(config, suite, store).collect(LocalRunner(suite))
    kept = store.load(store.dataset_id("reach", suite, config.demonstrations), "reach")
    assert kept is not None
    assert len(kept.demonstrations) == 3
    whole = DemonstrationCollection(config, MetaWorldSuite(config.suite), store)
    found = whole.collect(LocalRunner(MetaWorldSuite(config.suite)))
    assert list(found) == ["reach", "push"]
    assert found["reach"].digest == kept.digest


def test_an_expert_that_never_succeeds_is_given_up(tmp_path: Path):
    config = ExperimentConfig.model_validate(SETTINGS | {"suite": {**SETTINGS["suite"], "horizon": 3}})
    suite = MetaWorldSuite(config.suite)
    with pytest.raises(DemonstrationError, match="task reach: its expert solved 0 of 30 attempts; wanted 3 demonstra"):
        DemonstrationCollection(config, suite, DemoStore(tmp_path)).collect(LocalRunner(suite))
    assert not list(tmp_path.rglob("*.hdf5"))
