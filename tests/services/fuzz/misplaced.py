"""Files put back as they were, or in whose place there is something that is no file of their folder."""

import os
import shutil
from pathlib import Path
from random import Random


def restore(folder: Path, files: dict[str, bytes]) -> None:
    shutil.rmtree(folder)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def misplace(path: Path, outside: Path, draw: Random) -> None:
    """Put something in a file's place that is no file of its folder, or far too large."""
    content = path.read_bytes()
    path.unlink()
    match draw.randrange(7):
        case 1:
            path.symlink_to(outside)
        case 2:
            path.symlink_to("/dev/zero")
        case 3:
            os.mkfifo(path)
        case 4:
            path.mkdir()
        case 5:
            path.write_bytes(content)
            os.truncate(path, 10**13)
        case 6:
            path.symlink_to(path.name)
