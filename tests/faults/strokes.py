"""What befalls a run at a moment of its own, and how that is mended before the run goes on."""

import os
import resource
import shutil
import signal
import sqlite3
import subprocess
from pathlib import Path
from random import Random

from services.cli.stopping import STOPS
from tests.faults.worlds import Program, World

LITTLE = 2**21
"""Bytes of the disk that becomes full."""


class Stroke:
    """Nothing at all; the others strike before the start, amid the run, or both."""

    codes: tuple[int, ...] = (0,)
    """Exit codes that the run may then have."""
    keeps_all = True
    """Whether every finished iteration must be in a checkpoint afterwards."""
    keeps_checkpoints = True
    """Whether every checkpoint that was there must be there afterwards."""
    is_sudden = False
    """Whether the program has no time to clean up."""

    def prepare(self, world: World, draw: Random) -> int | None:
        """Change the world before the program starts; return the descriptor of its standard output, if not the log."""
        return None

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""

    def mend(self, world: World) -> None:
        """Put the world in order again, when the program has ended."""


class Kill(Stroke):
    """SIGKILL."""

    codes, keeps_all, is_sudden = (0, -signal.SIGKILL), False, True

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        program.send(signal.SIGKILL)
        program.wait()


class KillAndDamage(Kill):
    """SIGKILL, and what a disk or a person does then: a byte of the newest checkpoint, a copy and a note beside."""

    keeps_checkpoints = False

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        super().strike(world, program, draw)
        folder = world.run / "checkpoints"
        if (there := sorted(folder.glob("iteration-???????"))) and len(there) > 1:
            shutil.copytree(there[0], folder / f"{there[0].name}.bak")
            (folder / ".DS_Store").write_bytes(b"\0")
            file = draw.choice(sorted(there[-1].iterdir()))
            content = bytearray(file.read_bytes())
            content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
            file.write_bytes(content)


class MachineLost(Kill):
    """SIGKILL, and the run's folder is gone: what the storage has is gone on with."""

    keeps_checkpoints = False

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        super().strike(world, program, draw)
        shutil.rmtree(world.run, ignore_errors=True)


class Stop(Stroke):
    """A signal to stop, or two."""

    codes = (0, *(128 + number for number in STOPS), *(-number for number in STOPS))

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        program.send(number := draw.choice(STOPS))
        if draw.random() < 0.3:
            program.wait(draw.uniform(0, 0.1))
            program.send(number)


class FullDisk(Stroke):
    """No file grows beyond some size any more, as by a quota or ``ulimit -f``; MLflow's is one of them."""

    codes, keeps_all = (0, 1), False

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        if program.wait(0) is None:
            most = draw.choice([0, 100, 2**12, 2**15, 2**17])
            resource.prlimit(program.pid, resource.RLIMIT_FSIZE, (most, most))


class FullTmpfs(Stroke):
    """The disk that the runs are on, but not MLflow's, is full; only root can have such a small one."""

    codes, keeps_all = (0, 1), False

    def prepare(self, world: World, draw: Random) -> None:
        """Change the world before the program starts."""
        self._disk = world.run.parent
        mount = ["mount", "-t", "tmpfs", "-o", f"size={LITTLE}", "tmpfs", str(self._disk)]
        self._mounted = subprocess.run(mount, check=False, capture_output=True).returncode == 0
        (self._disk / "other").mkdir(exist_ok=True)
        (self._disk / "other" / "config.json").write_text("precious")

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        if self._mounted:
            self._ballast = self._disk / "ballast"
            left = os.statvfs(self._disk)
            spare = draw.choice([0, 0, 2**12, 2**14, 2**16])
            self._ballast.write_bytes(b"x" * max(0, left.f_bavail * left.f_bsize - spare))

    def mend(self, world: World) -> None:
        """Put the world in order again."""
        if self._mounted:
            self._ballast.unlink()
            kept = self._disk.with_name("kept")
            shutil.copytree(self._disk, kept, symlinks=True)
            subprocess.run(["umount", str(self._disk)], check=True)
            shutil.rmtree(self._disk)
            kept.rename(self._disk)


class NoMlflow(Stroke):
    """MLflow does not answer from the beginning."""

    def prepare(self, world: World, draw: Random) -> None:
        """Change the world before the program starts."""
        world.variables["MLFLOW_TRACKING_URI"] = "http://127.0.0.1:9"

    def mend(self, world: World) -> None:
        """Put the world in order again."""
        world.variables["MLFLOW_TRACKING_URI"] = ""


class MlflowLocked(Stroke):
    """Somebody locks MLflow's database and does not let go."""

    _lock: sqlite3.Connection | None = None

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        self._lock = sqlite3.connect(world.database, timeout=5, isolation_level=None)
        self._lock.execute("begin exclusive")

    def mend(self, world: World) -> None:
        """Put the world in order again."""
        if self._lock is not None:
            self._lock.close()


class MlflowGone(Stroke):
    """There is a folder in the place of MLflow's database."""

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        replace_by_folder(world.database)

    def mend(self, world: World) -> None:
        """Put the world in order again."""
        restore(world.database)


class StorageGone(Stroke):
    """There is a file in the place of the storage."""

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        world.storage.rename(world.storage.with_suffix(".away"))
        world.storage.touch()

    def mend(self, world: World) -> None:
        """Put the world in order again."""
        world.storage.unlink()
        world.storage.with_suffix(".away").rename(world.storage)


class OutputClosed(Stroke):
    """Whoever reads the output goes away."""

    def prepare(self, world: World, draw: Random) -> int:
        """Change the world before the program starts."""
        self._reader, self._writer = os.pipe()
        os.set_inheritable(self._reader, False)
        return self._writer

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        os.close(self._reader)
        os.close(self._writer)


class OutputFull(Stroke):
    """The disk that the output goes to is full."""

    def prepare(self, world: World, draw: Random) -> int:
        """Change the world before the program starts."""
        return os.open("/dev/full", os.O_WRONLY)


class Moved(Stroke):
    """The run's folder is moved away, and back later."""

    codes, keeps_all = (0, 1), False

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        self._away = world.root / "away"
        if world.is_begun:
            world.run.rename(self._away)

    def mend(self, world: World) -> None:
        """Put the world in order again."""
        if self._away.exists() and not world.run.exists():
            self._away.rename(world.run)


class Second(Stroke):
    """A second process goes on with the run while the first is at work."""

    def strike(self, world: World, program: Program, draw: Random) -> None:
        """Strike amid the run."""
        if world.is_begun and program.wait(0) is None:
            self.code = world.start("meta_train", "--resume", str(world.run), "--runner", "local").wait()


def replace_by_folder(path: Path) -> None:
    """Put a folder in a file's place, and keep the file beside."""
    path.rename(path.with_name(f"{path.name}.away"))
    path.mkdir()


def restore(path: Path) -> None:
    """Put the file back."""
    path.rmdir()
    path.with_name(f"{path.name}.away").rename(path)


STROKES: dict[str, tuple[type[Stroke], int]] = {
    "nothing": (Stroke, 1), "kill": (Kill, 4), "kill, damaged checkpoint": (KillAndDamage, 3),
    "machine lost": (MachineLost, 2), "stop": (Stop, 5), "full disk (quota)": (FullDisk, 4),
    "full disk": (FullTmpfs, 3), "no MLflow": (NoMlflow, 1), "MLflow locked": (MlflowLocked, 1),
    "MLflow gone": (MlflowGone, 1), "storage gone": (StorageGone, 2), "output closed": (OutputClosed, 2),
    "output full": (OutputFull, 1), "folder moved": (Moved, 2), "second process": (Second, 2),
}  # fmt: skip
"""By name, with how often each is drawn against the others."""
