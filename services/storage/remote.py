"""A place that all machines reach, named by a URL of fsspec, as ``s3://bucket/folder``.

There a folder is whole or not at all, without a rename: its commit marker, a file that vouches for the others, is
written last and removed first. So a writer that is killed between two files leaves nothing that anybody reads.
"""

import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import fsspec

from dmil_core.errors import RunError, UserError
from dmil_core.files import create_file, making_folder
from services.storage.redaction import redacted

STORAGE = "DMIL_STORAGE"
PACKAGES = {"s3": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "az": "adlfs", "abfs": "adlfs"}
KINDS = "file:///folder, s3://bucket/folder, gs://bucket/folder"


class Storage:
    """Folders and files under one URL, by names with slashes."""

    def __init__(self, url: str) -> None:
        """Name a storage; nothing is asked of it yet.

        Raises:
            UserError: if the URL names none.
        """
        self.url = redacted(url)
        """Where it is, without secrets."""
        try:
            self._files, root = fsspec.core.url_to_fs(url, use_listings_cache=False)
        except ImportError as error:
            package = PACKAGES.get(url.partition(":")[0], "the package that it names")
            raise UserError(f"{STORAGE}: got {self.url}, which needs {package}: pip install {package}") from error
        except (ValueError, OSError) as error:  # OSError: a kind that connects at once
            raise UserError(f"{STORAGE}: got {self.url} ({redacted(str(error))}); wanted a URL as {KINDS}") from error
        self._root = root.rstrip("/")
        if "://" not in url or not self._root:
            raise UserError(f"{STORAGE}: got {self.url}, which names no folder and no bucket; wanted a URL as {KINDS}")

    def put(self, name: str, content: bytes) -> None:
        """Write a file whole."""
        path = self._path(name)
        self._files.makedirs(path.rpartition("/")[0], exist_ok=True)
        self._files.pipe_file(path, content)

    def get(self, name: str, most: int) -> bytes | None:
        """Return a file's content, or None if it is not there.

        Raises:
            RunError: for one of over `most` bytes.
        """
        try:
            size = self._files.size(self._path(name))
            if size > most:
                raise RunError(f"{self.url}/{name}: got {size} bytes; wanted at most {most}; remove it")
            return self._files.cat_file(self._path(name))
        except FileNotFoundError:
            return None

    def create(self, name: str, content: bytes, most: int) -> bytes:
        """Write a file unless there is one of its name, and return what is there then: this content, or another's.

        A folder and S3 write it in one step, so that of several writers one finds its own there. Other kinds do so as
        far as their library opens files with the mode ``xb``; else, of writers in the same moment, the last may win
        over one that has found its own already.
        """
        path = self._path(name)
        if self.get(name, most) is None:
            self._files.makedirs(path.rpartition("/")[0], exist_ok=True)
            try:
                with self._files.open(path, "xb") as file:
                    file.write(content)
            except FileExistsError:
                pass
            except (NotImplementedError, ValueError):  # how libraries of fsspec say that they have no mode xb
                self.put(name, content)
        return self.get(name, most) or b""

    def put_folder(self, name: str, contents: Mapping[str, bytes], marker: str) -> None:
        """Write a folder's files, the marker last; a folder of that name which is there is none until then."""
        self.remove(name, marker)
        for file in sorted(contents, key=lambda file: file == marker):
            self.put(f"{name}/{file}", contents[file])

    def get_folder(
        self,
        name: str,
        root: Path,
        target: str,
        files: Mapping[str, int],
        marker: str,
        check: Callable[[Path], object] = lambda made: None,
        *,
        instead: bool = False,
    ) -> bool:
        """Fetch a folder whose marker is there, and return whether it was.

        Args:
            name: of the folder here.
            root: the folder below which it goes.
            target: its name there; it is made by a rename, unless it is there by then.
            files: what is in it besides the marker, and how many bytes each may have at most.
            marker: the name of the file that vouches for them.
            check: looks at what was fetched before it has its name; what it raises passes through, and nothing is kept.
            instead: put it in the place of what has the name.

        Raises:
            RunError: for a file that is too large, or missing although the marker is there.
        """
        content = self.get(f"{name}/{marker}", 2**20)
        if content is None:
            return False
        with suppress(FileExistsError), making_folder(root, target, instead=instead) as made:
            for file, most in files.items():
                part = self.get(f"{name}/{file}", most)
                if part is None:
                    raise RunError(f"{self.url}/{name}/{file}: got nothing; wanted what its {marker} vouches for")
                create_file(made, file, part)
            create_file(made, marker, content)
            check(made)
        return True

    def committed(self, name: str, marker: str, pattern: str) -> dict[str, bytes]:
        """Return the markers of the folders in a folder whose names match a pattern, by name, in order."""
        markers = {own: self.get(f"{name}/{own}/{marker}", 2**20) for own in self.names(name, pattern)}
        return {own: content for own, content in markers.items() if content is not None}

    def names(self, name: str, pattern: str) -> list[str]:
        """Return the names in a folder that match a pattern, in order."""
        try:
            listed = self._files.ls(self._path(name), detail=False)
        except FileNotFoundError:
            return []
        names = (path.rstrip("/").rpartition("/")[2] for path in listed)
        return sorted(own for own in names if re.fullmatch(pattern, own))

    def remove(self, name: str, marker: str) -> None:
        """Remove a folder, its marker first."""
        for path in (f"{name}/{marker}", name):
            if self._files.exists(self._path(path)):
                self._files.rm(self._path(path), recursive=True)

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}"


def given_storage() -> Storage | None:
    """Return the storage that ``DMIL_STORAGE`` names, if it does.

    Raises:
        UserError: if it names none.
    """
    url = os.environ.get(STORAGE)
    return Storage(url) if url else None
