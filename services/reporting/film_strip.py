"""One episode of a new task as a strip of pictures: what the camera saw, and which sub-skill acted."""

import math
from collections.abc import Sequence

from dmil_core.errors import UserError
from services.evaluation.results import EpisodeResult
from services.experiments.finished_run import FinishedRun
from services.experiments.replay import replaying
from services.reporting.drawing import Picture, colour_of, panels, to_picture
from services.reporting.film import Side
from services.reporting.page import Commands, Prose, Section
from services.reporting.video import camera_of, command, side_of
from services.rollouts.recording import VideoSettings

PICTURES = 6
HEIGHT, WIDTH = 180, 240
"""Of a picture, in pixels."""
BORDER = 3.0
"""In points: its colour is the sub-skill's."""


def strip_of_run(finished: FinishedRun) -> Section:
    """Return the section with a strip of `example_episode`, which is run again for that."""
    title = "A new task, step by step"
    if (row := example_episode(finished.episodes)) is None:
        return Section(title, [])
    try:
        settings = VideoSettings(camera_of(finished), math.ceil(row.steps / (PICTURES - 1)), HEIGHT, WIDTH)
        with replaying(finished) as replay:
            replayed = replay.rerun(row, settings, [row.episode])
    except UserError as error:  # no camera, no OpenGL, other demonstrations: the page goes without
        return Section(title, [Prose(f"There is no strip of pictures: {error}.")])
    (one,) = [one for one in replayed if one.row == row]
    return Section(title, [draw_strip(side_of(finished, one)), Commands("The whole episode", [command(finished, row)])])


def example_episode(episodes: Sequence[EpisodeResult]) -> EpisodeResult | None:
    """Return the first episode of meta-testing that was solved with the fewest shots, or the first one if none was.

    None if no adapted policy acted in one.
    """
    acted = [row for row in episodes if row.split == "meta-testing" and row.steps]
    rows = sorted(acted, key=lambda row: row.shots)
    return next((row for row in rows if row.success), rows[0] if rows else None)


def draw_strip(side: Side) -> Picture:
    """Draw the pictures of an episode beside each other, from its start to its end."""
    with panels(1, len(side.frames), width=9.0, height=1.9) as (figure, axes):
        figure.suptitle(f"{side.title}: {side.ending}", fontsize="medium")
        for axis, (step, picture) in zip(axes, side.frames, strict=True):
            acting = side.acting(step)
            axis.imshow(picture)
            axis.set(xticks=[], yticks=[], title=f"step {step}")
            axis.set_xlabel("" if acting is None else f"sub-skill {acting}")
            for spine in axis.spines.values():
                spine.set(visible=True, linewidth=BORDER, color=colour_of(acting or 0))
        steps = ", ".join(str(step) for step, _ in side.frames)
        text = f"What the camera saw after {steps} steps; {side.ending}."
        if side.sub_skills:
            acted = ", ".join(str(side.acting(step)) for step, _ in side.frames)
            text += f" The sub-skills that had acted just before, which the borders' colours show too: {acted}."
        return to_picture(figure, "An episode from its start to its end", text)
