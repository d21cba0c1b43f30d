"""The folders of runs and sweeps: made under a name, and found by it or by their path."""

from pathlib import Path

from dmil_core.errors import UserError, shorten
from services.storage.files import inside


def new_folder(name: str, runs: Path, mark: str) -> Path:
    """Return the folder of a new run or sweep; it is not made yet.

    `mark` is the file by which the folder of one that was begun is known.

    Raises:
        UserError: if the name is none, or taken.
    """
    if name in (".", "..") or Path(name).name != name:
        raise UserError(f"--name: got {shorten(name)}; wanted the name of a folder in {runs}, without any /")
    folder = _inside_runs(runs / name, runs, "--name")
    if (folder / mark).exists():
        raise UserError(f"--name: got {folder}, which is taken; wanted a new name, or --resume {folder}")
    return folder


def find_folder(name: str, runs: Path, mark: str, flag: str = "--resume") -> Path:
    """Return the folder of a run or sweep that was begun, by its path or its name in `runs`.

    Raises:
        UserError: if there is none.
    """
    for folder in (Path(name), runs / name):
        if (folder / mark).is_file():
            return _inside_runs(folder, runs, flag)
    raise UserError(f"{flag}: got {shorten(name)}; wanted a folder with a {mark} in it, or the name of one in {runs}")


def _inside_runs(folder: Path, runs: Path, flag: str) -> Path:
    """Return a folder, unless it seems to lie in `runs` and is a link that leads elsewhere.

    Raises:
        UserError: then, because whatever is written would be written there.
    """
    if folder.parent.absolute() == runs.absolute():
        try:
            inside(runs, folder.name)
        except OSError as error:
            raise UserError(f"{flag}: got {folder}, a link out of {runs}; wanted a folder in it") from error
    return folder
