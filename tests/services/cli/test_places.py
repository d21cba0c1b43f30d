"""Where results will lie: printed before the work begins, and refused where they would go with a Ray cluster."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from dmil_core.errors import UserError
from services import collect_demos, meta_train, tune_sweep
from services.cli.places import announce

SESSION = "ray/session_2026-11-30_07-00-00_123456_99"
PACKAGE = f"{SESSION}/runtime_resources/working_dir_files/_ray_pkg_0123456789abcdef"
SHORT = ("--runner", "local", "--preset", "ml10-smoke")


@pytest.mark.parametrize("inside", [PACKAGE, f"{SESSION}/logs", "moved/runtime_resources/py_modules_files/_ray_pkg_1"])
def test_ray_s_own_folder_is_known_wherever_it_lies_and_through_links(tmp_path: Path, inside: str):
    (tmp_path / inside).mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / inside)
    for folder in (tmp_path / inside, tmp_path / inside / "runs", tmp_path / "link" / "runs"):
        with pytest.raises(UserError, match=r"^run: got .*; Ray deletes that .* --runs FOLDER; a job "):
            announce(run=(folder, "--runs FOLDER"), demonstrations=(tmp_path, "DMIL_DATA=FOLDER"))


def test_other_folders_are_printed_as_absolute_paths(tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]):
    deep = tmp_path / "sessions" / "[red]runtime_resources"
    deep.mkdir(parents=True)
    monkeypatch.chdir(deep)
    announce(run=(Path("runs/x"), "--runs FOLDER"), MLflow=(None, "MLFLOW_TRACKING_URI=sqlite:///FILE"))
    assert capsys.readouterr().out == f"run: {deep}/runs/x\n"


@pytest.mark.parametrize(
    ("program", "arguments", "places"),
    [
        (
            meta_train.run,
            SHORT,
            ("run: got ", "demonstrations: got ", "MLflow: got ", " --runs FOLDER DMIL_DATA=FOLDER "),
        ),
        (tune_sweep.run, ("em", "--preset", "smoke"), ("sweep: got ", "demonstrations: got ", "MLflow: got ")),
        (collect_demos.run, SHORT, ("demonstrations: got ", ", with absolute paths, DMIL_DATA=FOLDER; a job is given")),
    ],
)
def test_a_job_s_results_are_not_left_in_its_package(
    program: Callable[[Sequence[str]], None], arguments: tuple[str, ...], places: tuple[str, ...],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, complaint,
):  # fmt: skip
    (tmp_path / PACKAGE).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / PACKAGE)
    printed = complaint(program, *arguments)
    for words in places:
        assert words in printed
    assert list(Path().iterdir()) == []
