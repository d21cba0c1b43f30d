"""What the tests of faults share: the toy suite as an installed package, and small runs of it."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from services import meta_train
from tests.faults.toy_package import install
from tests.services import conftest as services

_console, complaint, logged = services._console, services.complaint, services.logged  # fixtures
mlflow_file, mlflow_server, wait_for = services.mlflow_file, services.mlflow_server, services.wait_for_fixture

TOY = ("--suite", "toy", "--preset", "smoke", "--runner", "local")
SHORT = (
    "--training.iterations", "4", "--training.checkpoint-every", "2", "--evaluation.shots", "1",
    "--evaluation.episodes", "1", "--evaluation.fine-tuning-steps", "1",
)  # fmt: skip


@pytest.fixture(scope="session")
def toy_package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the toy suite as pip would install it."""
    return install(tmp_path_factory.mktemp("toy"))


@pytest.fixture(scope="session")
def toy_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store of the toy's demonstrations, which are collected once."""
    return tmp_path_factory.mktemp("data")


@pytest.fixture
def workplace(
    tmp_path: Path,
    toy_package: Path,
    toy_data: Path,
    mlflow_file: str,
    monkeypatch: pytest.MonkeyPatch,
) -> Path:
    """A working directory of the test's own, where programs find the toy suite, in this process and in others."""
    services.without_pictures(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(toy_package)
    project = Path(__file__).parents[2]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, (toy_package, project))))
    monkeypatch.setenv("DMIL_DATA", str(toy_data))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    return tmp_path


@pytest.fixture
def train(workplace: Path) -> Callable[..., Path]:
    """Meta-trains on the toy in this process, and returns the folder of the run `name`."""

    def run(name: str, *arguments: str, resume: bool = False) -> Path:
        which = ["--resume", name, "--runner", "local"] if resume else [*TOY, *SHORT, "--name", name]
        meta_train.run([*which, *arguments])
        return workplace / "runs" / name

    return run
