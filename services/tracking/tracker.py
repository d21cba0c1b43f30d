"""MLflow tracking that never stops a run: records go to a file in the run's folder first, a thread delivers them."""

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from dmil_core.configs import ExperimentConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.errors import RunError
from services.cli.composition import flat
from services.storage.provenance import git_commit, library_versions
from services.storage.redaction import error_line, redacted
from services.storage.run_folders import SPOOL
from services.tracking.delivery import Delivery, Identity
from services.tracking.links import run_link, tracking_uri, ui_command
from services.tracking.packing import packed
from services.tracking.spool import Artifact, Ended, Example, Measured, Spool, Trained

logger = logging.getLogger(__name__)

RETRY_SECONDS = 10.0
LINGER_SECONDS = 1.0
"""How long records are gathered before they are sent together."""
SYSTEM = "system/"
"""What MLflow's system metrics begin with."""
DIGITS = 12
"""Of a data set's digest, in a tag."""
EXAMPLE_STEPS = 3
CLOSING_SECONDS = 3.0
"""How long the end of a run waits for an MLflow that has failed or been slow."""


class Tracker:
    """One MLflow run, fed from ``tracking.jsonl`` in the run's folder; in a ``with`` it ends as what goes on inside."""

    def __init__(self, folder: Path, experiment: str, parent: Path | None = None) -> None:
        """Open the MLflow run that belongs to a run's folder, or make one as soon as MLflow answers.

        One warning is logged when MLflow does not take records, one if some are left at the end. `parent` is the folder
        of the sweep that this run is a trial of.

        Raises:
            UserError: if a record of the run so far is damaged, or the file that says which MLflow run it is, is.
            DiskFullError: for want of space.
        """
        uri = tracking_uri()
        self.uri = redacted(uri)
        """Of MLflow, without secrets."""
        self._folder = folder
        Identity.find_or_make(folder, experiment, None if parent is None else Identity.of(parent).tag)
        self._spool = Spool(folder / SPOOL)
        self._delivery = Delivery(folder, uri)
        self._opened = time.monotonic()
        self._closing = threading.Event()
        self._failed = self._complained = False
        self._thread = threading.Thread(target=self._work, name="mlflow", daemon=True)
        self._spool.append("begin", None)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        stopped = kind is not None and issubclass(kind, KeyboardInterrupt)
        self.close("FINISHED" if kind is None else "KILLED" if stopped else "FAILED")

    @property
    def run_id(self) -> str | None:
        """The MLflow run's id, as far as it is known."""
        return self._delivery.identity.run_id

    @property
    def address_lines(self) -> list[str]:
        """Lines that say where the MLflow run is, as far as it is known, and how to look at it."""
        run_id, experiment_id, uri = self.run_id, self._delivery.identity.experiment_id, tracking_uri()
        if run_id is None or not self._delivery.found:
            return [f"MLflow run: {f'{run_id}, which took no records' if run_id else 'none yet'} at {self.uri}"]
        lines = [f"MLflow run: {run_id} at {self.uri}"]
        if (command := ui_command(uri)) is not None:
            lines.append(f"to look at it: {command}")
        if experiment_id is not None:
            lines.append(f"its page: {run_link(uri, experiment_id, run_id)}")
        return lines

    @property
    def waiting(self) -> int:
        """How many records MLflow has not taken yet."""
        return max(0, self._spool.count - self._delivery.identity.delivered)

    def parameters(self, values: Mapping[str, Any]) -> None:
        """Record settings; MLflow keeps the first value of each, a resumed run's other value becomes a tag."""
        self._spool.append("parameters", {name: str(value) for name, value in values.items()})

    def metrics(self, step: int, values: Mapping[str, float], *, anew: bool = False) -> None:
        """Record metrics of one iteration, but none twice: a resumed run does some iterations again.

        If they are measured `anew`, those that came out otherwise are recorded too.
        """
        before = {name: self._spool.measured.get(name, {}).get(step) for name in values}
        new = {
            name: value for name, value in values.items() if before[name] is None or (anew and before[name] != value)
        }
        if new:
            self._spool.append("metrics", Measured(step=step, time=_now(), values=new))

    def tags(self, values: Mapping[str, str]) -> None:
        """Record tags; a later value replaces an earlier one."""
        self._spool.append("tags", dict(values))

    def system(self, values: Mapping[str, float]) -> None:
        """Record the next sample of the machine's load, under the names by which MLflow knows such metrics."""
        named = {f"{SYSTEM}{name}": value for name, value in values.items()}
        step = 1 + max((max(self._spool.measured[name], default=-1) for name in named), default=-1)
        self._spool.append("system", Measured(step=step, time=_now(), values=named))

    def inputs(self, digests: Mapping[str, str]) -> None:
        """Record data sets by name and digest as the run's inputs, and in one tag, by which runs are found."""
        self._spool.append("inputs", dict(digests))
        self.tags({"data": ", ".join(f"{name} {digest[:DIGITS]}" for name, digest in digests.items())})

    def artifact(self, path: Path, folder: str | None = None) -> None:
        """Record a file or folder below the run's folder as an artifact."""
        below = path.absolute().relative_to(self._folder.absolute())
        self._spool.append("artifact", Artifact(path=str(below), folder=folder))

    def model(self, checkpoint: Path, support: Sequence[Demonstration]) -> None:
        """Record a checkpoint below the run's folder as its model, whose example is the first steps of `support`."""
        below = checkpoint.absolute().relative_to(self._folder.absolute())
        parts = [demonstration.window(0, min(EXAMPLE_STEPS, len(demonstration))) for demonstration in support]
        example = Example.model_validate(packed(parts, parts[0].observations[0]))
        self._spool.append("model", Trained(checkpoint=str(below), example=example))

    def wait_for_run_id(self, timeout: float = 60.0) -> str | None:
        """Return the MLflow run's id, or None if it is not known yet.

        It is waited for, up to so many seconds from the tracker's opening, while MLflow neither fails nor is slow.
        """
        while self.run_id is None and not self._troubled() and time.monotonic() < self._opened + timeout:
            time.sleep(0.02)
        return self.run_id

    def close(self, status: str, timeout: float = 60.0) -> bool:
        """End the MLflow run as FINISHED, FAILED or KILLED; return whether all records have been delivered.

        It raises nothing, so as not to hide what ended the run. The delivery is waited for, up to so many seconds,
        while MLflow neither fails nor is slow.
        """
        try:
            self._spool.append("end", Ended.model_validate({"status": status, "time": _now()}))
        except (OSError, RunError) as error:
            logger.warning(f"the end of the run is not recorded: {error}")
        self._closing.set()
        started = time.monotonic()
        while self._thread.is_alive() and time.monotonic() < started + timeout:
            self._thread.join(0.05)
            if self._troubled():
                timeout = min(timeout, CLOSING_SECONDS)
        self._spool.close()
        left = self.waiting
        if left and self._spool.path.exists():  # they may have gone with the run's folder
            logger.warning(
                f"{left} of {self._spool.count} MLflow records wait in {self._spool.path}; when MLflow answers again: "
                f"dmil tracking flush {self._folder}"
            )
        return not left

    def _troubled(self) -> bool:
        return self._failed or self._delivery.slow

    def _work(self) -> None:
        closing = False
        try:
            while not closing:
                closing = self._closing.wait(LINGER_SECONDS)
                self._deliver()
                if self._failed and not closing:
                    self._closing.wait(RETRY_SECONDS)
        finally:
            self._delivery.close()

    def _deliver(self) -> None:
        try:
            self._delivery.deliver()
        except Exception as error:  # noqa: BLE001  whatever MLflow raises, training goes on
            if not self._complained and self._spool.path.exists():
                logger.warning(
                    f"MLflow at {self.uri} does not take records ({error_line(error)}); training goes on, "
                    f"records wait in {self._spool.path}"
                )
            self._failed = self._complained = True
        else:
            self._failed = False


def record_settings(tracker: Tracker, config: ExperimentConfig) -> None:
    """Record what a run is: every setting, the commit of the code and the versions of the libraries."""
    tracker.parameters(flat(config.model_dump(mode="json")))
    tracker.tags({"suite": config.suite.name, "method": config.method.name, "seed": str(config.seed)})
    tracker.tags({"shots": " ".join(map(str, config.evaluation.shots))})
    tracker.tags({"git_commit": git_commit(), **{f"version.{name}": v for name, v in library_versions().items()}})


def _now() -> int:
    return int(time.time() * 1000)
