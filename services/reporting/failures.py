"""What failed: all episodes of the worst tasks once more, by how far each has come at every step."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from dmil_core.files import inside
from services.evaluation.results import EpisodeResult, grouped
from services.experiments.finished_run import REPORT, FinishedRun
from services.experiments.replay import Replay, ReplayedEpisode, ReplayError, replaying
from services.reporting.drawing import Picture, colour_of, panels, to_picture
from services.reporting.film import FORMS, video_settings, write_film
from services.reporting.page import Clip, Commands, DataTable, Part, Prose, Section
from services.reporting.video import camera_of, command, name_of, side_of
from services.suites.base import Measure, measure_of

MOST_TASKS = 3
MOST_EPISODES = 20
"""Of a task; whole adaptations are run, until there are so many."""
FAILED: dict[str, Any] = {"color": colour_of(3), "linestyle": "solid", "marker": "x"}
SOLVED: dict[str, Any] = {"color": colour_of(0), "linestyle": "dashed", "marker": "o"}
"""A marker stands at the end of an episode."""
APART = 0.015
"""Lines of scores, which would cover each other, are drawn so far apart."""


def failures_of_run(finished: FinishedRun, *, videos: bool = False) -> Section:
    """Return the section on the tasks that failed most: their episodes are run again, and drawn step by step.

    With `videos` an episode of each task is filmed too, into the run's folder ``report/videos``.

    Raises:
        RenderingError: if there is nothing here to film with.
        UserError: if the suite names no camera to film with.
        DiskFullError: for want of space for films.
    """
    title, worst = "What failed", worst_tasks(finished.episodes)
    if not worst:
        return Section(title, [Prose(f"Nothing: all {len(finished.episodes)} episodes were solved.")])
    parts: list[Part] = [
        Prose(
            f"The {'task' if len(worst) == 1 else f'{len(worst)} tasks'} with the lowest success rates over all shots, "
            "those of meta-testing before those of meta-training; of each, the episodes with the number of shots at "
            "which most failed. They were run again for this page."
        )
    ]
    rows: list[list[str | int | float]] = []
    try:
        with replaying(finished) as replay:
            for of_task in worst:
                task_parts, task_rows = _of_task(replay, of_task, videos=videos)
                parts += task_parts
                rows += task_rows
    except ReplayError as error:
        return Section(title, [Prose(f"Their episodes cannot be run again here: {error}.")])
    head = ["task", "shots", "episode", "solved", "steps", "measure", "first step", "smallest", "largest", "last step"]
    parts.append(DataTable("Episodes that were run again", head, rows))
    return Section(title, parts)


def worst_tasks(episodes: Sequence[EpisodeResult]) -> list[list[EpisodeResult]]:
    """Return the rows of the tasks that failed most, each with the number of shots at which most failed.

    Tasks of meta-testing, which the run is for, come before the others; those in which nothing failed are left out.
    """
    failed = [rows for rows in grouped(episodes, lambda row: (row.split, row.task)).values() if _rate(rows) < 1]
    failed.sort(key=lambda rows: (rows[0].split != "meta-testing", _rate(rows)))
    return [
        min(grouped(rows, lambda row: row.shots).values(), key=lambda of: (_rate(of), of[0].shots))
        for rows in failed[:MOST_TASKS]
    ]


def _rate(rows: Sequence[EpisodeResult]) -> float:
    return sum(row.success for row in rows) / len(rows)


def _of_task(
    replay: Replay, rows: Sequence[EpisodeResult], *, videos: bool
) -> tuple[list[Part], list[list[str | int | float]]]:
    """Return what the page shows of a task, and a line of the table for each episode."""
    run, task = replay.run, rows[0].task
    adaptations = sorted(grouped(rows, lambda row: row.draw).values(), key=_rate)
    filmed = next(row for row in adaptations[0] if not row.success)
    replayed = _run_again(replay, adaptations, filmed if videos else None)
    measure = measure_of(run.experiment.suite, task)
    parts: list[Part] = [Prose(_describe_task(rows, replayed, measure))]
    if measure is not None and (measured := [one for one in replayed if _course(one, measure).size]):
        parts.append(draw_episodes(measured, measure, run.experiment.suite.best_score))
    if videos:
        (one,) = [one for one in replayed if one.row == filmed]
        parts.append(_film(run, one))
    else:
        parts.append(Commands(f"To see one that failed in {task}", [command(run, filmed)]))
    return parts, [_table_row(one, measure) for one in replayed]


def _run_again(
    replay: Replay, adaptations: Sequence[Sequence[EpisodeResult]], filmed: EpisodeResult | None
) -> list[ReplayedEpisode]:
    """Run whole adaptations, until there are enough episodes."""
    video = None if filmed is None else video_settings(camera_of(replay.run), filmed.steps, FORMS["mp4"])
    replayed: list[ReplayedEpisode] = []
    for adaptation in adaptations:
        if len(replayed) >= MOST_EPISODES:
            break
        numbers = [filmed.episode] if filmed is not None and filmed in adaptation else []
        replayed += replay.rerun(adaptation[0], video, numbers)
    return sorted(replayed, key=lambda one: one.row.episode)


def _course(replayed: ReplayedEpisode, measure: Measure) -> Float64[np.ndarray, " steps"]:
    """Return the measure at each step: at none, if the policy had diverged before the first one."""
    return replayed.recording.infos.get(measure.name, np.zeros(0))


def _describe_task(rows: Sequence[EpisodeResult], replayed: Sequence[ReplayedEpisode], measure: Measure | None) -> str:
    first = rows[0]
    solved = sum(row.success for row in rows)
    text = f"{first.task} ({first.split}), {first.shots}-shot: {solved} of {len(rows)} episodes were solved"
    if len(replayed) < len(rows):
        text += f"; {len(replayed)} of them were run again, the worst support sets first"
    text += "."
    if differences := [one.difference for one in replayed if one.difference is not None]:
        text += f" {len(differences)} came out otherwise than in the run: {differences[0]}."
    if measure is None:
        text += " The suite does not measure how far an episode has come, only whether it is solved."
    return text


def _table_row(replayed: ReplayedEpisode, measure: Measure | None) -> list[str | int | float]:
    row, episode = replayed.row, replayed.rollout
    course = np.zeros(0) if measure is None else _course(replayed, measure)
    numbers = (course[0], course.min(), course.max(), course[-1]) if course.size else ()
    fields = [f"{number:.3g}" for number in numbers] or [""] * 4
    what = "none" if measure is None else measure.words
    return [row.task, row.shots, row.episode, "yes" if episode.success else "no", len(episode), what, *fields]


def draw_episodes(replayed: Sequence[ReplayedEpisode], measure: Measure, best_score: int) -> Picture:
    """Draw how far episodes of one task have come at every step: a line each, failed ones crossed."""
    row, scored = replayed[0].row, measure.name == "score"
    kinds = {success: [one for one in replayed if one.rollout.success is success] for success in (True, False)}
    with panels(width=7.5, height=3.1) as (figure, (axis,)):
        for success, style, word in ((True, SOLVED, "solved"), (False, FAILED, "failed")):
            for index, one in enumerate(kinds[success]):
                course = _course(one, measure) + scored * APART * index
                steps = np.arange(1, len(course) + 1)
                label = f"{word} ({len(kinds[success])})" if index == 0 else None
                drawing: dict[str, Any] = {"drawstyle": "steps-post"} if scored else {}
                axis.plot(steps, course, label=label, markevery=[-1], linewidth=1.2, **style, **drawing)
        axis.set(xlabel="step", ylabel=measure.words, xlim=(0, None))
        if scored:
            axis.set(ylim=(-0.1, best_score * 1.1), yticks=range(best_score + 1))
        else:
            axis.set_ylim(bottom=0)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")
        title = f"{row.task}, {row.shots}-shot: {measure.words} at each step"
        text = " ".join(
            _describe_episodes(word, kinds[success], measure) for success, word in ((False, "failed"), (True, "solved"))
        )
        apart = "; equal scores are drawn a little apart" if scored else ""
        return to_picture(figure, title, f"A line is an episode; a cross or a dot is its end{apart}. {text}")


def _describe_episodes(word: str, replayed: Sequence[ReplayedEpisode], measure: Measure) -> str:
    if not replayed:
        return f"None {word}."
    courses = [_course(one, measure) for one in replayed]
    first, low, high, last = np.mean([(each[0], each.min(), each.max(), each[-1]) for each in courses], axis=0)
    return (
        f"{len(replayed)} {word}: on average {first:.3g} at the first step, {low:.3g} at the smallest, {high:.3g} at "
        f"the largest and {last:.3g} at the last."
    )


def _film(run: FinishedRun, replayed: ReplayedEpisode) -> Clip:
    side = side_of(run, replayed)
    path: Path = inside(run.folder, f"{REPORT}/videos") / f"{name_of(replayed.row)}.mp4"
    write_film(path, [side])
    return Clip(f"{side.title}: {side.ending}", path)
