"""What holds for all tests: the environment of Ray and MLflow, and what the terminal is taken for."""

import os
import secrets

import pytest

# Ray reads these when it is first imported, after this file, here and in every program that a test starts.
os.environ |= {
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    "RAY_JOB_STOP_WAIT_TIME_S": "60",
    "RAY_USAGE_STATS_ENABLED": "0",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "OMP_NUM_THREADS": "1",
    "TERM": "xterm-256color",
}
for _name in (
    "RAY_ADDRESS", "MLFLOW_TRACKING_URI", "MLFLOW_RUN_ID", "MLFLOW_EXPERIMENT_NAME", "DMIL_DATA", "DMIL_STORAGE",
    "COLUMNS", "LINES", "FORCE_COLOR", "NO_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE",
):  # fmt: skip
    os.environ.pop(_name, None)

LONGEST = (
    "test_same_bits.py", "test_tune_sweep.py", "test_tune_configs.py", "test_methods.py", "test_faults.py",
    "test_runner.py", "test_programs.py", "test_meta_train.py", "test_remote.py", "test_jobs.py",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files that take longest first: one that begins last would keep one process busy and the other idle."""
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))
