"""How far a run is: one calm screen on a terminal, plain lines every few seconds elsewhere."""

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.progress import Progress
from rich.text import Text

from services.cli.escapes import for_terminal
from services.cli.live_view import Pace, Screen, Status
from services.storage.redaction import error_line

logger = logging.getLogger(__name__)

LINE_SECONDS = 5.0
REFRESHES = 2
"""Of the screen in a second."""
LATELY_SECONDS = 30.0
"""The time that the speed is the mean of."""


class Output(Console):
    """The terminal, or whatever the programs' output goes to."""

    plain = False
    """Whether plain lines are wanted in place of the screen."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text without what would steer the terminal: it may hold a name that somebody else chose."""
        return super().render_str(for_terminal(text), **options)

    @property
    def live(self) -> bool:
        """Whether there is a screen that can be drawn over."""
        return self.is_interactive and self.file.isatty() and not self.plain


_ON_TERMINAL = sys.stdout is not None and sys.stdout.isatty()  # None where it was closed before the start
console = Output(
    markup=False, emoji=False, highlight=False, soft_wrap=not _ON_TERMINAL, width=None if _ON_TERMINAL else 160
)


class _ConsoleHandler(logging.Handler):
    """Prints warnings and errors behind their level, and all other records as they are."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record."""
        level = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        console.print(f"{level}{record.getMessage()}")


@contextmanager
def console_logging(*, quiet: bool) -> Iterator[None]:
    """Print what the modules of ``services`` log to the console, for as long as a program runs.

    Where it is quiet, that is warnings only, and plain lines in place of the live screen.
    """
    logger = logging.getLogger("services")
    handlers, level, plain = logger.handlers, logger.level, console.plain
    logger.handlers = [_ConsoleHandler()]  # in place of those there are: each record is printed once
    console.plain = quiet
    logger.setLevel(logging.WARNING if quiet else logging.INFO)
    try:
        yield
    finally:
        logger.handlers, console.plain = handlers, plain
        logger.setLevel(level)


@contextmanager
def aside(what: str) -> Iterator[None]:
    """Log an error inside, and go on: the work does not end because of what only shows it."""
    try:
        yield
    except Exception as error:  # noqa: BLE001  whatever it is
        logger.warning(f"{what} failed ({error_line(error)}); going on without it")


class Bar:
    """The progress of one phase, to be used in a ``with``."""

    def __init__(
        self, name: str, total: int, done: int = 0, unit: str = "", status: Callable[[], Status] | None = None
    ) -> None:
        """Show `done` of `total`, and its rate if the `unit` is of interest.

        `status` returns what else to show; it is called from another thread.
        """
        self._name, self._unit, self._text = name, unit, ""
        self._status = status or (lambda: Status(at=self._text))
        self._line_at, self._line_done = 0.0, -1
        self._progress = Progress(console=console, speed_estimate_period=LATELY_SECONDS)  # never started: it counts
        self._progress.add_task(name, total=total, completed=done)
        (self._task,) = self._progress.tasks
        self._live: Live | None = None

    def advance(self, steps: int, text: str = "") -> None:
        """Count `steps` more, and show `text` beside if there is no status."""
        self._progress.advance(self._task.id, steps)
        self._text = text
        if self._live is None and (time.monotonic() - self._line_at >= LINE_SECONDS or self._task.finished):
            self._line()

    def _pace(self) -> Pace:
        task = self._task
        return Pace(int(task.completed), int(task.total or 0), task.elapsed or 0.0, task.speed or 0.0, self._unit)

    def _screen(self) -> Screen:
        return Screen(self._name, self._pace(), self._status())

    def _line(self) -> None:
        pace = self._pace()
        self._line_at, self._line_done = time.monotonic(), pace.done
        parts = [f"{self._name} {pace.done}/{pace.total}, {pace.line}", self._status().line]
        console.print("; ".join(filter(None, parts)))

    def __enter__(self) -> "Bar":
        if console.live:
            self._live = Live(
                get_renderable=self._screen, console=console, refresh_per_second=REFRESHES, transient=True
            )
            self._live.start(refresh=True)
        return self

    def __exit__(self, *error: object) -> None:
        """Stop showing; a line says how far it came."""
        if self._live is not None:
            self._live.stop()
            self._live = None
        if self._line_done != self._task.completed:
            self._line()


class Clock:
    """Seconds that each phase took, and all together."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {"total": 0.0}
        self._began = self._last = time.perf_counter()

    def lap(self, phase: str) -> None:
        """Note what has passed since the lap before as `phase`."""
        now = time.perf_counter()
        self.seconds[phase] = round(now - self._last, 1)
        self.seconds["total"] = round(now - self._began, 1)
        self._last = now
