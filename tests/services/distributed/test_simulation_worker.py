"""A simulation worker keeps the environments it built, up to a bound."""

import pytest

from dmil_core.configs import DemonstrationConfig, SuiteConfig
from services.distributed import simulation_worker
from services.distributed.simulation_worker import SimulationWorker
from services.distributed.work_items import ExpertAttempts
from services.suites.base import Environment
from services.suites.metaworld import MetaWorldSuite


class CountingSuite(MetaWorldSuite):
    """Remembers which environments were built."""

    def __init__(self) -> None:
        super().__init__(SuiteConfig(horizon=5))
        self.built: list[str] = []

    def make_env(self, task: str, *, rewards: bool = False) -> Environment:
        self.built.append(task)
        return super().make_env(task, rewards=rewards)


def test_environments_are_built_once_and_used_again():
    suite = CountingSuite()
    worker = SimulationWorker(suite)
    attempts = {
        task: [worker.run(ExpertAttempts(task, [0, 1], DemonstrationConfig())) for _ in range(2)]
        for task in ("reach", "push")
    }
    again = worker.run(ExpertAttempts("reach", [0, 1], DemonstrationConfig()))
    assert suite.built == ["reach", "push"]
    for first, second in zip(attempts["reach"][0], again, strict=True):
        assert first.goal == second.goal
        assert (first.observations == second.observations).all()


def test_the_task_longest_unused_makes_room(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(simulation_worker, "ENVIRONMENTS_KEPT", 2)
    suite = CountingSuite()
    worker = SimulationWorker(suite)
    for task in ("reach", "push", "reach", "sweep", "reach", "push"):
        worker.run(ExpertAttempts(task, [0], DemonstrationConfig()))
    assert suite.built == ["reach", "push", "sweep", "push"]
