"""What a program shows of the phase that it is in: as rows of a small screen, or in one line of words."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import timedelta
from itertools import pairwise
from typing import NamedTuple

from rich.console import Console, ConsoleOptions, RenderResult
from rich.progress_bar import ProgressBar
from rich.segment import Segment
from rich.style import Style
from rich.table import Table
from rich.text import Text

from services.cli.colours import colour_of
from services.cli.escapes import for_terminal

LABEL, WIDEST = 14, 80
"""Columns of the labels, and of the whole: a wider screen would leave parts behind when its terminal gets narrower."""
NEAR = 0.01
"""A sub-skill with a smaller share of the states is hardly in use."""


class Workers(NamedTuple):
    """The workers of one kind."""

    kind: str
    alive: int
    restarted: int


class Tally(NamedTuple):
    """The successes of an evaluation so far, for one split and size of support set."""

    split: str
    shots: int
    successes: int
    episodes: int

    @property
    def line(self) -> str:
        """Its rate, with the counts behind it."""
        return f"{self.shots}-shot {self.successes / self.episodes:.3f} ({self.successes}/{self.episodes})"


class Pace(NamedTuple):
    """How far a phase is."""

    done: int
    total: int
    seconds: float
    """Since it began."""
    rate: float
    """A second, of late; 0 where nothing is known."""
    unit: str

    @property
    def left(self) -> str:
        """What it will still take."""
        return f"{_clock((self.total - self.done) / self.rate)} left" if self.rate and self.done < self.total else ""

    @property
    def line(self) -> str:
        """How fast it goes, what it took, and what it will still take."""
        return ", ".join(filter(None, [self.speed, f"{_clock(self.seconds)} so far", self.left]))

    @property
    def speed(self) -> str:
        """How fast it goes."""
        return f"{self.rate:.3g} {self.unit}/s" if self.rate and self.unit else ""


class Status(NamedTuple):
    """What is shown of a phase besides its pace; fields without a value are left out."""

    losses: Mapping[str, float] = {}
    """By their names among the metrics."""
    shares: Sequence[float] = ()
    """Of the states, the part that each sub-skill takes."""
    success: Sequence[Tally] = ()
    after: int | None = None
    """The iterations after which that was measured."""
    workers: Sequence[Workers] = ()
    at: str = ""
    """What is at work."""

    def rows(self, width: int) -> Iterator[tuple[str, "Text | Strip"]]:
        """Yield label and content of each row, for contents of so many columns."""
        if self.losses:
            yield "losses", _packed(_describe_losses(self.losses), width)
        if len(self.shares) > 1:
            yield "sub-skills", Strip(self.shares)
            yield "", _packed((f"{index} {share:.0%}" for index, share in enumerate(self.shares)), width)
        if self.success:
            when = "" if self.after is None else f"after {self.after}"
            for split in dict.fromkeys(tally.split for tally in self.success):
                tallies = [tally.line for tally in self.success if tally.split == split]
                yield "success", _packed([f"{split} {tallies[0]}", *tallies[1:], when], width)
                when = ""
        if self.workers:
            yield "workers", _packed(map(_describe_workers, self.workers), width)
        if self.at:
            yield "at", _packed(self.at.split("; "), width)

    @property
    def line(self) -> str:
        """The same in a line."""
        used = sum(share > NEAR for share in self.shares)
        restarted = sum(workers.restarted for workers in self.workers)
        return "; ".join(
            [
                *([f"loss {_short(self.losses['loss'])}"] if "loss" in self.losses else []),
                *([f"sub-skills in use {used}/{len(self.shares)}"] if len(self.shares) > 1 else []),
                *([f"after {self.after}"] if self.success and self.after is not None else []),
                *(f"{tally.split} {tally.line}" for tally in self.success),
                *([f"workers restarted {restarted}"] if restarted else []),
                *([self.at] if self.at else []),
            ]
        )


class Screen(NamedTuple):
    """A phase as a few rows, which keep their places."""

    name: str
    pace: Pace
    status: Status

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Lay it out for the terminal's width."""
        width = min(options.max_width, WIDEST)
        grid = Table.grid(padding=(0, 1, 0, 0), pad_edge=False)
        grid.width = width
        grid.add_column(width=LABEL, style="bold", no_wrap=True)
        grid.add_column(ratio=1)
        count = f"{self.pace.done}/{self.pace.total}"
        bar = Table.grid(padding=(0, 1, 0, 0), expand=True)
        bar.add_column(ratio=1)
        bar.add_column(no_wrap=True)
        bar.add_row(ProgressBar(total=max(self.pace.total, 1), completed=self.pace.done), count)
        grid.add_row(self.name, bar)
        grid.add_row("", self.pace.line)
        before = None
        for label, content in self.status.rows(width - LABEL - 1):
            grid.add_row("" if label == before else label, content)
            before = label
        yield grid


class Strip:
    """The shares of sub-skills as parts of a strip, each in its colour and with its number."""

    def __init__(self, shares: Sequence[float]) -> None:
        """Take shares that need not add up to one."""
        self._shares = shares

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for index, columns in enumerate(_parts(self._shares, options.max_width)):
            colour = colour_of(index)
            # The number again and again, unseen on its own colour: where there are no colours, it tells the parts.
            label = str(index) if len(str(index)) <= columns else ""
            yield Segment(label, Style(color="white" if _is_dark(colour) else "black", bgcolor=colour, bold=True))
            yield Segment(str(index)[-1] * (columns - len(label)), Style(color=colour, bgcolor=colour))
        yield Segment.line()


def _parts(shares: Sequence[float], width: int) -> list[int]:
    """Return how many of `width` columns each share gets, all together no more and no less."""
    known = [max(share, 0.0) if share == share else 0.0 for share in shares]
    total, ends, passed = sum(known), [0], 0.0
    for share in known:
        passed += share
        ends.append(round(width * passed / total) if total else 0)
    return [end - begin for begin, end in pairwise(ends)]


def _is_dark(colour: str) -> bool:
    red, green, blue = (int(colour[at : at + 2], 16) for at in (1, 3, 5))
    return 0.299 * red + 0.587 * green + 0.114 * blue < 128


def _describe_losses(losses: Mapping[str, float]) -> Iterator[str]:
    """Yield each loss, and one that is known before and after adaptation as a pair."""
    for name, value in losses.items():
        stem, _, when = name.rpartition("_")
        if when == "before" and f"{stem}_after" in losses:
            yield f"{_plain(stem)} {_short(value)} to {_short(losses[f'{stem}_after'])}"
        elif not (when == "after" and f"{stem}_before" in losses):
            yield f"{_plain(name)} {_short(value)}"


def _plain(name: str) -> str:
    return name.removesuffix("_loss").replace("_", " ")


def _describe_workers(workers: Workers) -> str:
    return f"{workers.kind} {workers.alive} alive, {workers.restarted} restarted"


def _packed(phrases: Iterable[str], width: int) -> Text:
    """Put phrases into lines of at most `width` columns, none broken unless it is longer by itself."""
    lines = [""]
    for phrase in map(for_terminal, filter(None, phrases)):
        longer = f"{lines[-1]}   {phrase}" if lines[-1] else phrase
        if len(longer) <= width or not lines[-1]:
            lines[-1] = longer
        else:
            lines.append(phrase)
    return Text("\n".join(line[:width] for line in lines), no_wrap=True, overflow="ellipsis")


def _short(value: float) -> str:
    return f"{value:.3f}" if 0.001 <= abs(value) < 100 or not value else f"{value:.3g}"


def _clock(seconds: float) -> timedelta:
    return timedelta(seconds=round(seconds))
