"""How far a run is: a bar on a terminal, plain lines every few seconds elsewhere."""

import sys
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

__all__ = ["Bar", "Clock", "console"]

console = Console(highlight=False, soft_wrap=not sys.stdout.isatty(), width=None if sys.stdout.isatty() else 160)
LINE_SECONDS = 5.0


class Bar:
    """The progress of one phase, to be used in a ``with``."""

    def __init__(self, name: str, total: int, done: int = 0) -> None:
        """Show `done` of `total`."""
        self._name, self._total, self._done = name, total, done
        self._started, self._shown, self._first, self._text = time.monotonic(), 0.0, done, ""
        self._live = None
        if console.is_terminal:
            self._live = Progress(
                TextColumn("[bold]{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
                TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[text]}"), console=console,
            )  # fmt: skip
            self._task = self._live.add_task(name, total=total, completed=done, text="")

    def advance(self, steps: int, text: str = "") -> None:
        """Count `steps` more, and show `text` beside."""
        self._done += steps
        self._text = text
        if self._live is not None:
            self._live.update(self._task, completed=self._done, text=text)
        elif time.monotonic() - self._shown >= LINE_SECONDS or self._done == self._total:
            self._line()

    def _line(self) -> None:
        self._shown = now = time.monotonic()
        spent = now - self._started
        rate = (self._done - self._first) / spent if spent else 0.0
        left = f"{(self._total - self._done) / rate:.0f} s left" if rate else ""
        console.print(f"{self._name} {self._done}/{self._total}, {spent:.0f} s, {left} {self._text}".rstrip(" ,"))

    def __enter__(self) -> "Bar":
        """Begin to show."""
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop showing; what is on the screen stays."""
        if self._live is not None:
            self._live.stop()


class Clock:
    """Seconds that each phase took, and all together."""

    def __init__(self) -> None:
        """Start to count."""
        self.seconds: dict[str, float] = {"total": 0.0}
        self._began = self._last = time.perf_counter()

    def lap(self, phase: str) -> None:
        """Note what has passed since the lap before as `phase`."""
        now = time.perf_counter()
        self.seconds[phase] = round(now - self._last, 1)
        self.seconds["total"] = round(now - self._began, 1)
        self._last = now
