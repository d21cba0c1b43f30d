"""Pictures of rows side by side: means with intervals, heat maps of tasks, and performance profiles."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dmil_core.files import write_file
from dmil_core.seeding import named_rng
from dmil_core.statistics import interquartile_mean, performance_profile, profile_band
from services.evaluation.comparison import DIGITS, Cell, Comparison
from services.reporting.drawing import DASHES, Picture, colour_of, ink_on, marker_of, panels, to_picture

APART = 0.17
"""Between two numbers of shots, in rows."""
COLOURS = colormaps["cividis"].resampled(21)
"""Even to colour-blind eyes, and in grey (Nuñez et al. 2018)."""
Runs = Mapping[str, Float[np.ndarray, "seeds tasks"]]
"""By row: the success rate, or mean score, of each seed on each task."""


def means(comparison: Comparison) -> Picture:
    """Draw the means of every row, a panel for each suite and split."""
    metric, digits = comparison.metric.replace("_", " "), DIGITS[comparison.metric]
    by_condition: dict[str, list[str]] = defaultdict(list)
    for cell in comparison.cells:
        by_condition[f"{_where(cell)}, {cell.shots}-shot"].append(f"{cell.row} {cell.mean:.{digits}f}")
    text = "; ".join(f"{condition}: {', '.join(rows)}" for condition, rows in by_condition.items())
    hollow = "Hollow marks are the paper's figures. " if any(cell.paper for cell in comparison.cells) else ""
    with _means_figure(comparison) as figure:
        return to_picture(figure, f"Mean {metric} of each row; bars are 95% intervals", f"{hollow}{text}.")


def draw_means(comparison: Comparison, path: Path, title: str) -> None:
    """Draw the same as a PNG file."""
    with _means_figure(comparison) as figure:
        figure.suptitle(title, fontsize="medium")
        figure.savefig(content := BytesIO(), dpi=110, facecolor="white", format="png")
    write_file(path.parent, path.name, content.getvalue())


def _where(cell: Cell) -> str:
    return f"{cell.suite}, {cell.split}"


@contextmanager
def _means_figure(comparison: Comparison) -> Iterator[Figure]:
    titles = list(dict.fromkeys(map(_where, comparison.cells)))
    columns = min(len(titles), 2)
    lines = -(-len(titles) // columns)
    rows = [row for row in comparison.rows if any(cell.row == row for cell in comparison.cells)]
    height = 1.2 + 0.13 * max(4, len(rows) * (len(comparison.shots) + 1))
    with panels(lines, columns, width=5.3 * columns, height=height * lines) as (figure, axes):
        for axis, title in zip(axes, titles, strict=False):
            _draw_means(axis, rows, [cell for cell in comparison.cells if _where(cell) == title])
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


def _draw_means(axis: Axes, rows: Sequence[str], cells: Sequence[Cell]) -> None:
    shots = sorted({cell.shots for cell in cells})
    for index, count in enumerate(shots):
        of_shots = [cell for cell in cells if cell.shots == count]
        style = {"color": colour_of(index), "fmt": marker_of(index), "markersize": 5, "capsize": 3}
        y = [rows.index(cell.row) + APART * (index - (len(shots) - 1) / 2) for cell in of_shots]
        below = [cell.mean - (cell.mean if cell.low is None else cell.low) for cell in of_shots]
        above = [(cell.mean if cell.high is None else cell.high) - cell.mean for cell in of_shots]
        axis.errorbar([cell.mean for cell in of_shots], y, xerr=[below, above], label=f"{count}-shot", **style)
        papers = [(height + APART / 3, cell.paper) for height, cell in zip(y, of_shots, strict=True) if cell.paper]
        if papers:
            axis.errorbar(
                [paper.value for _, paper in papers], [height for height, _ in papers],
                xerr=[paper.spread or 0.0 for _, paper in papers], mfc="none", elinewidth=0.8,
                label=f"{count}-shot, paper", **style,
            )  # fmt: skip
    axis.set_yticks(range(len(rows)), rows)
    axis.set_ylim(len(rows) - 0.5, -0.5)


def heat_map(
    title: str,
    rows: Sequence[str],
    tasks: Sequence[str],
    values: Float[np.ndarray, "tasks rows"],
    *,
    top: float,
    metric: str,
    digits: int = 2,
) -> Picture:
    """Draw a heat map, tasks downwards.

    A cell whose value is NaN stays empty; `top` is the highest value that there can be.
    """
    wide = 1.4 + 0.07 * max(map(len, tasks)) + 0.85 * len(rows)
    with panels(width=wide, height=1.1 + 0.27 * len(tasks)) as (figure, axes):
        axis = axes[0]
        mesh = axis.pcolormesh(
            np.ma.masked_invalid(values), cmap=COLOURS, vmin=0, vmax=top, edgecolor="face", linewidth=0.5
        )
        for (line, column), value in np.ndenumerate(values):
            if not np.isnan(value):
                ink = ink_on(COLOURS(value / top)[:3])
                axis.text(column + 0.5, line + 0.5, f"{value:.{digits}f}", color=ink, ha="center", va="center")
        turned = {"rotation": 30, "ha": "left", "rotation_mode": "anchor"} if max(map(len, rows)) > 9 else {}
        axis.set_xticks(np.arange(len(rows)) + 0.5, rows, **turned)
        axis.set_yticks(np.arange(len(tasks)) + 0.5, tasks)
        axis.tick_params(length=0, labeltop=True, labelbottom=False)
        axis.invert_yaxis()
        axis.grid(visible=False)
        axis.spines[:].set_visible(False)
        figure.colorbar(mesh, ax=axis, label=metric, fraction=0.05, pad=0.02, ticks=[0, top], format="%g")
        return to_picture(figure, title, _described(rows, tasks, values, digits))


def _described(rows: Sequence[str], tasks: Sequence[str], values: Float[np.ndarray, "tasks rows"], digits: int) -> str:
    texts = []
    for row, of_row in zip(rows, values.T, strict=True):
        known = [(value, task) for value, task in zip(of_row, tasks, strict=True) if not np.isnan(value)]
        if known:
            (least, worst), (most, best) = min(known), max(known)
            texts.append(f"{row} from {least:.{digits}f} ({worst}) to {most:.{digits}f} ({best})")
    return f"Tasks downwards, from those solved most. {'; '.join(texts)}."


def profiles(where: str, rows: Sequence[str], by_shots: Mapping[int, Runs], metric: str, digits: int) -> Picture:
    """Draw the profile of each row, a panel for each number of shots.

    All `rows` keep their colours, whether or not `by_shots` has them.
    """
    texts = []
    top = max(1.0, *(float(runs.max()) for by_row in by_shots.values() for runs in by_row.values()))
    with panels(1, len(by_shots), width=5.3 * len(by_shots), height=3.6) as (figure, axes):
        for axis, (shots, by_row) in zip(axes, by_shots.items(), strict=True):
            for row, runs in by_row.items():
                middle = f"{row}: {interquartile_mean(runs.ravel().tolist()):.{digits}f}"
                _draw_profile(axis, rows.index(row), runs, top, middle, named_rng(0, "profile", where, str(shots), row))
                texts.append(f"{shots}-shot {middle} over {runs.size} runs")
            axis.set(title=f"{where}, {shots}-shot", xlabel=f"{metric} τ", ylabel="fraction of runs above τ")
            axis.set(xlim=(-0.01 * top, 1.02 * top), ylim=(-0.02, 1.02))
            axis.legend(fontsize="small", title="interquartile mean", title_fontsize="small")
        title = f"Performance profile, {where}"
        return to_picture(figure, title, f"Higher is better. Interquartile means: {'; '.join(texts)}.")


def _draw_profile(
    axis: Axes, index: int, runs: Float[np.ndarray, "seeds tasks"], top: float, label: str, draw: np.random.Generator
) -> None:
    """Draw one row's profile, which falls where some run is, and its band if there are several seeds."""
    thresholds = np.unique([0.0, *runs.ravel(), top])
    dashes = DASHES[index % len(DASHES)]
    fractions = performance_profile(runs, thresholds)
    axis.step(thresholds, fractions, where="post", label=label, color=colour_of(index), linestyle=dashes, linewidth=1.8)
    if len(runs) > 1:
        low, high = profile_band(runs, thresholds, draw)
        axis.fill_between(thresholds, low, high, step="post", color=colour_of(index), alpha=0.15, linewidth=0)
