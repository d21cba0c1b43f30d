"""A world for a program: folders of odd names, a store, an MLflow, a storage, and bystanders that nobody may touch."""

import hashlib
import json
import os
import shutil
import signal
import sqlite3
import sys
import time
import traceback
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from dmil_core.checkpoint import iteration_of, newest_whole
from services.cli.arguments import exit_code
from services.cli.stopping import STOPS

PATIENCE = 120.0
"""Seconds after which a program counts as hung; a run takes two."""


class Program:
    """A program in a fork of this process: the imports take longer than a run of the toy."""

    def __init__(self, name: str, arguments: Sequence[str], world: "World", out: int | None) -> None:
        """Start ``services.NAME``; it prints into the world's log, or on `out` if that is given."""
        with world.log.open("ab") as log:
            self.pid = os.fork()
            if not self.pid:
                _carry_out(name, arguments, world, log.fileno() if out is None else out, log.fileno())
        self._code: int | None = None

    def wait(self, seconds: float = PATIENCE) -> int | None:
        """Return the exit code, minus the signal's number for one that ended it, or None if it goes on after that."""
        until = time.monotonic() + seconds
        while self._code is None:
            ended, status = os.waitpid(self.pid, os.WNOHANG)
            if ended:
                self._code = os.waitstatus_to_exitcode(status)
            elif time.monotonic() > until:
                return None
            else:
                time.sleep(0.003)
        return self._code

    def send(self, number: int) -> None:
        """Send a signal, if it is there still."""
        if self.wait(0) is None:
            os.kill(self.pid, number)


def _carry_out(name: str, arguments: Sequence[str], world: "World", out: int, err: int) -> None:
    code = 1
    try:
        os.setsid()
        for number in STOPS:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        os.chdir(world.place)
        os.environ.update(world.variables)
        for target, descriptor in enumerate((os.open(os.devnull, os.O_RDONLY), out, err)):
            os.dup2(descriptor, target)
        os.closerange(3, 1024)  # the other end of a pipe
        code = exit_code(import_module(f"services.{name}").run, arguments)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:  # noqa: BLE001  as the interpreter's own end
        traceback.print_exc()
    finally:
        with suppress(OSError, ValueError):
            sys.stdout.flush()
        os._exit(code)


class World:
    """Everything that a run sees."""

    def __init__(self, root: Path, place: str, runs: str, name: str, template: Path) -> None:
        """Make it in the new folder `root`.

        Args:
            root: holds all of it.
            place: the name of the working directory.
            runs: the folder of runs in it.
            name: of the run.
            template: an MLflow database with its tables, which take seconds to make.
        """
        self.root, self.log = root, root.with_suffix(".log")
        self.place, self.home, self.storage, self.temporary = (root / name for name in (place, "home", "bucket", "tmp"))
        self.run = self.place / runs / unicodedata.normalize("NFC", name)
        self.database = self.place / "mlflow.db"
        self.variables = {"HOME": str(self.home), "TMPDIR": str(self.temporary)}
        for folder in (self.home, self.temporary, self.place / runs / "other", self.storage / "runs" / "other"):
            folder.mkdir(parents=True)
            if folder != self.temporary:
                (folder / "config.json").write_text("precious")
        shutil.copy(template, self.database)

    def start(self, name: str, *arguments: str, out: int | None = None) -> Program:
        """Start a program in the working directory."""
        return Program(name, arguments, self, out)

    def printed(self) -> str:
        """Return what all programs so far have printed."""
        return self.log.read_text(errors="replace") if self.log.exists() else ""

    def bystanders(self) -> dict[str, str]:
        """Return the digest of all that is neither the run's nor the store's, by its path."""
        own = (self.run, self.place / "data", self.storage / "data", self.storage / "runs" / self.run.name)
        found = {}
        for path in self.root.rglob("*"):
            is_own = any(folder in (path, *path.parents) for folder in (*own, self.place / "mlartifacts"))
            if not is_own and not path.is_dir() and not path.name.startswith("mlflow.db"):
                found[str(path.relative_to(self.root))] = hashlib.sha256(path.read_bytes()).hexdigest()
        return found

    @property
    def is_begun(self) -> bool:
        """Whether there is a run to go on with."""
        return (self.run / "config.json").exists()

    def newest(self) -> int:
        """Return the iteration of the newest whole checkpoint, or -1."""
        whole = newest_whole(self.run / "checkpoints")[0]
        return -1 if whole is None else whole.manifest.iteration

    def recorded(self) -> int:
        """Return the last iteration whose loss was recorded, or -1."""
        return max((value["step"] for value in self._metrics() if "loss" in value["values"]), default=-1)

    def losses(self) -> int:
        """Return how many iterations' losses were recorded."""
        return len({value["step"] for value in self._metrics() if "loss" in value["values"]})

    def _metrics(self) -> Iterator[Mapping[str, Any]]:
        with suppress(FileNotFoundError):
            for line in (self.run / "tracking.jsonl").read_bytes().splitlines():
                with suppress(ValueError):  # cut off by a kill
                    kind, value = json.loads(line)
                    if kind == "metrics":
                        yield value

    def bits(self) -> dict[str, str]:
        """Return the digest of all that a run ends with: parameters, the optimiser's state, and every result row."""
        files = [path for path in self.run.rglob("*.jsonl") if path.name != "tracking.jsonl"]
        last = max((self.run / "checkpoints").glob("iteration-???????"), key=iteration_of)
        digests = {
            path: hashlib.sha256(path.read_bytes()).hexdigest() for path in (*files, *last.glob("*.safetensors"))
        }
        return {str(path.relative_to(self.run)): digest for path, digest in digests.items()}

    def delivered(self) -> tuple[str, int]:
        """Return the status of the run in MLflow, and how many iterations' losses that has."""
        with closing(sqlite3.connect(self.database)) as records:
            statuses = [status for (status,) in records.execute("select status from runs")]
            losses = records.execute("select count(distinct step) from metrics where key = 'loss'").fetchone()[0]
        return " ".join(statuses), losses
