"""What the tests of the service share: one small store of demonstrations and runs on it, one Ray cluster."""

import functools
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jaxtyping
import pytest
from mlflow import MlflowClient

from dmil_core.checkpoint import Checkpoint
from dmil_core.configs import PRESETS, ExperimentConfig
from services import meta_train
from services.cli.arguments import exit_code
from services.cli.progress import console_logging
from services.demonstrations.store import DemoStore, TaskDemonstrations
from services.distributed.ray_runner import open_runner
from services.experiments.experiment import Experiment
from services.experiments.finished_run import FinishedRun
from services.reporting import run_report
from services.storage.checkpoints import Checkpoints
from services.suites import metaworld_speed
from tests.services.pages import browser, open_page  # noqa: F401  fixtures
from tests.services.programs import (
    ON_RAY,
    QUICK_EVALUATION,
    Cluster,
    Doors,
    Head,
    Programs,
    Server,
    answers,
    free_port,
    wait_for,
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.thorough)


@pytest.fixture(autouse=True)
def _console() -> Iterator[None]:
    """A test that calls a program's `run` reads on the console what was logged, as where the program was started."""
    with console_logging(quiet=False):
        yield


@pytest.fixture(autouse=True)
def _unchecked_shapes() -> Iterator[None]:
    """Whole runs take twice as long where every shape in them is checked, as the tests of dmil_core do."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


@pytest.fixture
def checked_shapes(_unchecked_shapes: None) -> None:
    """Checks the shapes of this test after all."""
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def logged(caplog: pytest.LogCaptureFixture) -> Callable[[], list[str]]:
    """Returns what the modules of ``services`` have logged so far."""
    return lambda: [record.getMessage() for record in caplog.records if record.name.startswith("services.")]


@pytest.fixture(scope="session")
def config() -> ExperimentConfig:
    """Three tasks to train on and one to test on, tiny networks."""
    return PRESETS["ml10-smoke"]


@pytest.fixture(scope="session")
def store(config: ExperimentConfig, tmp_path_factory: pytest.TempPathFactory) -> DemoStore:
    """The demonstrations of `config`, collected once."""
    store = DemoStore(tmp_path_factory.mktemp("data"))
    experiment = Experiment(config, store)
    with open_runner("local", experiment.suite, None) as runner:
        experiment.collect(runner)
    return store


@pytest.fixture(scope="session")
def experiment(config: ExperimentConfig, store: DemoStore) -> Experiment:
    return Experiment(config, store)


@pytest.fixture(scope="session")
def data(experiment: Experiment) -> dict[str, TaskDemonstrations]:
    with open_runner("local", experiment.suite, None) as runner:
        return experiment.collect(runner)


@pytest.fixture(scope="session", name="free_port")
def free_port_fixture() -> Callable[[], int]:
    """Returns a port of the loopback interface that nothing listens on."""
    return free_port


@pytest.fixture(scope="session", name="wait_for")
def wait_for_fixture() -> Callable[..., None]:
    """Waits until a condition holds; what never comes to hold ends with the test's timeout."""
    return wait_for


@pytest.fixture(scope="session", name="answers")
def answers_fixture() -> Callable[[str], bool]:
    return answers


@pytest.fixture
def doors() -> Callable[..., Doors | None]:
    """Goes round folders and processes, given by their numbers, with what these started, as another user would.

    Only root can become another user: for others it finds nothing.
    """

    def doors(*targets: Path | int) -> Doors | None:
        if os.geteuid() != 0:
            return None
        command = [sys.executable, str(Path(__file__).with_name("neighbour.py")), *map(str, targets)]
        return Doors(**json.loads(subprocess.check_output(command)))

    return doors


@pytest.fixture(scope="session")
def head(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Head]:
    head = Head(tmp_path_factory.mktemp("ray") / "head.log")
    yield head
    head.stop()


@pytest.fixture
def cluster(head: Head) -> Cluster:
    """The session's Ray cluster, with a dashboard that takes jobs."""
    return head.cluster(dashboard=True)


@pytest.fixture(scope="module", autouse=True)
def _no_idle_cluster(request: pytest.FixtureRequest, head: Head) -> None:
    """The files whose tests want a cluster come first: it ends at the first other one."""
    items = (item for item in request.session.items if item.path == request.path)
    if ON_RAY.isdisjoint(name for item in items for name in getattr(item, "fixturenames", ())):
        head.stop()


@pytest.fixture
def joined(head: Head, monkeypatch: pytest.MonkeyPatch) -> Cluster:
    """Ray runners of this test join the session's cluster."""
    cluster = head.cluster(dashboard=False)
    monkeypatch.setenv("RAY_ADDRESS", cluster.address)
    return cluster


@pytest.fixture(scope="session")
def mlflow_file(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The address of an SQLite file with its tables: who is killed while it makes them leaves a file of no use."""
    uri = f"sqlite:///{tmp_path_factory.mktemp('mlflow') / 'mlflow.db'}"
    MlflowClient(uri).search_experiments()
    return uri


@pytest.fixture
def workplace(tmp_path: Path, store: DemoStore, mlflow_file: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory of the test's own, where programs find the demonstrations collected already."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DMIL_DATA", str(store.root))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    return tmp_path


@pytest.fixture(scope="session")
def shared_run(store: DemoStore, mlflow_file: str, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Meta-trains in this process, once a session for all tests that only read what comes of it; returns its folder."""
    runs = tmp_path_factory.mktemp("runs")

    @functools.cache
    def run(name: str, *arguments: str, pictures: bool = False) -> Path:
        with pytest.MonkeyPatch.context() as environment:
            if not pictures:
                without_pictures(environment)
            environment.setenv("DMIL_DATA", str(store.root))
            environment.setenv("MLFLOW_TRACKING_URI", mlflow_file)
            environment.chdir(runs)
            where = ["--runner", "local", "--runs", str(runs), "--name", name]
            meta_train.run(["--preset", "ml10-smoke", *where, *arguments])
        return runs / name

    return run


@pytest.fixture
def copied_run(workplace: Path, shared_run: Callable[..., Path]) -> Callable[[int], Path]:
    """Returns runs/run, a copy of a shared run of so many iterations, for a test to damage."""

    def copy(iterations: int) -> Path:
        source = shared_run(f"after-{iterations}", "--training.iterations", str(iterations), *QUICK_EVALUATION)
        return Path(shutil.copytree(source, workplace / "runs" / "run"))

    return copy


@pytest.fixture(scope="session")
def mlflow_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """One MLflow server for the whole session."""
    server = Server(tmp_path_factory.mktemp("server"))
    server.start()
    yield server
    server.stop()


@pytest.fixture
def programs(workplace: Path) -> Iterator[Programs]:
    # A shell has what it starts in the background ignore Ctrl-C, and so would the programs.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    programs = Programs()
    yield programs
    programs.kill()
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session", autouse=True)
def _models_kept() -> None:
    """A process of tests builds the environments of a few tasks again and again: their models are compiled once."""
    metaworld_speed._compiled = functools.lru_cache(maxsize=8)(metaworld_speed._compiled.__wrapped__)


def without_pictures(patch: pytest.MonkeyPatch) -> None:
    """The page of a run that ends has its table, and not the pictures, which take longer than a small run."""
    patch.setattr(run_report.write_run_page, "__defaults__", ((), lambda: None))  # no sections, and no bar


@pytest.fixture
def plain_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    without_pictures(monkeypatch)


@pytest.fixture
def train(workplace: Path, plain_pages: None) -> Callable[..., Checkpoint]:
    """Meta-trains in this process, and returns the newest checkpoint of the run `name`."""

    def run(name: str, *arguments: str, resume: bool = False) -> Checkpoint:
        which = ["--resume", name] if resume else ["--preset", "ml10-smoke", "--name", name]
        runner = [] if "--runner" in arguments else ["--runner", "local"]
        meta_train.run([*which, *runner, *QUICK_EVALUATION, *arguments])
        return Checkpoints(workplace / "runs" / name / "checkpoints", kept=1).newest()

    return run


@pytest.fixture
def complaint(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a program in this process on a mistake, which ends with exit code 2, and returns what it says."""

    def say(program: Callable[[Sequence[str]], None], *arguments: str) -> str:
        capsys.readouterr()
        try:
            code = exit_code(program, arguments)
        except SystemExit as end:
            code = end.code
        assert code == 2
        return "".join(capsys.readouterr())

    return say


@pytest.fixture(scope="session")
def finished(shared_run: Callable[..., Path]) -> FinishedRun:
    """A run of four iterations on three tasks, evaluated on the way too: two episodes for each of 1 and 2 shots."""
    schedule = ("--training.iterations", "4", "--training.checkpoint-every", "2", "--evaluation.every", "2")
    return FinishedRun(
        shared_run(
            "tiny", *schedule, "--evaluation.shots", "1", "2", "--evaluation.fine-tuning-steps", "1", pictures=True
        )
    )
