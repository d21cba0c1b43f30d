"""From a run's folder to MLflow: every record in its order, noted as delivered once MLflow has taken it."""

import json
import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dmil_core.errors import RunError, UserError, describe_errors
from dmil_core.files import append_to, check_folder, read_file, room_for, sync, write_file
from services.storage.folder_lock import FolderHeldError, held
from services.storage.redaction import error_line
from services.storage.run_folders import IDENTITY, SPOOL
from services.tracking.client import connect, set_mlflow_defaults
from services.tracking.links import artifacts_beside
from services.tracking.ownership import (
    FOLDER_TAG,
    IDENTITY_BYTES,
    RUN_TAG,
    check_active,
    check_place,
    check_run,
    check_there,
)
from services.tracking.sending import next_batch, send
from services.tracking.spool import Line, read_spool

if TYPE_CHECKING:
    from mlflow import MlflowClient

logger = logging.getLogger(__name__)

PARENT_TAG = "mlflow.parentRunId"
"""MLflow's own, by which its pages nest runs."""
KIND = {"mlflow.experimentKind": "custom_model_development"}
"""So MLflow shows the pages for training, not those for applications of language models."""
SLOW_SECONDS = 5.0
"""A server that takes longer for a call is not waited for."""
OPENING_SECONDS = 60.0
"""A database has longer: on its first use MLflow makes its tables, on a busy machine for half a minute."""
SENDING_SECONDS = 60.0
"""So have files."""
ID = "^[0-9a-f]{32}$"
"""Of runs, MLflow's and our own alike: they stand in questions to MLflow."""
REFUSED = "tracking.refused.jsonl"
"""In a run's folder: the records that MLflow will never take, each behind its number and the reason."""
AGAIN = {401, 408, 409, 429}
"""HTTP's refusals of a client that may be taken back."""
LOCK = "tracking.lock"
"""Is held by the one that delivers: the run itself, or a flush."""


class Identity(BaseModel):
    """Which MLflow run a folder belongs to and how far delivery got, ``mlflow_run.json``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    tag: str = Field(pattern=ID)
    """Our own id of the run, known before MLflow is asked for its."""
    experiment: str
    name: str
    began: int
    """In milliseconds since 1970."""
    parent: str | None = Field(default=None, pattern=ID)
    """The tag of the run that this one is a trial of; it goes to the same MLflow experiment."""
    run_id: str | None = Field(default=None, pattern=ID)
    experiment_id: str | None = Field(default=None, pattern="^[0-9]{1,32}$")
    """Noted with the run's, but not in files of older versions."""
    delivered: int = 0
    """How many records MLflow has taken."""

    @staticmethod
    def of(folder: Path) -> "Identity":
        """Read the identity of a run.

        Raises:
            UserError: if there is none, or it is damaged.
        """
        path = folder / IDENTITY
        try:
            return Identity.model_validate_json(read_file(folder, IDENTITY, IDENTITY_BYTES))
        except (OSError, ValidationError) as error:
            got = error.strerror if isinstance(error, OSError) else describe_errors(error, "no object", "; ")
            raise UserError(
                f"{path}: got {got}; wanted what a tracked run writes there: the id of its MLflow run; put it back, or "
                "delete it, and the next --resume gives the run's records to a new MLflow run"
            ) from error

    @staticmethod
    def find_or_make(folder: Path, experiment: str, parent: str | None = None) -> "Identity":
        """Read the identity of a run, or give it one, as a trial of the run with the tag `parent`.

        Raises:
            UserError: if it is damaged.
        """
        if not (folder / IDENTITY).exists():
            made = Identity(
                tag=uuid4().hex, experiment=experiment, name=folder.name, began=int(time.time() * 1000), parent=parent
            )
            write_file(folder, IDENTITY, made.model_dump_json())
        return Identity.of(folder)


class Delivery:
    """Delivers the records of one run; of all processes, one at a time."""

    def __init__(self, folder: Path, uri: str) -> None:
        """Prepare the delivery; nothing is asked of MLflow, which is at `uri`, yet.

        Raises:
            UserError: if the identity is missing or damaged, or a record is.
        """
        set_mlflow_defaults()
        self._folder, self._uri = folder, uri
        self._holding = ExitStack()
        self._is_ours = False
        self._client: MlflowClient | None = None
        self._usual = self._limit = SLOW_SECONDS if uri.startswith("http") else OPENING_SECONDS
        self._asked: float | None = None
        self._was_slow = False
        self.identity = Identity.of(folder)
        """Which MLflow run it is, and how many records that has taken, as far as is known."""
        self.found = False
        """Whether MLflow was seen to have the run, and it is ours."""
        self._offset = self._delivered_bytes()

    @property
    def slow(self) -> bool:
        """Whether MLflow let us wait long for its last answer, or lets us wait now."""
        asked = self._asked
        return self._was_slow or (asked is not None and time.monotonic() - asked > self._limit)

    def waiting(self) -> list[Line]:
        """Return the records that MLflow has not taken yet.

        Raises:
            UserError: if one is damaged.
        """
        return list(read_spool(self._folder / SPOOL, line=self.identity.delivered, offset=self._offset))

    def busy(self) -> bool:
        """Tell whether another process is at it."""
        try:
            with held(self._folder, LOCK):
                return False
        except FolderHeldError:
            return True

    def deliver(self) -> None:
        """Send every record that waits, and after each batch note how far delivery got.

        A batch that MLflow took before a crash kept us from noting it is sent again, which changes nothing there:
        MLflow keeps one of equal metrics, parameters, tags and inputs. A record that it refuses for good is put aside
        with the reason, see `REFUSED`, and those behind it are delivered.

        Raises:
            UserError: if another process is at it, or a record is damaged.
            RunError: if the folder is gone.
            MlflowException: or whatever else MLflow and what is below it raise, if it does not take a record.
        """
        check_folder(self._folder, SPOOL)
        self.take_over()
        waiting = self.waiting()
        if not waiting:
            return
        client, run_id = self._open()
        while waiting:
            batch = self._send(client, run_id, next_batch(waiting))
            waiting = waiting[len(batch) :]
            # Records must not be noted as delivered that a power failure would take back.
            sync(self._folder / SPOOL)
            self._offset = batch[-1].end
            self._note(delivered=batch[-1].number)

    def _send(self, client: "MlflowClient", run_id: str, batch: Sequence[Line]) -> Sequence[Line]:
        """Send records that go into one call, fewer if one of them is refused, and return those that are done with."""
        try:
            with self._asking(SENDING_SECONDS if batch[0].kind in {"artifact", "model"} else None):
                send(client, run_id, self._folder, batch)
        except Exception as error:
            if not _is_for_good(error):
                raise
            with self._asking():
                check_there(client, run_id)
            if len(batch) > 1:
                return self._send(client, run_id, batch[: len(batch) // 2])
            self._put_aside(batch[0], error)
        return batch

    def _put_aside(self, line: Line, error: Exception) -> None:
        value = line.value.model_dump() if isinstance(line.value, BaseModel) else line.value
        text = json.dumps([line.number, error_line(error), line.kind, value]).encode() + b"\n"
        with room_for(self._folder / REFUSED, len(text)), append_to(self._folder, REFUSED) as file:
            file.write(text)
        logger.warning(
            f"MLflow refuses record {line.number}, {line.kind}, for good ({error_line(error)}); it is kept in "
            f"{self._folder / REFUSED}, and the others are delivered"
        )

    def close(self) -> None:
        """Let others deliver."""
        self._holding.close()
        self._is_ours = False

    def take_over(self) -> None:
        """Be the one that delivers, from where the last one left off."""
        if self._is_ours:
            return
        self._holding.enter_context(held(self._folder, LOCK))
        self._is_ours = True
        self.identity = Identity.of(self._folder)
        self._offset = self._delivered_bytes()

    def _delivered_bytes(self) -> int:
        path, count = self._folder / SPOOL, self.identity.delivered
        ends = [line.end for line in islice(read_spool(path), count)]
        if len(ends) < count:
            raise UserError(
                f"{self._folder / IDENTITY}: got {count} records delivered; wanted at most the {len(ends)} of "
                f"{path}: restore the two together"
            )
        return ends[-1] if ends else 0

    def _open(self) -> "tuple[MlflowClient, str]":
        if self._client is None:
            with self._asking():
                self._client = connect(self._uri)
        run_id, experiment_id = self.identity.run_id, self.identity.experiment_id
        if run_id is None:
            experiment_id = self._experiment_in(self._client)
            run_id = self._run_in(self._client, experiment_id)
        if not self.found:
            with self._asking():
                check_run(self._client, self._uri, self._folder, run_id, self.identity.tag)
            self.found = True
        if self.identity.run_id is None:
            self._note(run_id=run_id, experiment_id=experiment_id)
        return self._client, run_id

    def _experiment_in(self, client: "MlflowClient") -> str:
        """Return the id of our experiment, which is made if it is not there."""
        name = self.identity.experiment
        with self._asking():
            found = client.get_experiment_by_name(name)
            if found:
                check_active(found)
                check_place(client, self._uri, found)
                return found.experiment_id
        beside = artifacts_beside(self._uri)
        with self._asking():
            return client.create_experiment(name, artifact_location=beside and beside.as_uri(), tags=KIND)

    def _run_in(self, client: "MlflowClient", experiment_id: str) -> str:
        """Return the id of our run: of one that was made before its id could be noted, or of a new one."""
        identity = self.identity
        if (found := self._tagged(client, experiment_id, identity.tag)) is not None:
            return found
        tags = {RUN_TAG: identity.tag, FOLDER_TAG: str(self._folder.resolve())}
        if identity.parent is not None:
            parent = self._tagged(client, experiment_id, identity.parent)
            if parent is None:
                raise RunError(
                    f"{self._folder}: MLflow has not the run yet that this one is a trial of; flush that one first"
                )
            tags[PARENT_TAG] = parent
        with self._asking():
            return client.create_run(experiment_id, identity.began, tags=tags, run_name=identity.name).info.run_id

    def _tagged(self, client: "MlflowClient", experiment_id: str, tag: str) -> str | None:
        """Return the id of the run that has our own id `tag`."""
        with self._asking():
            found = client.search_runs([experiment_id], f"tags.`{RUN_TAG}` = '{tag}'", order_by=["created ASC"])
        return found[0].info.run_id if found else None

    @contextmanager
    def _asking(self, limit: float | None = None) -> Iterator[None]:
        """Take the time of a call, so that others can see how long it is out, and whether that is longer than usual."""
        self._limit = limit or self._usual
        self._asked = asked = time.monotonic()
        try:
            yield
        finally:
            self._was_slow = time.monotonic() - asked > self._limit
            self._asked = None

    def _note(self, **changed: Any) -> None:
        try:
            self.identity = Identity.model_validate(self.identity.model_dump() | changed)
        except ValidationError as error:
            raise RunError(
                f"MLflow answered with no id of its own: {describe_errors(error, 'no object', '; ')}"
            ) from error
        write_file(self._folder, IDENTITY, self.identity.model_dump_json())


def _is_for_good(error: Exception) -> bool:
    """Tell whether MLflow would refuse a record again however often it is sent."""
    from mlflow.exceptions import MlflowException

    if not isinstance(error, MlflowException):
        return False
    status = error.get_http_status_code()
    return 400 <= status < 500 and status not in AGAIN
