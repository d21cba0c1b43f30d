"""Means of every row with their intervals, the paper's figures hollow beside them."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from services.evaluation.comparison import DIGITS, Cell, Comparison
from services.reporting.drawing import Picture, colour_of, drawn, marker_of, panels

APART = 0.17
"""Between two numbers of shots, in rows."""


def means(comparison: Comparison) -> Picture:
    """Draw the means of every row, a panel for each suite and split."""
    metric, digits = comparison.metric.replace("_", " "), DIGITS[comparison.metric]
    by_place: dict[str, list[str]] = defaultdict(list)
    for of in comparison.cells:
        by_place[f"{_where(of)}, {of.shots}-shot"].append(f"{of.row} {of.mean:.{digits}f}")
    told = "; ".join(f"{place}: {', '.join(rows)}" for place, rows in by_place.items())
    hollow = "Hollow marks are the paper's figures. " if any(of.paper for of in comparison.cells) else ""
    with _figure(comparison) as figure:
        return drawn(figure, f"Mean {metric} of each row; bars are 95% intervals", f"{hollow}{told}.")


def draw_means(comparison: Comparison, path: Path, title: str) -> None:
    """Draw the same as a PNG file."""
    with _figure(comparison) as figure:
        figure.suptitle(title, fontsize="medium")
        figure.savefig(path, dpi=110, facecolor="white")


def _where(of: Cell) -> str:
    return f"{of.suite}, {of.split}"


@contextmanager
def _figure(comparison: Comparison) -> Iterator[Figure]:
    titles = list(dict.fromkeys(map(_where, comparison.cells)))
    columns = min(len(titles), 2)
    lines = -(-len(titles) // columns)
    rows = [row for row in comparison.rows if any(of.row == row for of in comparison.cells)]
    height = 1.2 + 0.13 * max(4, len(rows) * (len(comparison.shots) + 1))
    with panels(lines, columns, width=5.3 * columns, height=height * lines) as (figure, axes):
        for axis, title in zip(axes, titles, strict=False):
            _draw(axis, rows, [of for of in comparison.cells if _where(of) == title])
            axis.set(title=title, xlabel=f"mean {comparison.metric.replace('_', ' ')}")
            axis.set_xlim(-0.02, 1.02 if comparison.metric == "success_rate" else None)
        for axis in axes[len(titles) :]:
            axis.remove()
        labelled = {
            label: mark
            for axis in axes[: len(titles)]
            for mark, label in zip(*axis.get_legend_handles_labels(), strict=True)
        }
        figure.legend(labelled.values(), labelled.keys(), loc="outside lower center", ncols=4, fontsize="small")
        yield figure


def _draw(axis: Axes, rows: Sequence[str], cells: Sequence[Cell]) -> None:
    shots = sorted({of.shots for of in cells})
    for index, count in enumerate(shots):
        own = [of for of in cells if of.shots == count]
        look = {"color": colour_of(index), "fmt": marker_of(index), "markersize": 5, "capsize": 3}
        y = [rows.index(of.row) + APART * (index - (len(shots) - 1) / 2) for of in own]
        below = [of.mean - (of.mean if of.low is None else of.low) for of in own]
        above = [(of.mean if of.high is None else of.high) - of.mean for of in own]
        axis.errorbar([of.mean for of in own], y, xerr=[below, above], label=f"{count}-shot", **look)
        papers = [(place + APART / 3, of.paper) for place, of in zip(y, own, strict=True) if of.paper]
        if papers:
            axis.errorbar(
                [paper.value for _, paper in papers], [place for place, _ in papers],
                xerr=[paper.spread or 0.0 for _, paper in papers], mfc="none", elinewidth=0.8,
                label=f"{count}-shot, paper", **look,
            )  # fmt: skip
    axis.set_yticks(range(len(rows)), rows)
    axis.set_ylim(len(rows) - 0.5, -0.5)
