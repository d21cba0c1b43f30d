"""The folders of runs and sweeps: made under a name, and found by it or by their path."""

from pathlib import Path

from dmil_core.errors import UserError, shorten
from dmil_core.files import ForeignFileError, inside


def new_name(name: str, runs: Path) -> Path:
    """Return the folder of a new run or sweep, whose name may be taken by the time that `make_folder` makes it.

    Raises:
        UserError: if the name is none, or taken.
    """
    if name in (".", "..") or Path(name).name != name:
        raise UserError(f"--name: got {shorten(name)}; wanted the name of a folder in {runs}, without any /")
    folder = _inside_runs(runs / name, runs, "--name")
    if folder.exists():
        raise _taken(folder)
    return folder


def make_folder(folder: Path) -> None:
    """Make the folder of a new run or sweep, of two at once for one of them only.

    Raises:
        UserError: if its name is taken.
    """
    try:
        folder.mkdir(parents=True)
    except FileExistsError as error:
        raise _taken(folder) from error


def _taken(folder: Path) -> UserError:
    return UserError(f"--name: got {folder}, which is taken; wanted a new name, or --resume {folder}")


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
        except ForeignFileError as error:
            raise UserError(f"{flag}: got {folder}, a link out of {runs}; wanted a folder in it") from error
    return folder
