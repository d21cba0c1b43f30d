"""What holds for all tests: the environment of Ray and MLflow, and what the terminal is taken for."""

import os
import secrets
from collections.abc import Callable
from typing import Any

import jaxtyping
import pytest

from tests.services.programs import ON_RAY

# Ray reads these when it is first imported, after this file, here and in every program that a test starts.
os.environ |= {
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    "RAY_JOB_STOP_WAIT_TIME_S": "60",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_USAGE_STATS_REPORT_URL": "",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "OMP_NUM_THREADS": "1",
    "TERM": "xterm-256color",
}
for _name in (
    "RAY_ADDRESS", "MLFLOW_TRACKING_URI", "MLFLOW_RUN_ID", "MLFLOW_EXPERIMENT_NAME", "DMIL_DATA", "DMIL_STORAGE",
    "COLUMNS", "LINES", "FORCE_COLOR", "NO_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE",
):  # fmt: skip
    os.environ.pop(_name, None)

_decorated = jaxtyping.jaxtyped


def _jaxtyped(*, typechecker: Any) -> Callable[[Any], Any]:
    """Decorate as jaxtyping does, but for the functions that another defines at each call while nothing is checked.

    To write the checks of such a one takes longer than what it does: half the time of a training.
    """

    def decorate(made: Any) -> Any:
        inner = "<locals>" in getattr(made, "__qualname__", "")
        return made if inner and jaxtyping.config.jaxtyping_disable else _decorated(made, typechecker=typechecker)

    return decorate


jaxtyping.jaxtyped = _jaxtyped  # which the modules of dmil_core find there

LONGEST = (
    "test_same_bits.py", "test_tune_sweep.py", "test_tune_configs.py", "test_methods.py", "test_faults.py",
    "test_runner.py", "test_programs.py", "test_meta_train.py", "test_jobs.py", "test_metaworld_speed.py",
    "test_local_cluster.py", "test_fuzz.py", "test_remote.py", "test_metaworld.py", "test_stack.py", "test_progress.py",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files that take longest first: one that begins last would keep one process busy and the other idle.

    Before all others go those that share a Ray cluster, which then ends.
    """
    on_ray = {item.path for item in items if not ON_RAY.isdisjoint(getattr(item, "fixturenames", ()))}

    def place(item: pytest.Item) -> tuple[bool, int]:
        name = item.path.name
        return item.path not in on_ray, LONGEST.index(name) if name in LONGEST else len(LONGEST)

    items.sort(key=place)
