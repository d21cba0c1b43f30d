"""How meta-training went: losses, use of sub-skills, practice, and success over the iterations."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from dmil_core.settings import MethodConfig
from services.evaluation.results import EpisodeResult
from services.evaluation.summary import summary_rows
from services.experiments.finished_run import FinishedRun
from services.reporting.bands import Curve, chunks_of, draw_curve
from services.reporting.drawing import Picture, colour_of, marker_of, panels, style_of, to_picture
from services.reporting.page import Part, Prose, Section
from services.suites.base import Split

Metrics = Sequence[Mapping[str, float]]
Lines = dict[tuple[Split, int], list[tuple[int, float, float, float]]]
"""By split and shots: iteration, mean, and the ends of its interval."""
SPLITS = ("meta-training", "meta-testing")
SHARE = "sub_skill_share/"
MOST_POINTS = 50
"""A curve goes through so many points at most, each the mean of as many iterations."""
MIDDLE = (10, 90)
"""Percentiles of the iterations behind a point, between which the band lies."""
FEW = 15
"""So few points are marked each."""
WIDE = 20
"""Where the largest of a panel is more than so many times the smallest, the scale is logarithmic."""
COLUMNS = 3
"""Panels side by side."""
HATCHES = ("", "//", "..", "\\\\", "xx", "--", "oo", "||", "++", "**")


class Panel(NamedTuple):
    """Metrics that are drawn together."""

    title: str
    unit: str
    names: tuple[str, ...]


PICTURES: Mapping[str, Sequence[Panel]] = {
    "Losses": (
        Panel("high level", "cross-entropy in nats", ("high_loss_after", "high_loss_before")),
        Panel("sub-skills", "squared error, added over sub-skills", ("low_loss_after", "low_loss_before")),
        Panel("continuity", "continuity loss", ("continuity_loss",)),
        Panel(
            "loss of the outer step",
            "loss",
            ("loss", "loss_unadapted", "loss_after_warm_up", "loss_of_best", "inner_loss"),
        ),
        Panel("terms of the loss", "loss in nats", ("likelihood_loss", "information_loss", "context_divergence")),
        Panel("error of actions", "squared error", ("action_error",)),
        Panel("spread of the policy", "standard deviation", ("deviation", "policy_deviation", "context_deviation")),
    ),
    "Use of sub-skills": (
        Panel("share of states", "fraction of states", (SHARE,)),
        Panel("how they are chosen", "fraction", ("sub_skill_entropy", "agreement", "switches")),
    ),
    "Discriminator and practice": (
        Panel("success in practice", "success rate", ("practice_success",)),
        Panel("reward", "reward of a step in nats", ("reward",)),
        Panel("discriminator's loss", "cross-entropy in nats", ("discriminator_loss",)),
        Panel("discriminator", "fraction", ("discriminator_accuracy", "discriminator_expert", "discriminator_pseudo")),
        Panel("way of an improvement", "divergence in nats", ("high_divergence", "low_divergence")),
        Panel("entropy of the high level", "nats", ("option_entropy",)),
        Panel("critic", "squared error", ("value_error",)),
    ),
    "Outer step": (
        Panel("gradient", "norm", ("gradient_norm",)),
        Panel("clipped in the inner loop", "fraction of its numbers", ("inner_clipped",)),
        Panel("speed", "iterations a second", ("iterations_per_second",)),
        Panel("time besides the work itself", "fraction of the time", ("overhead_share",)),
    ),
}
"""What the methods of `dmil_core.methods` measure, in the order in which it is shown."""
OTHERS = "Other metrics"
"""The picture of what no panel above names, as a method of one's own may have."""
UNSHOWN = ("iteration", "environment_steps")
FRACTIONS = ("fraction", "fraction of states", "success rate")
WORDS = {
    "high_loss_before": "before adaptation",
    "high_loss_after": "after adaptation",
    "low_loss_before": "before adaptation",
    "low_loss_after": "after adaptation",
    "loss_unadapted": "before adaptation",
    "inner_loss": "loss of the inner loop",
    "loss_of_best": "loss of the best-fitting sub-skill",
    "sub_skill_entropy": "entropy of the shares (1: all alike)",
    "agreement": "agreement with the best-fitting sub-skill",
    "switches": "switches, of all steps",
    "discriminator_expert": "D of the expert's actions",
    "discriminator_pseudo": "D of the policy's actions",
}
"""What a metric's line is called, if not by its name."""


def training_curves(finished: FinishedRun) -> Section:
    """Return the section with all that was measured in meta-training, and at checkpoints on the way."""
    parts: list[Part] = []
    if len(finished.evaluations) > 1:
        parts += draw_success(finished.evaluations, finished.config.method, finished.best_score)
    if pictures := draw_metrics(finished.metrics):
        text = (
            f"A curve goes through {MOST_POINTS} points at most: each is the mean of as many iterations, and the band "
            f"around it holds the middle {MIDDLE[1] - MIDDLE[0]}% of them."
        )
        parts += [Prose(text), *pictures]
    return Section("Training curves", parts)


def draw_metrics(metrics: Metrics) -> list[Picture]:
    """Return the pictures of what was measured in each iteration; one in which nothing would be is left out."""
    names = [name for name in dict.fromkeys(name for row in metrics for name in row) if not _is_unshown(name)]
    known = {name for panels_ in PICTURES.values() for panel in panels_ for name in _in_panel(panel, names)}
    others = [Panel(_words(name), "", (name,)) for name in names if name not in known]
    pictures = []
    for title, panels_ in {**PICTURES, OTHERS: others}.items():
        curves = {panel: {_words(name): _curve(metrics, name) for name in _in_panel(panel, names)} for panel in panels_}
        if filled := {panel: lines for panel, lines in curves.items() if lines}:
            pictures.append(_picture(title, filled))
    return pictures


def _is_unshown(name: str) -> bool:
    """Tell whether a metric is none of an iteration: evaluations and the end of a run record theirs beside."""
    return name in UNSHOWN or name.startswith("seconds/") or name.partition("/")[2].startswith(SPLITS)


def _in_panel(panel: Panel, names: Sequence[str]) -> list[str]:
    return [name for of in panel.names for name in names if name == of or (of == SHARE and name.startswith(of))]


def _words(name: str) -> str:
    if name.startswith(SHARE):
        return f"sub-skill {name.removeprefix(SHARE)}"
    return WORDS.get(name, name.replace("_", " "))


def _curve(metrics: Metrics, name: str) -> Curve:
    rows = np.array([(row["iteration"], row[name]) for row in metrics if name in row])
    chunks = [rows[places] for places in chunks_of(len(rows), MOST_POINTS)]
    low, high = np.transpose([np.percentile(chunk[:, 1], MIDDLE) for chunk in chunks])
    return Curve(np.array([chunk[-1, 0] for chunk in chunks]), np.array([c[:, 1].mean() for c in chunks]), low, high)


def _picture(title: str, filled: Mapping[Panel, Mapping[str, Curve]]) -> Picture:
    columns = min(len(filled), COLUMNS)
    rows = -(-len(filled) // columns)
    with panels(rows, columns, width=3.9 * columns, height=2.8 * rows) as (figure, axes):
        for axis, (panel, curves) in zip(axes, filled.items(), strict=False):
            (_draw_shares if panel.names == (SHARE,) else _draw_lines)(axis, curves)
            axis.set(title=panel.title, xlabel="iteration", ylabel=panel.unit)
            if panel.unit in FRACTIONS:
                axis.set(yscale="linear", ylim=(0, 1.02))
        for axis in axes[len(filled) :]:
            axis.remove()
        return to_picture(figure, title, " ".join(_describe(panel, curves) for panel, curves in filled.items()))


def _describe(panel: Panel, curves: Mapping[str, Curve]) -> str:
    each = [f"{label} from {curve.mean[0]:.3g} to {curve.mean[-1]:.3g}" for label, curve in curves.items()]
    return f"{panel.title.capitalize()}: {'; '.join(each)}."


def _draw_lines(axis: Axes, curves: Mapping[str, Curve]) -> None:
    for index, (label, curve) in enumerate(curves.items()):
        draw_curve(axis, index, curve, label, "." if len(curve.mean) < FEW else None)
    values = np.concatenate([np.concatenate([curve.low, curve.mean]) for curve in curves.values()])
    if values.min() > 0 and values.max() > WIDE * values.min():
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter("{x:g}")
    if len(curves) > 1:
        axis.legend(fontsize="small")


def _draw_shares(axis: Axes, curves: Mapping[str, Curve]) -> None:
    """Stack the shares, which add up to 1, each with its sub-skill's colour, hatch and name."""
    iterations = next(iter(curves.values())).iterations
    if len(iterations) == 1:
        iterations = iterations[0] + np.array([-0.5, 0.5])  # a single point has no width
    labels = list(curves)
    edges = np.cumsum([np.broadcast_to(curve.mean, iterations.shape) for curve in curves.values()], axis=0)
    for index, (low, high) in enumerate(zip((np.zeros_like(edges[0]), *edges), edges, strict=False)):
        axis.fill_between(
            iterations, low, high, facecolor=colour_of(index), edgecolor="white", linewidth=0.3,
            hatch=HATCHES[index % len(HATCHES)], label=labels[index],
        )  # fmt: skip
    axis.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5), reverse=True)


def draw_success(
    evaluations: Mapping[int, Sequence[EpisodeResult]], method: MethodConfig, best_score: int
) -> list[Picture]:
    """Return how success, and the score where there is one, went over the iterations."""
    by_iteration = {
        iteration: summary_rows(evaluations[iteration], best_score, method) for iteration in sorted(evaluations)
    }
    rates: Lines = defaultdict(list)
    scores: Lines = defaultdict(list)
    for iteration, of_iteration in by_iteration.items():
        for cell in of_iteration:
            key = cell.split, cell.shots
            rates[key].append((iteration, cell.success_rate, cell.low, cell.high))
            if (score := cell.score) is not None:
                low, high = (score.mean if side is None else side for side in (score.low, score.high))
                scores[key].append((iteration, score.mean, low, high))
    pictures = [_progress("Success over the iterations", "success rate", 1, rates)]
    return [*pictures, _progress("Score over the iterations", "mean score", best_score, scores)] if scores else pictures


def _progress(title: str, what: str, best: int, lines: Lines) -> Picture:
    splits = list(dict.fromkeys(split for split, _ in lines))
    texts = []
    with panels(1, len(splits), width=4.8 * len(splits), height=3.1) as (figure, axes):
        for axis, split in zip(axes, splits, strict=True):
            for index, (key, points) in enumerate(line for line in lines.items() if line[0][0] == split):
                iterations, means, low, high = map(list, zip(*points, strict=True))
                label = f"{key[1]}-shot"
                axis.plot(iterations, means, label=label, marker=marker_of(index), **style_of(index))
                axis.fill_between(iterations, low, high, color=colour_of(index), alpha=0.2, linewidth=0)
                texts.append(
                    f"{split}, {label}: " + ", ".join(f"{m:.2f} at {i}" for i, m in zip(iterations, means, strict=True))
                )
            axis.set(title=split, xlabel="iteration", ylabel=what, ylim=(0, 1.03 * best))
            axis.legend(fontsize="small")
        text = f"The {what} after so many iterations, with 95% intervals. {'; '.join(texts)}."
        return to_picture(figure, title, text)
