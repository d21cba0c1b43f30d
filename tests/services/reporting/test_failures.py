"""The section on what failed: which tasks it takes, and that it shows what their episodes were."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dmil_core.errors import UserError
from dmil_core.trajectories import Rollout
from services import report
from services.cli.colours import COLOURS
from services.distributed.runner import LocalRunner
from services.evaluation.results import EpisodeResult, write_rows
from services.evaluation.summary import summarise
from services.experiments.finished_run import FinishedRun
from services.experiments.replay import ReplayedEpisode
from services.reporting.drawing import Picture
from services.reporting.end_of_run import write_report
from services.reporting.failures import FAILED, SOLVED, draw_episodes, failures_of_run, worst_tasks
from services.reporting.page import Commands, DataTable, Prose, Section
from services.rollouts.recording import Recording
from services.suites.base import Measure
from services.suites.rendering import RenderingError
from tests.services.reporting.made_runs import TASKS, make_run

MOST_BYTES = 5_000_000


@pytest.fixture
def with_rows(finished: FinishedRun, tmp_path: Path) -> Callable[..., FinishedRun]:
    """Returns the run with the rows that are asked for."""

    def choose(chosen: Callable[[EpisodeResult], bool], **values: object) -> FinishedRun:
        shutil.copytree(finished.folder, tmp_path / "chosen")
        rows = [row.model_copy(update=values) for row in finished.episodes if chosen(row)]
        write_rows(tmp_path / "chosen" / "episodes.jsonl", rows)
        return FinishedRun(tmp_path / "chosen")

    return choose


def prose(section: Section) -> list[str]:
    return [part.text for part in section.parts if isinstance(part, Prose)]


def replayed_with(
    courses: list[np.ndarray], solved: list[bool], row: EpisodeResult, name: str
) -> list[ReplayedEpisode]:
    """Return episodes that might have been seen, with the measure at each step."""
    found = []
    for course, success in zip(courses, solved, strict=True):
        steps = len(course)
        rollout = Rollout(
            np.zeros((steps + 1, 39), np.float32),
            np.zeros((steps, 4), np.float32),
            solved_at=steps - 1 if success else None,
            score=int(success),
            sub_skills=np.zeros(steps, np.int64),
        )
        found.append(ReplayedEpisode(row, rollout, Recording({name: course}, [])))
    return found


def test_the_worst_tasks_are_those_of_meta_testing_and_then_the_others(tmp_path: Path):
    make_run(tmp_path, lambda task, number: number < {"reach": 20, "push": 3, "window-open": 9}[task])
    worst = worst_tasks(FinishedRun(tmp_path).episodes)
    assert [(rows[0].split, rows[0].task, sum(row.success for row in rows)) for rows in worst] == [
        ("meta-testing", "push", 3), ("meta-testing", "window-open", 9), ("meta-training", "push", 3)
    ]  # fmt: skip
    assert {len(rows) for rows in worst} == {20}


def test_of_a_task_it_takes_the_shots_at_which_most_failed(tmp_path: Path):
    make_run(tmp_path, lambda task, number: task != TASKS[0] or number < 12)
    rows = [row for row in FinishedRun(tmp_path).episodes if row.split == "meta-testing"]
    worse = [row.model_copy(update={"shots": 3, "success": row.success and row.episode < 5}) for row in rows]
    (chosen, *_) = worst_tasks([*rows, *worse])
    assert {row.shots for row in chosen} == {3}
    same = [row.model_copy(update={"shots": 3}) for row in rows]
    (chosen,) = worst_tasks([*same, *rows])
    assert {row.shots for row in chosen} == {1}


def test_where_nothing_failed_it_says_so(with_rows):
    section = failures_of_run(with_rows(lambda row: True, success=True))
    assert prose(section) == ["Nothing: all 16 episodes were solved."]
    assert len(section.parts) == 1


def test_it_draws_what_the_episodes_were(with_rows):
    run = with_rows(lambda row: row.task in {"door-close", "reach"})
    section = failures_of_run(run)
    worst = worst_tasks(run.episodes)
    assert prose(section)[0].startswith(f"The {len(worst)} tasks with the lowest success rates over all shots")
    pictures = [part for part in section.parts if isinstance(part, Picture)]
    assert [picture.title for picture in pictures] == [
        f"{rows[0].task}, {rows[0].shots}-shot: distance to the goal (m) at each step" for rows in worst
    ]
    (table,) = [part for part in section.parts if isinstance(part, DataTable)]
    assert [row[:5] for row in table.rows] == [
        [row.task, row.shots, row.episode, "yes" if row.success else "no", row.steps] for rows in worst for row in rows
    ]
    for _, _, _, _, _, what, first, smallest, largest, last in table.rows:
        assert what == "distance to the goal (m)"
        assert 0 <= float(smallest) <= min(float(first), float(last)) <= float(largest) < 2
    assert "otherwise than in the run" not in " ".join(prose(section))
    commands = [line for part in section.parts if isinstance(part, Commands) for line in part.lines]
    assert all(f"--task {rows[0].task}" in line for rows, line in zip(worst, commands, strict=True))


def test_failures_are_distinguished_by_colour_dash_and_mark(finished: FinishedRun):
    courses = [np.linspace(0.3, end, 20) for end in (0.2, 0.1, 0.0)]
    seen = replayed_with(courses, [False, False, True], finished.episodes[0], "d")
    picture = draw_episodes(seen, Measure("d", "distance (m)"), 1)
    assert set(re.findall(r"#[0-9a-f]{6}", picture.svg)) & set(COLOURS) == {FAILED["color"], SOLVED["color"]}
    assert FAILED["linestyle"] != SOLVED["linestyle"]
    assert FAILED["marker"] != SOLVED["marker"]
    for label in ("failed (2)", "solved (1)", "distance (m)", "step"):
        assert f">{label}<" in picture.svg
    assert "2 failed: on average 0.3 at the first step, 0.15 at the smallest" in picture.description
    assert "1 solved: on average 0.3 at the first step, 0 at the smallest" in picture.description


def test_equal_scores_are_drawn_apart(finished: FinishedRun):
    course = np.repeat([0.0, 1.0, 2.0], 10)
    measure = Measure("score", "sub-tasks done")
    picture = draw_episodes(replayed_with([course, course], [False, False], finished.episodes[0], "score"), measure, 4)
    assert "equal scores are drawn a little apart" in picture.description
    assert "None solved." in picture.description
    assert all(f">{score}<" in picture.svg for score in range(5)), "the scores that there may be"
    lines = re.findall(rf'<path d="([^"]*)"[^>]*fill: none; stroke: {FAILED["color"]}; stroke-width', picture.svg)
    assert len(set(lines)) == len(lines) == 3, "both, and the legend's"


def test_a_policy_that_diverged_at_once_has_no_line_but_a_row(with_rows):
    run = with_rows(lambda row: (row.task, row.shots) == ("reach", 1), success=False, learning_rate=1e30)
    section = failures_of_run(run)
    assert not [part for part in section.parts if isinstance(part, Picture)]
    (table,) = [part for part in section.parts if isinstance(part, DataTable)]
    assert {(row[3], row[4], row[6]) for row in table.rows} == {("no", 0, "")}
    assert "came out otherwise than in the run" in prose(section)[1]


def test_rows_of_another_checkpoint_are_refused(with_rows):
    with pytest.raises(UserError, match="got rows of ffffffffffff; wanted those of"):
        failures_of_run(with_rows(lambda row: True, checkpoint="f" * 64, success=False))


def test_a_suite_without_a_measure_has_its_episodes_and_no_curve(trained):
    run = trained("run", evaluation={"episodes": 4, "support_draws": 2, "shots": (1,)})
    runner = LocalRunner(run.experiment.suite)
    found = run.experiment.evaluate(runner, run.demonstrations, run.checkpoint, run.folder, ["blue-green-red"])
    write_report(summarise(found, seconds={}, folder=run.folder), run.folder)
    section = failures_of_run(run)
    assert not [part for part in section.parts if isinstance(part, Picture)]
    assert "The suite does not measure how far an episode has come" in prose(section)[1]
    (table,) = [part for part in section.parts if isinstance(part, DataTable)]
    assert {row[3] for row in table.rows} <= {"yes", "no"}
    assert {tuple(row[5:]) for row in table.rows} == {("none", "", "", "", "")}


def test_with_videos_its_page_holds_films_that_play(with_rows, open_page):
    run = with_rows(lambda row: row.task == "door-close" and row.shots == 1, success=False)
    page = run.folder / "page.html"
    try:
        report.run(["run", str(run.folder), "--videos", "--output", str(page)])
    except RenderingError as error:
        pytest.skip(str(error))
    assert page.stat().st_size < MOST_BYTES
    opened = open_page(page)
    assert (opened.requests, opened.complaints, opened.faults()) == ([], [], [])
    assert opened.page.locator("h2", has_text="What failed").count() == 1
    (video,) = opened.page.locator("video").all()
    opened.page.wait_for_function("document.querySelector('video').readyState > 0")
    assert video.evaluate("v => [v.videoWidth, v.videoHeight, v.duration > 1]") == [492, 428, True]
    descriptions = [description for description, width, height in opened.pictures() if width > 300 and height > 60]
    assert any(words.startswith("door-close, 1-shot, episode") for words in descriptions), "the film says what it is"
    assert any(words.startswith("door-close, 1-shot: distance to the goal (m)") for words in descriptions)
    steps = [int(count) for count in opened.sorted_by("Episodes that were run again", "steps")]
    assert steps == sorted(steps)
    assert len(steps) == len(run.episodes)
    assert [path.suffix for path in (run.folder / "report" / "videos").iterdir()] == [".mp4"]
