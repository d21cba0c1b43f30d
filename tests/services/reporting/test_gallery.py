"""The gallery shows each task of a suite."""

from pathlib import Path

import pytest
from PIL import Image

from dmil_core.configs import PRESETS, SuiteConfig
from services import report
from services.report_gallery import SUITES, run
from services.reporting.gallery import draw_gallery
from services.suites.registry import open_suite
from services.suites.rendering import RenderingError


def test_the_gallery_has_a_picture_for_each_task(tmp_path: Path):
    sizes = []
    for tasks in (("reach",), ("reach", "drawer-close", "door-open")):
        suite = open_suite(SuiteConfig(train_tasks=tasks, test_tasks=tasks[-1:]))
        path = tmp_path / f"{len(tasks)}.jpg"
        try:
            draw_gallery(suite, suite.camera, 0, path, columns=2)  # type: ignore[attr-defined]
        except RenderingError as error:
            pytest.skip(str(error))
        with Image.open(path) as drawn:
            sizes.append(drawn.size)
            assert len(drawn.getcolors(2**24) or []) > 500, "a robot at a table has many colours"
    (one, two), (wide, high) = sizes
    assert wide == one
    assert high == pytest.approx(2 * two, abs=2)


def test_it_covers_the_suites_that_have_presets():
    assert {f"{suite}-quick" for suite in SUITES} == {name for name in PRESETS if name.endswith("-quick")} - {
        "kitchen-quick"  # another name of kitchen-topburner
    }


@pytest.mark.parametrize(("name", "task"), [("push-around-wall", "push-around-wall"), ("kitchen-slide", "light")])
def test_every_kind_of_robot_can_be_drawn(tmp_path: Path, name: str, task: str):
    suite = open_suite(SuiteConfig(name=name, train_tasks=(task,), test_tasks=(task,)))
    path = tmp_path / "one.jpg"
    try:
        draw_gallery(suite, suite.camera, 0, path, columns=1)  # type: ignore[attr-defined]
    except RenderingError as error:
        pytest.skip(str(error))
    with Image.open(path) as drawn:
        assert len(drawn.getcolors(2**24) or []) > 500


def test_each_suite_that_is_named_has_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    try:
        run(["--suites", "ML1-reach", "--output", str(tmp_path / "made")])
    except RenderingError as error:
        pytest.skip(str(error))
    assert str(tmp_path / "made" / "ML1-reach.jpg") in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "made").iterdir()] == ["ML1-reach.jpg"]


def test_the_program_says_what_it_draws(capsys: pytest.CaptureFixture[str]):
    report.run(["--help"])
    assert "gallery     Draw the tasks of every suite" in capsys.readouterr().out


def test_a_report_that_there_is_not_is_reported_in_words(complaint):
    assert "report: got pie; wanted one of run" in complaint(report.run, "pie")
    assert "report: got nothing" in complaint(report.run)
    assert "suite.name: got atari" in complaint(report.run, "gallery", "--suites", "atari")
