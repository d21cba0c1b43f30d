"""An episode of a finished run as a film shows it, and the command that films it."""

from dmil_core.errors import UserError
from dmil_core.settings import sub_skills_of
from services.evaluation.results import EpisodeResult
from services.experiments.finished_run import FinishedRun
from services.experiments.replay import ReplayedEpisode
from services.reporting.film import Side, filmed
from services.suites.rendering import View


def name_of(row: EpisodeResult) -> str:
    """Return what a file about an episode is named."""
    return f"{row.task}-{row.shots}-shot-episode-{row.episode}"


def command(finished: FinishedRun, row: EpisodeResult) -> str:
    """Return the command line that films an episode."""
    return f"dmil report video {finished.folder} --task {row.task} --shots {row.shots} --episode {row.episode}"


def camera_of(finished: FinishedRun) -> str | View:
    """Return the camera of a run's suite.

    Raises:
        UserError: if it names none.
    """
    suite = finished.experiment.suite
    camera: str | View | None = getattr(suite, "camera", None)
    if camera is None:
        raise UserError(
            f"suite: got {suite.name}, which names no camera; wanted one whose tasks can be drawn; give it a camera if "
            "its environments are MuJoCo's: docs/your-own-task.md"
        )
    return camera


def side_of(finished: FinishedRun, replayed: ReplayedEpisode) -> Side:
    """Return an episode of a run as a film shows it."""
    row, best, sub_skills = replayed.row, finished.experiment.suite.best_score, sub_skills_of(finished.config.method)
    title = f"{row.task}, {row.shots}-shot, episode {row.episode}"
    return filmed(title, replayed.rollout, replayed.recording.frames, best, sub_skills)
