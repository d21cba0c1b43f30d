"""Faults that were put into the code once, and that no test noticed: each has a test that sees it."""

import os
import re
import shlex
import sys
import time
from collections import Counter
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import requests
from ray._common.usage.usage_lib import UsageReportClient, _usage_stats_report_url, generate_disabled_report_data

from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.outer_loop import tasks_of
from services import local_cluster
from services.demonstrations.external import ExternalEpisode
from services.distributed import cluster
from services.distributed.calls import Call, DeadlyCallError
from services.distributed.ray_meta_training import MAX_SUSPICIONS, RayMetaTraining
from services.distributed.ray_runner import try_again
from services.distributed.runner import LocalRunner, Plan
from services.distributed.stragglers import Timeouts
from services.evaluation.paper_results import figure_of
from services.evaluation.results import AdaptationResult, read_rows
from services.experiments.finished_run import FinishedRun
from services.inspect_demos import _problems
from services.reporting import comparison_pictures
from services.storage import replication
from services.storage.remote import STORAGE
from services.suites.base import Split
from tests.faults.conftest import SHORT

PROJECT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("suite", "figures"), [("ml10", (0.775, 0.949, 0.396, 0.71)), ("ml45", (0.59, 0.859, 0.376, 0.64))]
)
def test_the_published_figures_of_table_4_are_those_of_the_paper(suite: str, figures: tuple[float, ...]):
    splits: tuple[Split, ...] = ("meta-training", "meta-testing")
    found = [figure_of(DmilConfig(), suite, split, shots) for split in splits for shots in (1, 3)]
    assert tuple(figure.value for figure in found if figure is not None) == figures


def lines_of(page: str) -> Iterator[list[str]]:
    """Yield the words of each line in a page's blocks of shell that calls a program of ours."""
    for block in re.findall(r"```bash\n(.*?)```", (PROJECT / page).read_text(), re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["dmil"]:
                yield [words[1].replace("-", "_"), *words[2:]]
            elif words[:2] == ["python", "-m"] and words[2].startswith("services."):
                yield [words[2].removeprefix("services."), *words[3:]]


@pytest.mark.thorough
def test_the_page_on_one_s_own_task_works_as_it_stands(tmp_path: Path, mlflow_file: str, monkeypatch):
    page = (PROJECT / "docs" / "your-own-task.md").read_text()
    example = PROJECT / "docs" / "examples" / "planar_visits"
    information = tmp_path / "lib" / "planar_visits-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: planar-visits\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[dmil.suites]\nplanar-visits = planar_visits:PlanarVisits\n")
    monkeypatch.syspath_prepend(tmp_path / "lib")
    monkeypatch.syspath_prepend(example)
    monkeypatch.delitem(sys.modules, "planar_visits", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DMIL_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    (block,) = [block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "np.savez" in block]
    exec(compile(block, "your-own-task.md", "exec"), {})
    done = Counter()
    after = page[page.index('np.savez("mine.npz"') :]
    (tmp_path / "after.md").write_text(after)
    for program, *arguments in lines_of(os.path.relpath(tmp_path / "after.md", PROJECT)):
        short = [*SHORT, "--name", f"run-{done['meta_train']}"] if program == "meta_train" else []
        short += ["--runner", "local"] if program == "meta_train" and "--runner" not in arguments else []
        import_module(f"services.{program}").run([*arguments, *short])
        done[program] += 1
    assert done == {"collect_demos": 2, "meta_train": 2}


def test_inspect_tells_an_episode_without_a_success():
    draw = np.random.default_rng(0)
    states, actions = draw.normal(size=(3, 5, 4)).astype("f4"), draw.uniform(-1, 1, (3, 5, 2)).astype("f4")
    episodes = [ExternalEpisode(states[i], actions[i], None, success) for i, success in enumerate((True, False, None))]
    assert [problem.words for problem in _problems(episodes, None)] == ["episode 1: no step is a success"]


def test_a_resumed_run_goes_on_from_where_it_was(train, monkeypatch):
    began: list[int] = []
    meta = LocalRunner.meta_train

    def noted(runner: LocalRunner, plan: Plan):
        began.append(plan.state.iteration)
        return meta(runner, plan)

    monkeypatch.setattr(LocalRunner, "meta_train", noted)
    train("run")
    train("run", "--training.iterations", "6", resume=True)
    assert began == [0, 4]


def test_the_use_of_sub_skills_is_counted_on_what_was_not_adapted_to(train):
    folder = train("run")
    finished = FinishedRun(folder)
    held_out = finished.experiment.held_out_sets(finished.demonstrations)
    for row in read_rows(folder / "adaptations.jsonl", AdaptationResult):
        others = [demonstration for demonstration in held_out[row.task] if demonstration.id not in row.support]
        assert len(others) == len(held_out[row.task]) - row.shots
        assert row.steps == sum(map(len, others))


def test_tasks_of_a_batch_are_drawn_in_one_order():
    assert list(tasks_of(0, list("abcde"), 0, 5)) == ["c", "b", "e", "a", "d"]
    assert list(tasks_of(7, list("abcde"), 3, 3)) == ["c", "b", "a"]


def test_a_run_is_copied_while_it_goes_on(train, tmp_path: Path, monkeypatch):
    assert replication.SECONDS == 10, "as docs/deploy.md says"
    monkeypatch.setattr(replication, "SECONDS", 0.05)
    folder = train("run")
    monkeypatch.setenv(STORAGE, (tmp_path / "storage").as_uri())
    with replication.replicated(folder):
        while not (tmp_path / "storage" / "runs" / "run" / "mlflow_run.json").exists():
            time.sleep(0.05)


def test_a_run_s_own_ray_has_a_token_and_sends_no_statistics(monkeypatch):
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_USAGE_STATS_ENABLED"):
        monkeypatch.setenv(name, "")  # so that it is put back
        monkeypatch.delenv(name)
    cluster._secure_local_cluster()
    assert os.environ["RAY_AUTH_MODE"] == "token"
    assert len(os.environ["RAY_AUTH_TOKEN"]) == 64
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
    assert local_cluster.OURS["RAY_USAGE_STATS_ENABLED"] == "0"


def test_ray_in_a_cluster_of_ours_cannot_even_report_that_it_reports_nothing(monkeypatch):
    for name, value in local_cluster.OURS.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(requests.exceptions.MissingSchema):
        UsageReportClient().report_usage_data(_usage_stats_report_url(), generate_disabled_report_data())


def test_a_job_that_is_stopped_has_time_for_its_checkpoint():
    assert int(local_cluster.OURS["RAY_JOB_STOP_WAIT_TIME_S"]) >= 60


def call(method: str = "gradient", actor: object = None) -> Call:
    return Call(0, method, (), 1, None, actor, "a call")


def test_a_call_is_slow_after_ten_times_the_median_and_not_before_the_bounds():
    timeouts = Timeouts()
    assert timeouts.seconds(call()) == 60
    for seconds in (0.5, 1.0, 90.0):
        timeouts.record(call(), seconds)
    assert timeouts.seconds(call()) == 10
    for seconds in (0.01, 0.01, 0.01):
        timeouts.record(call("add"), seconds)
        timeouts.record(call("step"), seconds)
    assert timeouts.seconds(call("add")) == 2
    assert timeouts.seconds(call("step", actor=object())) == 30, "the learner"


def test_suspicion_ends():
    deadly = DeadlyCallError(call())
    training = SimpleNamespace(_suspicions=Counter({0: MAX_SUSPICIONS}))
    with pytest.raises(DeadlyCallError):
        RayMetaTraining._examine_slots(training, deadly)  # type: ignore[arg-type]
    retried: list[Call] = []
    pool, suspects = SimpleNamespace(retry=retried.append), set[int]()
    try_again(pool, deadly, suspects)  # type: ignore[arg-type]
    assert retried == [deadly.call]
    with pytest.raises(DeadlyCallError):
        try_again(pool, deadly, suspects)  # type: ignore[arg-type]


def test_a_heat_map_s_colours_get_lighter_with_the_value():
    colours = comparison_pictures.COLOURS(np.linspace(0, 1, 21))[:, :3]
    lightness = colours @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(lightness) > 0).all()
    assert comparison_pictures.COLOURS.name.startswith("cividis")
