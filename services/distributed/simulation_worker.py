"""The actor that runs experts and adapted policies in the simulator."""

from typing import Any, Protocol, TypeVar

import torch

from dmil_core.devices import USUAL, Compute
from dmil_core.errors import as_work_error
from dmil_core.methods.base import Method, Policy
from dmil_core.trajectories import Rollout
from services.distributed.gpus import granted_gpu
from services.rollouts.episodes import collect_rollouts, parallel_episodes
from services.suites.base import Environment, TaskSuite, build_env

ENVIRONMENTS_KEPT = 40
"""At most so many environments stay built in a worker, 24 MB each in Meta-World."""

Result = TypeVar("Result")
ResultOut = TypeVar("ResultOut", covariant=True)


class WorkItem(Protocol[ResultOut]):
    """Pure work for a simulation worker: its result depends on what it holds, and not on the worker."""

    @property
    def label(self) -> str:
        """Its name in messages."""
        ...

    @property
    def key(self) -> dict[str, str | int]:
        """What identifies it in ``failure.json``."""
        ...

    def run(self, worker: "SimulationWorker") -> ResultOut:
        """Do the work in the worker's environments."""
        ...


class SimulationWorker:
    """Builds environments once and uses them again; an episode depends on its seed alone."""

    def __init__(self, suite: TaskSuite, compute: Compute = USUAL) -> None:
        torch.set_num_threads(1)
        self.suite, self._compute = suite, compute
        self._envs: dict[str, list[Environment]] = {}

    def environments(self, task: str, count: int) -> list[Environment]:
        """Return at least `count` environments of a task; those of the tasks longest unused make room."""
        envs = self._envs.pop(task, [])
        while self._envs and max(count, len(envs)) + sum(map(len, self._envs.values())) > ENVIRONMENTS_KEPT:
            for env in self._envs.pop(next(iter(self._envs))):
                env.close()
        envs += [build_env(self.suite, task) for _ in range(count - len(envs))]
        self._envs[task] = envs
        return envs

    def device_for(self, method: Method[Any]) -> torch.device:
        """Return where a method adapts in this process; its policies act on the CPU."""
        return self._compute.device_for(method, granted=granted_gpu())

    def run(self, item: WorkItem[Result]) -> Result:
        """Run a work item.

        Raises:
            WorkError: names it, where there was a Python error in it.
        """
        with as_work_error(item.label, **item.key):
            return item.run(self)

    def collect_rollouts(self, policy: Policy, task: str, seed: int, steps: int) -> list[Rollout]:
        """Let a policy act in a task for so many steps, see `services.rollouts.episodes.collect_rollouts`."""
        envs = self.environments(task, parallel_episodes(steps, self.suite.horizon))
        return collect_rollouts(policy, envs, seed, steps, self.suite.horizon)
