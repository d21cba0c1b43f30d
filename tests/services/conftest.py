"""What the tests of the service share: one small store of demonstrations, one Ray cluster, and the programs."""

import functools
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import jaxtyping
import psutil
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

PROJECT = Path(__file__).parents[2]
ON_RAY = {"cluster", "joined"}
"""Fixtures of the session's Ray cluster."""
QUICK_EVALUATION = ("--evaluation.shots", "1", "--evaluation.episodes", "1", "--evaluation.fine-tuning-steps", "1")


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


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="session", name="free_port")
def free_port_fixture() -> Callable[[], int]:
    """Returns a port of the loopback interface that nothing listens on."""
    return free_port


def wait_for(condition: Callable[[], bool], what: str) -> None:
    print(f"waiting for {what}")  # shown where the test's own limit ends it
    while not condition():
        time.sleep(0.1)


@pytest.fixture(scope="session", name="wait_for")
def wait_for_fixture() -> Callable[..., None]:
    """Waits until a condition holds; what never comes to hold ends with the test's timeout."""
    return wait_for


def answers(url: str) -> bool:
    """Tell whether a server answers with anything at all."""
    try:
        urllib.request.urlopen(url, timeout=5).close()
    except urllib.error.HTTPError:
        return True
    except OSError:
        return False
    return True


@pytest.fixture(scope="session", name="answers")
def answers_fixture() -> Callable[[str], bool]:
    return answers


class Doors(NamedTuple):
    """What another user of the machine tried, and what let it in."""

    ports: int
    sockets: int
    paths: int
    doors: list[str]


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


def shared_memory_of(processes: list[psutil.Process]) -> set[Path]:
    """Return the files in memory that processes have open."""
    found = set[Path]()
    for process in processes:
        with suppress(psutil.Error):
            found |= {Path(part.path) for part in process.memory_maps() if part.path.startswith("/dev/shm/")}
    return found


class Cluster(NamedTuple):
    """A Ray cluster on loopback, started from the project's root as a user would."""

    address: str
    dashboard: str | None
    """Its address, which takes jobs; its ten processes take as long to start as all others."""
    head: int
    """The process that started it."""


class Head:
    """One `ray start --head` with room for three workers, which is there from the first test that wants it."""

    def __init__(self, log: Path) -> None:
        self._log, self._folder = log, ""
        self._process: subprocess.Popen[bytes] | None = None
        self._cluster: Cluster | None = None

    def cluster(self, *, dashboard: bool) -> Cluster:
        """Start it, unless it runs, with a dashboard where one is wanted."""
        if self._cluster is None or (dashboard and self._cluster.dashboard is None):
            self.stop()
            self._folder = tempfile.mkdtemp(prefix="dmil")  # Ray's sockets lie in it: over 107 bytes are too long
            self._process, self._cluster = self._start(dashboard)
            for _ in range(2):  # somebody else was faster to take one of its ports, or is so busy that Ray gives up
                if self._process.poll() is not None:
                    self._process, self._cluster = self._start(dashboard)
            assert self._process.poll() is None, self._log.read_text()
        return self._cluster

    def _start(self, dashboard: bool) -> tuple[subprocess.Popen[bytes], Cluster]:
        """Start Ray, and wait until it answers or has ended."""
        port, dashboard_port = free_port(), free_port()
        command = [
            sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block", "--num-cpus=3",
            "--node-ip-address=127.0.0.1", f"--port={port}", "--dashboard-host=127.0.0.1",
            f"--dashboard-port={dashboard_port}", f"--include-dashboard={dashboard}", f"--temp-dir={self._folder}",
            f"--dashboard-agent-listen-port={free_port()}",  # another cluster may hold the usual one
            "--object-store-memory=200000000", "--disable-usage-stats", "--include-log-monitor=false",
        ]  # fmt: skip
        unbuffered = os.environ | {"PYTHONUNBUFFERED": "1"}
        with self._log.open("w") as output:
            head = subprocess.Popen(command, cwd=PROJECT, stdout=output, stderr=output, env=unbuffered)
        url = f"http://127.0.0.1:{dashboard_port}" if dashboard else None
        cluster = Cluster(f"127.0.0.1:{port}", url, head.pid)

        def is_up() -> bool:
            """Tell also whether its node is: the dashboard is there before."""
            return "Ray runtime started" in self._log.read_text() and (url is None or answers(f"{url}/api/version"))

        wait_for(lambda: is_up() or head.poll() is not None, "ray start")
        return head, cluster

    def stop(self) -> None:
        """End it, if it runs: its processes are never quite idle."""
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait()
            shutil.rmtree(self._folder, ignore_errors=True)
        self._process = self._cluster = None


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


class Server:
    """A real MLflow server on loopback that can go away and come back with its database."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = folder, free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = [
            sys.executable, "-m", "mlflow", "server", "--backend-store-uri", f"sqlite:///{self.folder}/server.db",
            "--artifacts-destination", str(self.folder / "artifacts"), "--host", "127.0.0.1", "--port", str(self.port),
            "--workers", "1",
        ]  # fmt: skip
        with (self.folder / "server.log").open("a") as log:
            environment = os.environ | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}  # of eight processes more
            self._process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True, env=environment)
        wait_for(lambda: answers(f"{self.uri}/health"), "mlflow server")

    def stop(self) -> None:
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait()
            self._process = None
            wait_for(lambda: not answers(f"{self.uri}/health"), "the end of mlflow server")


@pytest.fixture(scope="session")
def mlflow_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """One MLflow server for the whole session."""
    server = Server(tmp_path_factory.mktemp("server"))
    server.start()
    yield server
    server.stop()


class Programs:
    """Starts programs as a user does, in the test's working directory and environment."""

    def __init__(self) -> None:
        self._started: list[subprocess.Popen[str]] = []

    def start(self, name: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", f"services.{name}", *arguments]
        program = subprocess.Popen(
            command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
        )
        self._started.append(program)
        return program

    def __call__(self, name: str, *arguments: str) -> tuple[int, str]:
        """Run a program to its end; return its exit code, and what it printed."""
        program = self.start(name, *arguments)
        printed, _ = program.communicate()
        return program.returncode, printed

    def kill(self) -> None:
        """End what a failed test has left running."""
        for program in self._started:
            if program.poll() is None:
                os.killpg(program.pid, signal.SIGKILL)
                program.communicate()


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
