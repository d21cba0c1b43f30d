"""What `deploy/` runs in containers, as processes: Postgres, MLflow's server, a Ray head and two workers, and a job.

They run in a network of their own, whose only addresses are loopback's: there each node has one, as on a cluster.
"""

import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.services.programs import QUICK_EVALUATION

PROJECT = Path(__file__).parents[2]
POSTGRES = max(Path("/usr/lib/postgresql").glob("*/bin"), default=Path("postgresql-is-not-installed"))
NODES = ("127.0.0.2", "127.0.0.3")


class Network:
    """A network of its own, and the processes in it."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self._folder, self._environment = folder, environment
        up = "ip link set lo up && echo up && exec sleep infinity"
        self._holder = subprocess.Popen(["unshare", "--net", "sh", "-c", up], stdout=subprocess.PIPE)
        assert self._holder.stdout
        assert self._holder.stdout.readline() == b"up\n"
        self._inside = ["nsenter", "--target", str(self._holder.pid), "--net"]
        self._processes: list[subprocess.Popen[Any]] = []

    def run(self, *command: str, **options: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*self._inside, *command], text=True, capture_output=True, cwd=PROJECT, env=self._environment,
            **options,
        )  # fmt: skip

    def answers(self, port: int) -> bool:
        """Tell whether a web server answers with anything at all, which bash asks at little cost."""
        ask = rf"exec 3<>/dev/tcp/127.0.0.1/{port}; printf 'GET / HTTP/1.0\r\n\r\n' >&3; grep -q ^HTTP/ <&3"
        return self.run("bash", "-c", ask).returncode == 0

    def log(self, name: str) -> str:
        """Return what a process has printed."""
        return (self._folder / f"{name}.log").read_text()

    def start(self, name: str, *command: str, **options: Any) -> subprocess.Popen[Any]:
        with (self._folder / f"{name}.log").open("w") as log:
            process = subprocess.Popen(
                [*self._inside, *command], stdout=log, stderr=log, cwd=PROJECT, env=self._environment, **options
            )
        self._processes.append(process)
        return process

    def logs(self) -> str:
        return "\n".join(f"{path}:\n{path.read_text()[-2000:]}" for path in sorted(self._folder.glob("*.log")))

    def close(self) -> None:
        for process in reversed(self._processes):
            process.terminate()
        for process in self._processes:
            process.wait()
        self._holder.kill()
        self._holder.wait()
        if self._holder.stdout:
            self._holder.stdout.close()


@pytest.fixture
def network(tmp_path: Path) -> Iterator[Network]:
    probe = subprocess.run(["unshare", "--net", "true"], capture_output=True, text=True)
    if probe.returncode:
        pytest.skip(f"no right to make a network: {probe.stderr}")
    if not POSTGRES.exists():
        pytest.fail("no Postgres here: apt-get install postgresql")
    token = tmp_path / "token"
    token.write_text(secrets.token_hex(32))
    token.chmod(0o600)
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "MLFLOW_"))}
    network = Network(
        tmp_path,
        environment
        | {
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN_PATH": str(token),
            "RAY_USAGE_STATS_ENABLED": "0",
            "PYTHONUNBUFFERED": "1",
            "MLFLOW_TRACKING_URI": "http://127.0.0.1:5000",
            "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
            "MLFLOW_DISABLE_TELEMETRY": "true",
        },
    )
    try:
        yield network
    finally:
        network.close()


@pytest.fixture
def postgres(network: Network, wait_for: Callable[..., None]) -> Iterator[str]:
    """The address of a database; Postgres does not run as root."""
    folder = Path(tempfile.mkdtemp(prefix="dmil-pg"))
    shutil.chown(folder, "postgres")
    as_postgres: dict[str, Any] = {"user": "postgres"} if os.geteuid() == 0 else {}
    made = subprocess.run(
        [POSTGRES / "initdb", "-D", folder / "data", "-U", "mlflow", "--auth=trust"],
        capture_output=True, text=True, **as_postgres,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    server = [str(POSTGRES / "postgres"), "-D", str(folder / "data"), "-k", str(folder), "-h", "127.0.0.1"]
    user = ["setpriv", "--reuid=postgres", "--regid=postgres", "--clear-groups"] if as_postgres else []
    network.start("postgres", *user, *server)
    ready = (str(POSTGRES / "pg_isready"), "-h", "127.0.0.1", "-U", "mlflow")
    wait_for(lambda: network.run(*ready).returncode == 0, "Postgres")
    yield "postgresql+psycopg2://mlflow@127.0.0.1/postgres"
    network.close()
    shutil.rmtree(folder)


@pytest.mark.thorough
def test_a_job_on_two_raylets_becomes_a_finished_run_of_mlflow_on_postgres(
    network: Network, postgres: str, store, workplace: Path, wait_for: Callable[..., None]
):
    network.start(
        "mlflow", sys.executable, "-m", "mlflow", "server", "--backend-store-uri", postgres,
        "--artifacts-destination", str(workplace / "artifacts"), "--host", "127.0.0.1", "--port", "5000",
        "--workers", "1", "--gunicorn-opts", "--threads 8 --timeout 60 --no-control-socket",
    )  # fmt: skip
    ray = (sys.executable, "-m", "ray.scripts.scripts")
    temporary = tempfile.mkdtemp(prefix="dmil")
    common = ("--block", "--disable-usage-stats", "--object-store-memory=100000000")
    network.start(
        "head", *ray, "start", "--head", "--num-cpus=0", "--node-ip-address=127.0.0.1", "--port=6379",
        "--dashboard-host=127.0.0.1", f"--temp-dir={temporary}", *common,
    )  # fmt: skip
    client = "import mlflow, sys; c = mlflow.MlflowClient(); "

    def is_up(node: str) -> bool:
        return "Ray runtime started" in network.log(node)

    try:
        wait_for(lambda: is_up("head") and network.answers(8265), "Ray's head")
        for number, address in enumerate(NODES):  # they share a folder here, and one may not find itself in it
            for _ in range(3):  # Ray gives up after 30 s, which a busy machine may need
                worker = network.start(
                    f"worker{number}", *ray, "start", "--address=127.0.0.1:6379", f"--node-ip-address={address}",
                    "--num-cpus=1", *common,
                )  # fmt: skip
                wait_for(lambda n=number, w=worker: w.poll() is not None or is_up(f"worker{n}"), "a worker")
                if worker.poll() is None:
                    break
        wait_for(lambda: network.answers(5000), "MLflow")
        submitted = network.run(
            *ray, "job", "submit", "--address", "http://127.0.0.1:8265",
            "--runtime-env-json", f'{{"env_vars": {{"DMIL_DATA": "{store.root}"}}}}', "--",
            sys.executable, "-m", "services.meta_train", "--preset", "ml10-smoke",
            "--runs", str(workplace / "runs"), "--name", "job", "--training.iterations", "2",
            "--training.checkpoint-every", "2", *QUICK_EVALUATION,
        )  # fmt: skip
        assert submitted.returncode == 0, submitted.stdout + submitted.stderr
        runs = "c.search_runs([c.get_experiment_by_name('dmil-ml10').experiment_id])"
        look = f"print([run.info.status for run in {runs}])"
        assert network.run(sys.executable, "-c", client + look).stdout.strip() == "['FINISHED']"
        actors = network.run(
            *ray, "list", "actors", "--address", "http://127.0.0.1:8265", "--format", "json", "--detail"
        )
        homes = {(actor["class_name"], actor["node_id"]) for actor in json.loads(actors.stdout)}
        work = ("Learner", "AdaptationWorker", "SimulationWorker")
        assert [len([home for home in homes if home[0] == name]) for name in work] == [1, 2, 2], actors.stdout
    except AssertionError as error:
        raise AssertionError(f"{error}\n{network.logs()}") from error
    finally:
        network.close()
        shutil.rmtree(temporary, ignore_errors=True)
