"""`report video` films the episode that is asked for, and says what it does not have."""

from pathlib import Path

import imageio.v3 as imageio
import pytest

from services import report
from services.experiments.finished_run import FinishedRun
from services.reporting.film import FORMS
from services.suites.rendering import RenderingError


@pytest.mark.thorough
def test_a_film_of_an_episode_beside_what_it_was_adapted_to(finished: FinishedRun, tmp_path: Path, capsys):
    path = tmp_path / "film.gif"
    arguments = ["--task", "door-close", "--shots", "2", "--episode", "1", "--demonstration"]
    try:
        report.run(["video", str(finished.folder), *arguments, "--format", "gif", "--output", str(path)])
    except RenderingError as error:
        pytest.skip(str(error))
    printed = capsys.readouterr().out
    (row,) = [row for row in finished.episodes if (row.task, row.shots, row.episode) == ("door-close", 2, 1)]
    ending = f"{'solved' if row.success else 'not solved'} in {row.steps} steps"
    assert f"door-close, 2-shot, episode 1: {ending}" in printed
    assert "warning" not in printed, "it came out as in the run"
    pictures, _, width, _ = imageio.imread(path, index=None).shape
    assert pictures > 10
    assert width >= 2 * FORMS["gif"].width


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--task", "pie"], "--task: got 'pie'; wanted one of tiny's: reach, push, drawer-close, door-close"),
        (["--task", "reach", "--shots", "3"], "--shots: got 3; tiny was evaluated with 1, 2"),
        (["--task", "reach", "--episode", "2"], "--episode: got 2; wanted one from 0 to 1"),
        (["--task", "reach", "--output", "film.gif"], "--output: got film.gif; wanted a name that ends in .mp4"),
    ],
)
def test_what_the_run_does_not_have_is_reported_in_words(finished: FinishedRun, complaint, arguments, words: str):
    assert words in complaint(report.run, "video", str(finished.folder), *arguments)
