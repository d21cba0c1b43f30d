"""What fails beside the work does not end the work, and no end loses the work."""

import io
import json
import os
import resource
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from dmil_core.files import DiskFullError
from services import meta_train
from services.cli import stopping, streams
from services.cli.arguments import exit_code
from services.distributed import metrics
from services.evaluation import evaluator
from services.experiments import meta_training
from services.reporting import run_report
from services.storage import replication, run_folders
from services.storage.checkpoints import Checkpoints
from tests.faults.conftest import SHORT, TOY


@pytest.fixture(autouse=True)
def heeded_signals():
    """Let signals be as a terminal leaves them: whoever runs the tests in the background may have them ignored."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL, signal.SIGTERM: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def names(folder: Path) -> list[str]:
    return [path.name for path in Checkpoints(folder / "checkpoints", 3).all()]


def ended_as(folder: Path) -> str:
    kind, value = json.loads((folder / "tracking.jsonl").read_text().splitlines()[-1])
    assert kind == "end"
    return value["status"]


class Gone(io.StringIO):
    """A stream whose reader has gone, or whose disk is full, after so many characters."""

    def __init__(self, characters: int = 0, error: type[Exception] = BrokenPipeError) -> None:
        super().__init__()
        self._left, self._error = characters, error

    def write(self, text: str) -> int:
        self._left -= len(text)
        if self._left < 0:
            raise self._error(28, "gone")
        return super().write(text)


@pytest.mark.parametrize("error", [BrokenPipeError, OSError, ValueError])
def test_a_run_whose_output_nobody_takes_trains_to_its_end(workplace, monkeypatch, error):
    complaints = io.StringIO()
    monkeypatch.setattr(sys, "stdout", Gone(300, error))
    monkeypatch.setattr(sys, "stderr", complaints)
    assert exit_code(meta_train.run, [*TOY, *SHORT, "--name", "run"]) == 0
    assert names(workplace / "runs" / "run")[-1] == "iteration-0000004"
    assert (workplace / "runs" / "run" / "summary.json").exists()
    assert complaints.getvalue().count("standard output takes no more text") == 1


def test_both_streams_may_be_gone(monkeypatch):
    monkeypatch.setattr(sys, "stdout", Gone())
    monkeypatch.setattr(sys, "stderr", Gone())
    assert exit_code(lambda arguments: print("text"), []) == 0


@pytest.mark.parametrize("command", ["{} | head -c 1", "{} >&-", "{} >/dev/full", "{} >&- 2>&- <&-"])
def test_streams_of_a_shell_end_nothing(tmp_path: Path, command: str):
    """Also where what is buffered is written at the end of the process, by Python itself."""
    program = (
        "from pathlib import Path\nimport sys\nfrom services.cli.arguments import exit_code\n"
        "def run(arguments):\n    [print('x' * 999) for _ in range(999)]\n    Path('done').touch()\n"
        "code = exit_code(run, [])\nPath('code').write_text(str(code))\nsys.exit(code)"
    )
    line = command.format(f"{shlex.quote(sys.executable)} -c {shlex.quote(program)}")
    environment = os.environ | {"PYTHONPATH": str(Path(streams.__file__).parents[2])}
    shell = subprocess.run(["bash", "-o", "pipefail", "-c", line], cwd=tmp_path, env=environment, check=False)
    assert shell.returncode == 0
    assert (tmp_path / "done").exists()


def test_text_that_a_stream_has_no_characters_for_is_escaped(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    assert exit_code(lambda arguments: print("naïve µm"), []) == 0
    out.flush()
    assert out.buffer.getvalue() == b"na\\xefve \\xb5m\n"  # type: ignore[attr-defined]


def test_a_page_that_cannot_be_drawn_is_told_and_the_run_ends_well(train, logged, monkeypatch):
    def fail(*arguments: object) -> None:
        raise ValueError("no font")

    monkeypatch.setattr(run_report, "write_page", fail)
    folder = train("run")
    assert ended_as(folder) == "FINISHED"
    assert (folder / "summary.json").exists()
    assert [line for line in logged() if "no font" in line] == [
        "the page failed (ValueError: no font); going on without it"
    ]


def test_metrics_that_ray_does_not_take_end_nothing(monkeypatch, logged):
    class Closed:
        def inc(self, *values: object) -> None:
            raise OSError("the port is taken")

        set = observe = inc

    monkeypatch.setattr(metrics, "_of_ray", lambda measure, suite: Closed())
    meter = metrics.RayMeter("toy")
    meter.record(metrics.CHECKPOINT_TIME, 1.0)
    assert logged() == ["Ray takes no metrics (OSError: the port is taken); going on without"]


@pytest.mark.parametrize(
    ("error", "code"),
    [(KeyboardInterrupt(), 130), (ArithmeticError("a bug"), None), (DiskFullError("elsewhere: full"), 1)],
    ids=["Ctrl-C", "an error of ours", "another disk"],
)
def test_whatever_ends_a_run_leaves_its_last_iteration(workplace, monkeypatch, capsys, error, code):
    add = meta_training.IterationLog.add

    def failing(log, iteration, metrics, device) -> None:
        add(log, iteration, metrics, device)
        if iteration == 3:
            raise error

    monkeypatch.setattr(meta_training.IterationLog, "add", failing)
    arguments = [*TOY, *SHORT, "--name", "a run's"]
    if code is None:
        with pytest.raises(ArithmeticError, match="a bug"):
            exit_code(meta_train.run, arguments)
    else:
        assert exit_code(meta_train.run, arguments) == code
    folder = workplace / "runs" / "a run's"
    assert names(folder)[-1] == "iteration-0000003"
    assert ended_as(folder) == ("KILLED" if code == 130 else "FAILED")
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "to go on: " in line]
    assert shlex.split(line.partition("to go on: ")[2]) == ["dmil", "meta-train", "--resume", "runs/a run's"]


def test_a_quota_that_demonstrations_do_not_fit_in_is_told(workplace, monkeypatch, capsys):
    monkeypatch.setenv("DMIL_DATA", "own")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, hard))
    try:
        assert exit_code(meta_train.run, [*TOY, *SHORT, "--name", "run"]) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "but a quota or ulimit -f allows less" in capsys.readouterr().err
    assert not list((workplace / "own").rglob("*.hdf5"))


def test_what_ends_a_start_has_taken_the_name_with_settings_to_go_on_with_or_not_at_all(workplace, monkeypatch, capsys):
    def stopped(*arguments: object) -> None:
        raise KeyboardInterrupt

    for module, function in ((run_folders, "create_file"), (replication, "claim_name")):
        with monkeypatch.context() as interrupted:
            interrupted.setattr(module, function, stopped)
            assert exit_code(meta_train.run, [*TOY, *SHORT, "--name", "run"]) == 130
    assert exit_code(meta_train.run, ["--resume", "run", "--runner", "local"]) == 0
    assert names(workplace / "runs" / "run")[-1] == "iteration-0000004"


@pytest.mark.parametrize("number", stopping.STOPS)
def test_each_signal_to_stop_leaves_a_checkpoint_also_when_it_comes_twice(workplace, monkeypatch, number):
    save, add = Checkpoints.save, meta_training.IterationLog.add

    def impatient(*arguments, **options) -> Path:
        signal.raise_signal(number)
        return save(*arguments, **options)

    def stopped(log, iteration, metrics, device) -> None:
        monkeypatch.setattr(Checkpoints, "save", impatient)
        add(log, iteration, metrics, device)
        signal.raise_signal(number)

    monkeypatch.setattr(meta_training.IterationLog, "add", stopped)
    assert exit_code(meta_train.run, [*TOY, *SHORT, "--name", "run"]) == 128 + number
    assert names(workplace / "runs" / "run") == ["iteration-0000001"]
    assert ended_as(workplace / "runs" / "run") == "KILLED"


def test_a_signal_that_comes_where_exceptions_are_ignored_is_not_lost(capsys):
    class Thing:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    def patient(arguments) -> None:
        thing = Thing()
        del thing
        signal.pause()
        raise AssertionError("not reached")

    assert exit_code(patient, []) == 143
    assert capsys.readouterr().err == ""


def test_a_third_signal_ends_at_once_and_an_ignored_one_is_ignored():
    def patient(arguments) -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)
            raise AssertionError("not reached")

    assert exit_code(patient, []) == 143
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        assert exit_code(lambda arguments: signal.raise_signal(signal.SIGHUP), []) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_stop_right_after_resuming_leaves_the_checkpoint_as_it_is(train, monkeypatch):
    folder = train("run")
    checkpoint = Checkpoints(folder / "checkpoints", 3).newest().path
    before = checkpoint.stat().st_ino, (checkpoint / "manifest.json").read_bytes()
    assert b'"loss": null' not in before[1]

    def stopped(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(meta_training, "iteration_metrics", stopped)
    with pytest.raises(KeyboardInterrupt):
        train("run", "--training.iterations", "9", resume=True)
    assert (checkpoint.stat().st_ino, (checkpoint / "manifest.json").read_bytes()) == before


def test_a_removed_folder_ends_the_run_in_a_line(workplace, monkeypatch, capsys):
    add = meta_training.IterationLog.add

    def removing(log, iteration, metrics, device) -> None:
        add(log, iteration, metrics, device)
        if iteration == 3:
            (workplace / "runs" / "run").rename(workplace / "moved")

    monkeypatch.setattr(meta_training.IterationLog, "add", removing)
    assert exit_code(meta_train.run, [*TOY, *SHORT, "--name", "run"]) == 1
    said = capsys.readouterr()
    assert "error: runs/run: got no such folder any more" in said.err
    assert "records wait" not in said.out + said.err, "they went with it"
    assert not (workplace / "runs" / "run").exists()


def test_a_folder_that_is_moved_away_amid_the_evaluation_is_not_made_anew(workplace, monkeypatch, capsys):
    rows = evaluator.Evaluator.evaluation

    def moving(*arguments):
        (workplace / "runs" / "run").rename(workplace / "moved")
        return rows(*arguments)

    monkeypatch.setattr(evaluator.Evaluator, "evaluation", moving)
    assert exit_code(meta_train.run, [*TOY, *SHORT, "--name", "run"]) == 1
    assert "error: runs/run: got no such folder any more" in capsys.readouterr().err
    assert not (workplace / "runs" / "run").exists()


def test_a_folder_that_is_moved_away_at_the_start_is_not_made_anew(workplace, monkeypatch, capsys):
    monkeypatch.setenv("DMIL_STORAGE", f"file://{workplace / 'bucket'}")
    monkeypatch.setattr(replication, "claim_name", lambda folder: folder.rename(workplace / "moved"))
    assert exit_code(meta_train.run, [*TOY, *SHORT, "--name", "run"]) == 1
    assert "error: runs/run: got no such folder any more" in capsys.readouterr().err
    assert not (workplace / "runs" / "run").exists()
