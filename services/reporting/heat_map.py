"""Heat maps of rows and tasks, with the number in each cell."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps

from services.reporting.drawing import Picture, drawn, ink_on, panels

COLOURS = colormaps["cividis"].resampled(21)
"""Even to colour-blind eyes, and in grey (Nuñez et al. 2018)."""


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

    Args:
        title: of the picture.
        rows: of the comparison, which are the columns here: their names are the shorter ones.
        tasks: by name.
        values: the mean of each; nan where there is none, which stays empty.
        top: the highest value that there can be.
        metric: in words.
        digits: of the numbers.
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
        return drawn(figure, title, _described(rows, tasks, values, digits))


def _described(rows: Sequence[str], tasks: Sequence[str], values: Float[np.ndarray, "tasks rows"], digits: int) -> str:
    told = []
    for row, own in zip(rows, values.T, strict=True):
        known = [(value, task) for value, task in zip(own, tasks, strict=True) if not np.isnan(value)]
        if known:
            (least, worst), (most, best) = min(known), max(known)
            told.append(f"{row} from {least:.{digits}f} ({worst}) to {most:.{digits}f} ({best})")
    return f"Tasks downwards, from those solved most. {'; '.join(told)}."
