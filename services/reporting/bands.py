"""Curves of training: the mean over seeds, with a band."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from services.reporting.drawing import DASHES, Picture, colour_of, panels, scale_by_logarithms, to_picture

Metrics = Sequence[Sequence[Mapping[str, float]]]
"""Of each seed: the metrics of each iteration, under ``iteration`` its number."""
COLUMNS = 3
POINTS = 60
"""A curve is drawn through so many means of neighbouring iterations at most."""


class Curve(NamedTuple):
    """One metric over the iterations, in a few points."""

    iterations: Float[np.ndarray, " points"]
    mean: Float[np.ndarray, " points"]
    low: Float[np.ndarray, " points"]
    """Lower end of the band: of the lowest seed, of an interval or a percentile."""
    high: Float[np.ndarray, " points"]


def curve_of(metrics: Metrics, name: str) -> Curve | None:
    """Return the curve of a metric over the iterations that all seeds with it have, if there are any.

    A rate that the metrics name ``RATE/...`` has its interval under ``RATE_low/...`` and ``RATE_high/...``.
    """
    seeds = [rows for rows in metrics if any(name in row for row in rows)]
    by_seed = [_by_iteration(rows, name) for rows in seeds]
    steps = sorted(set.intersection(*map(set, by_seed))) if by_seed else []
    if not steps:
        return None
    values = _in_means(np.array([[of_seed[step] for step in steps] for of_seed in by_seed]))
    low, high = values.min(0), values.max(0)
    rate, _, rest = name.partition("/")
    if len(seeds) == 1 and any(f"{rate}_low/{rest}" in row for row in seeds[0]):
        both = [_by_iteration(seeds[0], f"{rate}_{end}/{rest}") for end in ("low", "high")]
        low, high = _in_means(np.array([[of_seed[step] for step in steps] for of_seed in both]))
    ends = [steps[places][-1] for places in chunks_of(len(steps), POINTS)]
    return Curve(np.array(ends, float), values.mean(0), low, high)


def _by_iteration(rows: Sequence[Mapping[str, float]], name: str) -> dict[int, float]:
    return {int(row["iteration"]): row[name] for row in rows if name in row}


def chunks_of(count: int, most: int) -> list[slice]:
    """Return which of so many iterations are drawn as one point, so that there are at most `most` points."""
    size = -(-count // most)
    return [slice(first, first + size) for first in range(0, count, size)]


def _in_means(values: Float[np.ndarray, "seeds iterations"]) -> Float[np.ndarray, "seeds points"]:
    return np.stack([values[:, places].mean(1) for places in chunks_of(values.shape[1], POINTS)], 1)


def curves(title: str, rows: Mapping[str, Metrics], names: Mapping[str, str], *, rate: bool = False) -> Picture | None:
    """Draw a panel for each metric that some row has, with a line for each of these rows.

    The names of the metrics are by the words above their panels; nothing is drawn if no row has two points of any.
    """
    drawable: dict[str, dict[str, Curve | None]] = {}
    for words, name in names.items():
        by_row = {row: curve_of(metrics, name) for row, metrics in rows.items()}
        if any(curve and len(curve.mean) > 1 for curve in by_row.values()):
            drawable[words] = by_row
    if not drawable:
        return None
    columns = min(len(drawable), COLUMNS)
    lines = -(-len(drawable) // columns)
    texts: dict[str, list[str]] = {}
    with panels(lines, columns, width=max(5.3, 3.6 * columns), height=0.5 + 2.7 * lines) as (figure, axes):
        legend = {}
        for axis, (words, by_row) in zip(axes, drawable.items(), strict=False):
            for index, (row, curve) in enumerate(by_row.items()):
                if curve is not None:
                    legend[row] = draw_curve(axis, index, curve, row, "o" if len(curve.mean) < 20 else None, 3)
                    ends = f"from {curve.mean[0]:.3g} to {curve.mean[-1]:.3g}"
                    texts.setdefault(words, []).append(f"{row} {ends}")
            axis.set(title=words, xlabel="iteration")
            axis.xaxis.set_major_locator(MaxNLocator(5, integer=True))
            low, high = (of([of(end) for curve in by_row.values() if curve for end in curve[2:]]) for of in (min, max))
            if rate:
                axis.set_ylim(-0.02, 1.02)
            elif 0 < 10 * low < high:
                scale_by_logarithms(axis)
        for axis in axes[len(drawable) :]:
            axis.remove()
        figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=4, fontsize="small")
        ends = "; ".join(f"{words}: {', '.join(rows)}" for words, rows in texts.items())
        return to_picture(figure, title, f"{ends}.")


def draw_curve(
    axis: Axes, index: int, curve: Curve, label: str, marker: str | None = None, markersize: float | None = None
) -> Line2D:
    """Draw a curve with its band, in the colour and the dashes of its index."""
    style: dict[str, Any] = {"color": colour_of(index), "linestyle": DASHES[index % len(DASHES)]}
    (line,) = axis.plot(curve.iterations, curve.mean, label=label, marker=marker, markersize=markersize, **style)
    axis.fill_between(curve.iterations, curve.low, curve.high, color=colour_of(index), alpha=0.15, linewidth=0)
    return line
