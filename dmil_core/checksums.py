"""SHA-256 digests beside the files they are of, in the form that ``sha256sum --check`` reads too."""

import errno
import hashlib
from collections.abc import Sequence
from pathlib import Path

from dmil_core.files import open_file, read_file, write_file

MOST_LISTED = 2**16
"""Bytes of a listing."""


def sha256(content: bytes) -> str:
    """Return the SHA-256 of `content`, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def listing(digests: dict[str, str]) -> str:
    """Return digests by file name as ``sha256sum`` lays them out."""
    return "".join(f"{digest}  {name}\n" for name, digest in digests.items())


def checked_file(folder: Path, name: str, digest: str | None, most: int) -> bytes:
    """Return the content of a file in `folder` whose digest is `digest`.

    Raises:
        OSError: if it is missing, a link, of more than `most` bytes, or has another digest.
    """
    content = read_file(folder, name, most)
    _compare(sha256(content), digest, folder / name)
    return content


def write_listing(folder: Path, name: str, files: Sequence[str]) -> None:
    """Write the digests of `files`, paths inside `folder`, to the file `name` in it."""
    write_file(folder, name, listing({file: _digest(folder, file) for file in files}))


def check_listing(folder: Path, name: str, most: dict[str, int]) -> None:
    """Check the files in `folder` whose digests the file `name` in it lists.

    It must list the files of `most`, each of at most so many bytes.

    Raises:
        OSError: names the file that is missing, too large, a link or not as its digest says.
    """
    lines = read_file(folder, name, MOST_LISTED).decode("utf-8", "replace").splitlines()
    listed = {file: digest for digest, _, file in (line.partition("  ") for line in lines)}
    if len(lines) != len(listed) or listed.keys() != most.keys():
        raise OSError(errno.EBADMSG, f"does not list {', '.join(most)}, each once", str(folder / name))
    for file, bound in most.items():
        _compare(_digest(folder, file, bound), listed[file], folder / file)


def _digest(folder: Path, name: str, most: int | None = None) -> str:
    with open_file(folder, name, most) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _compare(digest: str, wanted: str | None, path: Path) -> None:
    if digest != wanted:
        listed = f"not {wanted[:12]} as listed" if wanted else "none is listed"
        raise OSError(errno.EBADMSG, f"damaged: its SHA-256 is {digest[:12]}, {listed}", str(path))
