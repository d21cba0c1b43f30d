"""The folders of runs and sweeps: made under a name, and found by it or by their path."""

import os
import shlex
import unicodedata
from collections.abc import Mapping
from pathlib import Path

from dmil_core.errors import UserError, shorten
from dmil_core.files import ForeignFileError, at_home, create_file, inside, making_folder, room_for

CONFIG, SUMMARY = "config.json", "summary.json"
"""In a run's folder: the settings, there from its begin on, and the summary, there once it has ended."""
SPOOL, IDENTITY = "tracking.jsonl", "mlflow_run.json"
"""In a run's folder: the records for MLflow, and which MLflow run takes them and how many it has taken."""
MOST_BYTES = 255 - len(".checkpoint")
"""Of a name, as file systems have it; some room is left for names that are made of it."""
FORMS = ("NFC", "NFD")
"""How one text may be written in Unicode: its letters with their accents, or before them; both are one name."""


def new_name(name: str, runs: Path) -> Path:
    """Return the folder of a new run or sweep, whose name may be taken by the time that `make_folder` makes it.

    Raises:
        UserError: if the name is none, or taken.
    """
    if not set(name) - {"."} or Path(name).name != name:
        raise UserError(f"--name: got {shorten(name)}; wanted the name of a folder in {runs}, without any /")
    size = len(os.fsencode(name))
    if not name.isprintable() or size > MOST_BYTES:
        got = f"{size} bytes" if name.isprintable() else shorten(name)
        raise UserError(f"--name: got {got}; wanted at most {MOST_BYTES} bytes of characters that can be printed")
    for form in FORMS:
        if (folder := _inside_runs(runs / unicodedata.normalize(form, name), runs, "--name")).exists():
            raise _taken(folder)
    return runs / unicodedata.normalize("NFC", name)


def make_folder(folder: Path, files: Mapping[str, str] | None = None) -> None:
    """Make the folder of a new run or sweep with its first files, of two at once for one of them only.

    It is there whole or not at all: what is killed meanwhile has not taken the name.

    Raises:
        UserError: if its name is taken.
        DiskFullError: for want of space.
    """
    if folder.exists():
        raise _taken(folder)
    contents = {name: content.encode() for name, content in (files or {}).items()}
    try:
        with room_for(folder, sum(map(len, contents.values()))), making_folder(folder.parent, folder.name) as made:
            for name, content in contents.items():
                create_file(made, name, content)
    except FileExistsError as error:
        raise _taken(folder) from error


def _taken(folder: Path) -> UserError:
    return UserError(f"--name: got {folder}, which is taken; wanted a new name, or --resume {shlex.quote(str(folder))}")


def resume_command(folder: Path, program: str = "meta-train") -> str:
    """Return the line that goes on with a run or sweep, as it can be pasted into a shell."""
    return f"dmil {program} --resume {shlex.quote(str(folder))}"


def find_folder(name: str, runs: Path, mark: str, flag: str = "--resume") -> Path:
    """Return the folder of a run or sweep that was begun, by its path or its name in `runs`.

    Raises:
        UserError: if there is none.
    """
    names = dict.fromkeys((name, *(unicodedata.normalize(form, name) for form in FORMS)))
    for folder in (path for each in names for path in (at_home(each), runs / each)):
        try:
            found = (folder / mark).is_file()
        except (OSError, ValueError):  # a name that no folder can have
            continue
        if found:
            return _inside_runs(folder, runs, flag)
    raise UserError(f"{flag}: got {shorten(name)}; wanted a folder with a {mark} in it, or the name of one in {runs}")


def _inside_runs(folder: Path, runs: Path, flag: str) -> Path:
    """Return a folder; refuse a link that leads out of `runs`, where whatever is written would be written."""
    if folder.parent.absolute() == runs.absolute():
        try:
            inside(runs, folder.name)
        except ForeignFileError as error:
            raise UserError(f"{flag}: got {folder}, a link out of {runs}; wanted a folder in it") from error
    return folder
