"""An episode follows from its row: it comes out again to the bit, or it is said why it cannot."""

import shutil
from pathlib import Path

import pytest

from dmil_core.errors import UserError
from services.evaluation.results import EpisodeResult, write_rows
from services.experiments.finished_run import FinishedRun
from services.experiments.replay import Replay, replaying
from services.rollouts.recording import VideoSettings
from services.suites.rendering import RenderingError


@pytest.fixture
def other_row(finished: FinishedRun, tmp_path: Path):
    """Return the run with other rows: those of the first adaptation, changed."""

    def change(**values: object) -> tuple[FinishedRun, EpisodeResult]:
        folder = tmp_path / "changed"
        shutil.copytree(finished.folder, folder)
        rows = [row.model_copy(update=values) for row in finished.episodes[:2]]
        write_rows(folder / "episodes.jsonl", rows)
        return FinishedRun(folder), rows[0]

    return change


def test_episodes_come_out_as_their_rows_say(finished: FinishedRun):
    rows = [row for row in finished.episodes if row.task in {"reach", "door-close"}]
    by_adaptation = {(row.split, row.task, row.shots, row.draw): row for row in rows}
    with replaying(finished) as replay:
        seen = [one for row in by_adaptation.values() for one in replay.rerun(row)]
    assert [one.row for one in seen] == rows
    assert [one.difference for one in seen] == [None] * len(seen)
    for one in seen:
        assert len(one.rollout) == one.row.steps
        assert one.rollout.seed == one.row.seed


def test_what_comes_out_otherwise_is_named(other_row):
    run, row = other_row(steps=299, success=True)
    with replaying(run) as replay:
        first, _ = replay.rerun(row)
    assert first.difference is not None
    assert first.difference.startswith(f"episode 0 of {row.task}, 1-shot: success False, where the run had True")


def test_only_what_is_to_be_filmed_is_filmed(finished: FinishedRun):
    row, camera = finished.episodes[0], finished.experiment.suite.camera  # type: ignore[attr-defined]
    with replaying(finished) as replay:
        try:
            filmed, unfilmed = replay.rerun(row, VideoSettings(camera, 100, 48, 64), [row.episode])
        except RenderingError as error:
            pytest.skip(str(error))
    assert [frame.step for frame in filmed.recording.frames][:2] == [0, 100]
    assert unfilmed.recording.frames == []


def test_its_demonstration_is_the_one_that_was_adapted_to(finished: FinishedRun):
    row, camera = finished.episodes[0], finished.experiment.suite.camera  # type: ignore[attr-defined]
    with replaying(finished) as replay:
        try:
            demonstration, recording = replay.demonstration(row, VideoSettings(camera, 100, 48, 64))
        except RenderingError as error:
            pytest.skip(str(error))
    assert demonstration.id == row.support[0]
    assert recording.frames[-1].step == len(demonstration)


@pytest.mark.parametrize(
    ("field", "wrong", "words"),
    [
        ("checkpoint", "f" * 64, "checkpoint: got rows of ffffffffffff; wanted those of"),
        ("data", "e" * 64, "got demonstrations with the SHA-256"),
    ],
)
def test_an_episode_of_something_else_is_refused(other_row, field: str, wrong: str, words: str):
    run, row = other_row(**{field: wrong})
    with pytest.raises(UserError, match=words):
        Replay(run).rerun(row)
