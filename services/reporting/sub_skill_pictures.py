"""Pictures of what the high level chooses: timelines, usage and transitions, each sub-skill in its colour."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch, PathPatch, Rectangle
from matplotlib.path import Path as Outline

from services.reporting.choices import Choices, Timeline, TimelineStatistics, describe_shares, segments
from services.reporting.drawing import INK, Picture, colour_of, ink_on, legend_of_markers, marker_of, panels, to_picture

LEGIBLE = 0.05
"""A stretch gets its number, a bar its share, from this part of the width on."""
STRIP = 0.84
"""Height of a strip, where one takes turns with the next every 1."""
MOST_CELLS = 6
"""With more sub-skills than that, the cells of a matrix are left without numbers: a table has them."""


def draw_timelines(title: str, choices: Sequence[Choices], on: str, most: int) -> Picture:
    """Draw timelines as strips, a row of panels for each run: before adaptation on the left, after it on the right."""
    kept = [(choice, choice.timelines[on][:most]) for choice in choices]
    longest = max(len(timeline.sub_skills) for _, timelines in kept for timeline in timelines)
    strips = max(len(timelines) for _, timelines in kept)
    rows = len(choices) // 2
    with panels(rows, 2, width=9.0, height=0.6 + rows * (0.62 + 0.34 * strips)) as (figure, axes):
        for axis, (choice, timelines) in zip(axes, kept, strict=True):
            for row, timeline in enumerate(timelines):
                _draw_strip(axis, row, timeline, choice.sub_skills, longest)
            axis.set(
                title=f"{choice.run}, {choice.adaptation} adaptation", xlim=(0, longest), ylim=(strips - 0.5, -0.5)
            )
            axis.set_yticks(range(len(timelines)), [timeline.name for timeline in timelines])
            axis.tick_params(axis="y", length=0)
            axis.spines["left"].set_visible(False)
            axis.grid(visible=False)
            if not timelines:
                axis.text(longest / 2, (strips - 1) / 2, "none: the policy has diverged", ha="center", va="center")
        for axis in axes[-2:]:
            axis.set_xlabel("step")
        for axis in axes[::2]:
            axis.set_ylabel("demonstration" if "demonstration" in on else "episode")
        names = _names(choices)
        patches = [Patch(color=colour_of(k)) for k in range(len(names))]
        figure.legend(patches, names, loc="outside lower center", ncols=min(len(names), 6), frameon=False)
        return to_picture(figure, title, _describe(choices, on))


def _draw_strip(axis: Axes, row: int, timeline: Timeline, sub_skills: int, longest: int) -> None:
    """Draw a strip: pale in the sub-skill's colour, with a bar at a height of its own, and its number where it fits."""
    kept = segments(timeline.sub_skills)
    top, lane = row - STRIP / 2, STRIP / sub_skills
    for k in sorted({segment.sub_skill for segment in kept}):
        of_k = [segment for segment in kept if segment.sub_skill == k]
        for upper, height, alpha in ((top, STRIP, 0.35), (top + lane * k, lane, 1)):
            outline = Outline.make_compound_path(*(_box(start, upper, steps, height) for start, steps, _ in of_k))
            axis.add_patch(PathPatch(outline, facecolor=colour_of(k), alpha=alpha, linewidth=0, clip_on=False))
    for start, steps, k in kept:
        if steps >= LEGIBLE * longest:
            above, below = lane * k, lane * (sub_skills - 1 - k)
            free = top + above / 2 if above > below else top + STRIP - below / 2  # beside the bar
            axis.text(start + steps / 2, free, str(k), ha="center", va="center_baseline", fontsize=7.5)


def _box(left: float, bottom: float, width: float, height: float) -> Outline:
    right, top = left + width, bottom + height
    return Outline(
        np.array([(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)]),
        [Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY],
    )


def draw_usage(title: str, choices: Sequence[Choices], kinds: Sequence[str]) -> Picture:
    """Draw shares, dwell times and switches: a row for each run, before and after adaptation, and kind of timelines."""
    rows = [(choice, on, choice.statistics(on)) for on in kinds for choice in choices if choice.timelines[on]]
    positions = range(len(rows))
    with panels(1, 3, width=9.5, height=1.3 + 0.3 * len(rows)) as (figure, (shares, dwell, switches)):
        for row, (choice, _, use) in enumerate(rows):
            _draw_shares(shares, row, use)
            for k in range(choice.sub_skills):
                dwell.plot(use.dwell[k], row, marker=marker_of(k), color=colour_of(k), linestyle="none", clip_on=False)
            switches.barh(row, use.switches, height=0.6, color=INK, alpha=0.45)
        shares.set(title="share of steps", xlabel="share", xlim=(0, 1))
        dwell.set(title="dwell time", xlabel="mean steps a sub-skill is kept", xlim=(0, None))
        switches.set(title="switches", xlabel="switches per episode", xlim=(0, None))
        for axis in (shares, dwell, switches):
            axis.set_ylim(len(rows) - 0.5, -0.5)
            axis.set_yticks(positions, [""] * len(rows))
            axis.grid(visible=False, axis="y" if axis is not shares else "both")
        short = {"held-out demonstrations": "demonstrations"}
        shares.set_yticks(positions, [f"{c.run}, {c.adaptation}, {short.get(on, on)}" for c, on, _ in rows])
        legend_of_markers(figure, _names(choices))
        text = "; ".join(
            f"{choice.run} {choice.adaptation} adaptation in {on}: {describe_shares(use.shares)}, {use.switches:.1f} "
            "switches per episode"
            for choice, on, use in rows
        )
        return to_picture(figure, title, f"{text}.")


def _draw_shares(axis: Axes, row: int, use: TimelineStatistics) -> None:
    left = 0.0
    for k, share in enumerate(use.shares):
        axis.barh(row, share, left=left, height=0.6, color=colour_of(k))
        if share >= LEGIBLE:
            axis.text(left + share / 2, row, str(k), ha="center", va="center", fontsize=7, color=ink_on(colour_of(k)))
        left += share


def draw_transitions(title: str, choices: Sequence[Choices], on: str) -> Picture:
    """Draw, for each run before and after adaptation, how often each sub-skill is followed by each."""
    kept = [(choice, choice.statistics(on).followed) for choice in choices]
    columns = min(4, len(kept))
    rows = -(-len(kept) // columns)
    with panels(rows, columns, width=2.3 * columns, height=2.5 * rows) as (figure, axes):
        for axis in axes[len(kept) :]:
            axis.set_axis_off()
        for axis, (choice, followed) in zip(axes, kept, strict=False):
            for (before, after), fraction in np.ndenumerate(np.nan_to_num(followed)):
                corner = after - 0.5, before - 0.5
                axis.add_patch(Rectangle(corner, 1, 1, facecolor=colour_of(after), alpha=0.6 * fraction, linewidth=0))
                if len(followed) <= MOST_CELLS:
                    text = f"{fraction:.2f}" if np.isfinite(followed[before, after]) else "–"
                    axis.text(after, before, text, ha="center", va="center", fontsize=7.5)
            ends, numbers = (-0.5, len(followed) - 0.5), range(len(followed))
            axis.set(title=f"{choice.run}, {choice.adaptation}", xlim=ends, ylim=ends[::-1], xticks=numbers)
            axis.set(xlabel="sub-skill at the next step", ylabel="sub-skill", yticks=numbers, aspect="equal")
            axis.grid(visible=False)
        text = "; ".join(
            f"{choice.run} {choice.adaptation} adaptation: " + (_describe_kept(followed) or "no step follows another")
            for choice, followed in kept
        )
        return to_picture(figure, title, f"Fractions of each row; – where nothing follows. Followed by itself, {text}.")


def _describe_kept(followed: np.ndarray) -> str:
    return ", ".join(
        f"sub-skill {k} {fraction:.2f}" for k, fraction in enumerate(followed.diagonal()) if np.isfinite(fraction)
    )


def _names(choices: Sequence[Choices]) -> list[str]:
    return [f"sub-skill {k}" for k in range(max(choice.sub_skills for choice in choices))]


def _describe(choices: Sequence[Choices], on: str) -> str:
    """Say in words how the sub-skills are used in all timelines of a kind."""
    parts = []
    for choice in choices:
        if timelines := choice.timelines[on]:
            use = choice.statistics(on)
            parts.append(
                f"{choice.run} {choice.adaptation} adaptation: {describe_shares(use.shares)} of the steps of "
                f"{len(timelines)} {on}, {use.switches:.1f} switches in each"
            )
    return "; ".join(parts) + "."
