"""Success and loss over fine-tuning steps: measured once, by real episodes, and drawn as they were measured."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from dmil_core.errors import UserError
from services.distributed.ray_runner import open_runner
from services.distributed.runner import LocalRunner
from services.evaluation.results import EpisodeResult, ImitationResult, read_rows
from services.experiments.finished_run import FinishedRun
from services.reporting.adaptation_curves import adaptation_section, measure, points
from services.reporting.page import DataTable, Prose, write_page
from services.reporting.run_group import policy_after
from services.rollouts.adaptations import imitation_error

TASK = "blue-green-red"
Trained = Callable[..., FinishedRun]
SMALL = {"shots": (1, 3), "steps": (0, 2), "episodes": 2}


class Counting(LocalRunner):
    """Counts what it is asked for."""

    calls = 0

    def simulate(self, items):
        self.calls += len(items)
        return super().simulate(items)


def counting(run: FinishedRun) -> Counting:
    return Counting(run.experiment.suite)


def test_the_rows_are_those_of_policies_adapted_by_hand(trained: Trained):
    run = trained("run")
    plan = measure(run, counting(run), **SMALL)
    assert plan.tasks == (TASK,)
    held_out = run.experiment.held_out_sets(run.demonstrations)[TASK]
    for steps in (0, 2):
        folder = run.folder / "adaptation" / f"{steps:07d}"
        rows = read_rows(folder / "imitation.jsonl", ImitationResult)
        assert [(row.shots, row.draw) for row in rows] == [(1, 0), (1, 1), (3, 0), (3, 1)]
        for row in rows:
            support = [d for d in held_out if d.id in row.support]
            others = [d for d in held_out if d.id not in row.support]
            assert len(support) == row.shots
            assert (row.fine_tuning_steps, row.checkpoint, row.task) == (steps, run.checkpoint.digest, TASK)
            policy = policy_after(run, support, steps)
            assert row.support_error == pytest.approx(imitation_error(policy, support), rel=1e-5)
            assert row.held_out_error == pytest.approx(imitation_error(policy, others), rel=1e-5)
        assert len(read_rows(folder / "episodes.jsonl", EpisodeResult)) == 4


def test_fine_tuning_lowers_the_loss_on_the_support_set(trained: Trained):
    run = trained("run")
    measure(run, counting(run), shots=(3,), steps=(0, 50), episodes=1)
    before, after = points(run)
    assert before.support_error is not None
    assert after.support_error is not None
    assert after.support_error < before.support_error


def test_what_is_measured_is_not_measured_again(trained: Trained):
    run = trained("run")
    runner = counting(run)
    measure(run, runner, **SMALL)
    whole, first = points(run), runner.calls
    measure(run, runner, **SMALL)
    assert runner.calls == first
    (run.folder / "adaptation" / "0000002" / "imitation.jsonl").unlink()  # as though it was stopped there
    assert {point.steps for point in points(run)} == {0}
    assert "stopped before 2 steps" in text(run)
    measure(run, runner, **SMALL)
    assert runner.calls == first + first // 2
    assert points(run) == whole


def test_other_settings_are_measured_anew_and_no_others_shown(trained: Trained):
    run = trained("run")
    measure(run, counting(run), **SMALL)
    measure(run, counting(run), shots=(1,), steps=(2, 4), episodes=3)
    assert [(point.shots, point.steps, point.success.episodes) for point in points(run)] == [(1, 2, 3), (1, 4, 3)]


def test_only_sizes_that_are_held_out_and_that_the_method_takes_are_measured(trained: Trained):
    run = trained("run")
    assert measure(run, counting(run), steps=(0,), episodes=1).evaluation.shots == (1, 3, 5)
    assert "Not measured for 10 shots" in text(run)
    mil = trained("mil", "mil")
    sizes = measure(mil, counting(mil), steps=(0,), episodes=1).evaluation.shots
    assert sizes == tuple(size for size in (1, 3, 5) if size <= mil.config.method.model_dump()["shots"])
    with pytest.raises(UserError, match="shots: got 8, 10; wanted a size below the 8 held-out"):
        measure(run, counting(run), shots=(8, 10))
    with pytest.raises(UserError, match="tasks: got hand-insert; wanted some of the run's, red-green-blue"):
        measure(run, counting(run), tasks=["hand-insert"])


def test_steps_go_by_those_of_the_run(trained: Trained):
    run = trained("run", evaluation={"fine_tuning_steps": 30})
    assert measure(run, counting(run), shots=(1,), episodes=1).steps == (0, 3, 9, 30, 60)


def test_a_policy_that_has_diverged_has_no_loss(trained: Trained):
    run = trained("run", evaluation={"learning_rate": 1e30})
    measure(run, counting(run), shots=(1,), steps=(0, 5), episodes=1)
    before, after = points(run)
    assert before.held_out_error is not None
    assert (after.held_out_error, after.support_error, after.success.mean) == (None, None, 0)
    table = next(part for part in adaptation_section(run).parts if isinstance(part, DataTable))
    assert table.rows[1][-2:] == ["", ""]


def text(run: FinishedRun) -> str:
    return next(part.text for part in adaptation_section(run).parts if isinstance(part, Prose))


def test_the_section_shows_what_was_measured(trained: Trained, planar_visits: Path, open_page):
    run = trained("run")
    assert adaptation_section(run).parts == []
    measure(run, counting(run), **SMALL)
    section = adaptation_section(run)
    write_page(planar_visits / "page.html", "A run", [], [section])
    opened = open_page(planar_visits / "page.html")
    assert opened.requests == opened.complaints == opened.faults() == []
    ((words, width, height),) = opened.pictures()
    assert width > 300
    assert height > 100
    assert f"1-shot success {points(run)[0].success.mean:.2f} after 0 steps" in words
    texts = opened.page.locator("svg text").all_text_contents()
    assert {"1-shot", "3-shot", "success rate", "squared error of actions"} <= set(texts)
    table = "Success and loss over fine-tuning steps, all tasks together"
    assert opened.sorted_by(table, "fine-tuning steps") == ["0", "0", "2", "2"]
    own = [point.success for point in points(run)]
    cells = opened.page.get_by_role("table", name=table).locator("tbody td").all_inner_texts()
    assert all(f"{round(rate.mean * rate.episodes)} of {rate.episodes}" in cells for rate in own)


def test_a_damaged_plan_is_reported(trained: Trained):
    run = trained("run")
    measure(run, counting(run), shots=(1,), steps=(0,), episodes=1)
    plan = run.folder / "adaptation" / "plan.json"
    plan.write_text(json.dumps({**json.loads(plan.read_text()), "steps": "many"}))
    with pytest.raises(UserError, match=re.escape(f"{plan}: got ") + ".*remove it and measure again"):
        adaptation_section(run)


@pytest.mark.thorough
@pytest.mark.usefixtures("joined")
def test_ray_measures_the_same(trained: Trained):
    """On a suite that Ray's workers know too: one of ours."""
    tasks = {"train_tasks": ("reach",), "test_tasks": ("door-close",), "name": "ml10"}
    found = []
    for kind in ("local", "ray"):
        run = trained(kind, suite=tasks, demonstrations={"per_task": 5, "held_out": 3})
        with open_runner(kind, run.experiment.suite, 2 if kind == "ray" else None) as runner:
            measure(run, runner, shots=(1,), steps=(0, 2), episodes=1)
        found.append(points(run))
    assert found[0] == found[1]
