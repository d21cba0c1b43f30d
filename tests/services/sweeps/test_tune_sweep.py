"""Sweeps as a user runs them: real Tune, real MLflow, real deaths."""

import json
import signal
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import psutil
import pytest
import yaml
from mlflow import MlflowClient
from mlflow.entities import Run

from dmil_core.checkpoint import Checkpoint
from dmil_core.configs import ExperimentConfig
from services import tune_sweep
from services.demonstrations.store import TaskDemonstrations, open_store
from services.distributed.ray_runner import open_runner
from services.experiments.experiment import Experiment
from services.storage.checkpoints import Checkpoints
from services.sweeps.folders import SweepFolder
from services.tracking.tracker import Tracker

EVALUATION = {"episodes": 1, "fine_tuning_steps": 1}


def write_sweep(variants: dict[str, object], **changes: object) -> str:
    """Write a small sweep in the working directory."""
    settings = {
        "what": "a test", "suites": ["ml10"], "seeds": [0], "variants": variants, "shots": [1],
        "settings": {"training": {"iterations": 20, "checkpoint_every": 5}, "evaluation": EVALUATION}, **changes,
    }  # fmt: skip
    Path("small.yaml").write_text(yaml.safe_dump(settings, allow_unicode=True))
    return "small.yaml"


def steps_of(uri: str, run: Run, metric: str) -> list[int]:
    return sorted(point.step for point in MlflowClient(uri).get_metric_history(run.info.run_id, metric))


@pytest.mark.thorough
@pytest.mark.usefixtures("one_at_a_time")
def test_a_killed_sweep_goes_on_where_it_was(
    programs, workplace: Path, mlflow_file: str, runs_of, wait_for, data: dict[str, TaskDemonstrations]
) -> None:
    """A finished trial stays, one under way goes on from its checkpoint to the same bits, MLflow holds each once."""
    trained = {"training": {"iterations": 20, "checkpoint_every": 5}}
    variants = {"first": {"method": {"name": "nearest-neighbour"}}, "second": trained}
    file = write_sweep(variants, settings={"evaluation": EVALUATION})
    program = programs.start("tune_sweep", file, "--preset", "smoke", "--name", "killed")
    folder = workplace / "runs" / "killed"

    def one_is_over_and_the_other_under_way() -> bool:
        return program.poll() is not None or any(folder.parent.glob("trained/*/checkpoints/iteration-*[1-9]*"))

    wait_for(one_is_over_and_the_other_under_way, "two trials")
    assert program.poll() is None, program.communicate()[0]
    program.kill()
    program.communicate()
    ((over, written),) = ((path, path.stat().st_mtime_ns) for path in folder.glob("trials/*/result.json"))
    assert "first" in over.parent.name

    code, printed = programs("tune_sweep", "--resume", "killed")
    assert code == 0, printed
    assert over.stat().st_mtime_ns == written
    sweep = SweepFolder(folder)
    (name,) = (name for name in sweep.trials if name != over.parent.name)
    result, seen = sweep.result(name), folder / "trials" / name / "log.txt"
    assert result is not None
    assert result.status == "finished"
    went_on = sweep.runs / str(result.trained)
    assert seen.read_text().count("checkpoint: ") in (3, 4), "none was written twice"
    np.testing.assert_array_equal(
        newest(went_on).state.parameters, undisturbed(sweep.trials[name].config, data, workplace / "alone")
    )
    parent, children = runs_of(mlflow_file, folder)
    assert parent.info.status == "FINISHED"
    assert sorted(str(child.info.run_name) for child in children) == sorted(sweep.trials)
    assert {child.info.status for child in children} == {"FINISHED"}
    (child,) = (child for child in children if child.info.run_name == name)
    assert steps_of(mlflow_file, child, "gradient_norm") == list(range(1, 21))


def newest(home: Path) -> Checkpoint:
    return Checkpoints(home / "checkpoints", 1).newest()


def undisturbed(config: ExperimentConfig, data: dict[str, TaskDemonstrations], folder: Path) -> np.ndarray:
    """Return the parameters that the configuration has when it is trained in this process."""
    folder.mkdir(parents=True)
    experiment = Experiment(config, open_store())
    tracker = Tracker(folder, "alone")
    with open_runner("local", experiment.suite, None) as runner:
        checkpoint = experiment.train(runner, data, Checkpoints(folder / "checkpoints", 1), tracker)
    tracker.close("FINISHED")
    return checkpoint.state.parameters


def named(processes: Iterable[psutil.Process], name: str) -> list[psutil.Process]:
    found = []
    for process in processes:
        try:
            if " ".join(process.cmdline()).startswith(name):
                found.append(process)
        except psutil.Error:
            continue
    return found


@pytest.mark.thorough
def test_a_trial_that_fails_or_dies_leaves_the_others_alone(
    programs, workplace: Path, mlflow_file: str, runs_of, wait_for, joined
) -> None:
    """One has an error, which is reported; one loses its process, and is begun again; two of three CPUs for each."""
    variants = {"good": {}, "hasty": {"training": {"learning_rate": 1e30}}}
    file = write_sweep(variants, resources={"workers": 2})
    program = programs.start("tune_sweep", file, "--preset", "smoke", "--name", "hurt")
    folder = workplace / "runs" / "hurt"
    wait_for(
        lambda: program.poll() is not None or any(folder.parent.glob("trained/*/checkpoints/iteration-*")),
        "a trial",
    )
    trials = named(psutil.Process(joined.head).children(recursive=True), "ray::ImplicitFunc")
    assert trials
    for process in trials:
        process.send_signal(signal.SIGKILL)
    printed, _ = program.communicate()
    assert program.returncode == 1, printed
    assert "1 of 2 trials failed" in printed
    assert "ml10-hasty-seed-0: iteration" in printed
    assert "is not finite" in printed
    assert "Traceback" not in printed
    assert "its process ended; it is begun again" in printed
    tables = json.loads((folder / "tables" / "tables.json").read_text())
    assert tables["trials"] == {"finished": 1, "failed": 1}
    assert {cell["row"] for cell in tables["cells"]} == {"good"}
    _, children = runs_of(mlflow_file, folder)
    assert {child.data.tags["variant"]: child.info.status for child in children} == {
        "good": "FINISHED",
        "hasty": "FAILED",
    }
    assert "is not finite" in next(child.data.tags["error"] for child in children if child.info.status == "FAILED")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "SWEEP: got none; wanted a file"),
        (["nope"], "SWEEP: got nope"),
        (["em", "--suites", "ml11"], "suite.name: got ml11"),
        (["em", "--seeds", "0", "0"], "--seeds: got 0 0; wanted each once"),
        (["em", "--seeds", "-1"], "--seeds.0: got -1"),
        (["--resume", "nope"], "--resume: got 'nope'"),
        (["em", "--resume", "nope"], "--resume: got SWEEP"),
        (["em", "--name", "a/b"], "--name: got 'a/b'"),
    ],
)
@pytest.mark.usefixtures("workplace")
def test_mistakes_are_reported(complaint, arguments: list[str], message: str) -> None:
    assert message in complaint(tune_sweep.run, *arguments)
    assert not Path("runs").exists()


@pytest.mark.usefixtures("workplace")
def test_a_mistake_in_a_file_is_reported_with_its_place(complaint) -> None:
    file = write_sweep({"one": {"method": {"sub_skill": 3}}})
    assert "variants.one: got the unknown key method.sub_skill" in complaint(tune_sweep.run, file)
    Path(file).write_text("what: [")
    assert "small.yaml" in complaint(tune_sweep.run, file)
    file = write_sweep({})
    assert f"{file}: " in complaint(tune_sweep.run, file)
