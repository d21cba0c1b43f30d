"""Performance profiles: how many runs are better than how much (Agarwal et al., NeurIPS 2021)."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from dmil_core.seeding import named_rng
from dmil_core.statistics import interquartile_mean, performance_profile, profile_band
from services.reporting.drawing import DASHES, Picture, colour_of, drawn, panels

Runs = Mapping[str, Float[np.ndarray, "seeds tasks"]]
"""By row: the success rate, or mean score, of each seed on each task."""


def profiles(where: str, rows: Sequence[str], by_shots: Mapping[int, Runs], metric: str, digits: int) -> Picture:
    """Draw the profile of each row, a panel for each number of shots.

    Args:
        where: suite and split.
        rows: all there are, in the order of their colours.
        by_shots: what each row came to, by the number of shots.
        metric: in words.
        digits: that figures are shown to.
    """
    told = []
    top = max(1.0, *(float(runs.max()) for own in by_shots.values() for runs in own.values()))
    with panels(1, len(by_shots), width=5.3 * len(by_shots), height=3.6) as (figure, axes):
        for axis, (shots, own) in zip(axes, by_shots.items(), strict=True):
            for row, runs in own.items():
                middle = f"{row}: {interquartile_mean(runs.ravel().tolist()):.{digits}f}"
                _draw(axis, rows.index(row), runs, top, middle, named_rng(0, "profile", where, str(shots), row))
                told.append(f"{shots}-shot {middle} over {runs.size} runs")
            axis.set(title=f"{where}, {shots}-shot", xlabel=f"{metric} τ", ylabel="fraction of runs above τ")
            axis.set(xlim=(-0.01 * top, 1.02 * top), ylim=(-0.02, 1.02))
            axis.legend(fontsize="small", title="interquartile mean", title_fontsize="small")
        title = f"Performance profile, {where}"
        return drawn(figure, title, f"Higher is better. Interquartile means: {'; '.join(told)}.")


def _draw(
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
