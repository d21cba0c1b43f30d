"""What the high level chooses, and the pictures and tables of it, on a suite whose episodes take no time."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dmil_core.errors import UserError
from dmil_core.methods.base import FineTuning
from services import report_sub_skills
from services.distributed.runner import LocalRunner
from services.evaluation.results import EpisodeResult, read_rows
from services.experiments.finished_run import FinishedRun
from services.reporting.choices import DEMONSTRATIONS, ROLLOUTS, Choices, Timeline, choices_on
from services.reporting.drawing import COLOURS, Picture, colour_of, ink_on
from services.reporting.page import DataTable
from services.reporting.run_group import group_runs, policies
from services.reporting.sub_skill_pictures import draw_timelines, draw_transitions, draw_usage
from services.reporting.sub_skills import sub_skill_sections

TASK = "blue-green-red"
Trained = Callable[..., FinishedRun]


def made_up(run: str = "DMIL", sub_skills: int = 3) -> list[Choices]:
    """Return what a run might choose: sub-skill 1 alone before adaptation, then 0 and 2 in turn."""
    before, after = np.full(40, 1), np.repeat([0, 2], [10, 30])
    return [
        Choices(run, adaptation, sub_skills, {DEMONSTRATIONS: [Timeline("080", chosen)], ROLLOUTS: []})
        for adaptation, chosen in (("before", before), ("after", after))
    ]


def colours_in(svg: str) -> set[str]:
    return set(re.findall(r"#[0-9a-f]{6}", svg)) & set(COLOURS)


@pytest.mark.parametrize("method", ["dmil", "option-gail-offline", "option-gail", "mlsh"])
def test_every_method_with_sub_skills_has_a_policy_before_adaptation(trained: Trained, method: str):
    run = trained("run", method)
    group = group_runs({"run": run})
    support, others = group.shots(TASK, 1)
    parameters = {name: array.copy() for name, array in run.checkpoint.parameters.items()}
    before, after = policies(run, support).values()
    for policy in (before, after):
        for other in others:
            chosen = policy.sub_skill_use(other).chosen
            assert chosen.shape == (len(other),)
            assert set(chosen.tolist()) <= set(range(3))
    first = np.stack([other.observations[0] for other in others])
    acted = [policy.act(first, policy.start(len(first))).actions for policy in (before, after)]
    assert np.isfinite(acted[0]).all()
    if method != "mlsh":  # whose sub-skills stay as they are
        assert not np.array_equal(acted[0], acted[1])
    assert all(np.array_equal(run.checkpoint.parameters[name], parameters[name]) for name in parameters)


def test_before_adaptation_it_is_the_meta_trained_policy_itself(trained: Trained):
    run = trained("run")
    support, others = group_runs({"run": run}).shots(TASK, 1)
    experiment = run.experiment
    method = experiment.method(experiment.training_sets(run.demonstrations))
    parameters = experiment.initial_parameters(method)
    for name, array in run.checkpoint.parameters.items():
        parameters[name].numpy()[...] = array  # type: ignore[index]
    wanted = method.adapt(parameters, support, FineTuning(0, 1.0))
    found = policies(run, support)["before"]
    assert all(
        np.array_equal(found.sub_skill_use(other).chosen, wanted.sub_skill_use(other).chosen) for other in others
    )


def test_rollouts_are_episodes_of_the_evaluation(trained: Trained, tmp_path: Path):
    run = trained("run", evaluation={"episodes": 4, "support_draws": 2, "shots": (1,)})
    run.experiment.evaluate(LocalRunner(run.experiment.suite), run.demonstrations, run.checkpoint, tmp_path / "rows")
    rows = read_rows(tmp_path / "rows" / "episodes.jsonl", EpisodeResult)
    evaluated = [row for row in rows if row.task == TASK and row.draw == 0]
    _, after = choices_on(group_runs({"run": run}), TASK, 1, 2)
    drawn = after.timelines[ROLLOUTS]
    assert [timeline.name.split()[0] for timeline in drawn] == [str(row.episode) for row in evaluated] == ["0", "2"]
    assert [timeline.name.endswith("solved") for timeline in drawn] == [row.success for row in evaluated]
    for timeline, row in zip(drawn, evaluated, strict=True):
        assert np.bincount(timeline.sub_skills).tolist() == list(row.sub_skill_steps)


def test_what_is_adapted_to_is_not_looked_at(trained: Trained):
    run = trained("run")
    group = group_runs({"run": run})
    support, others = group.shots(TASK, 3)
    held_out = [demonstration.id for demonstration in group.held_out[TASK]]
    assert [d.id for d in support] + [d.id for d in others] == held_out
    assert len(held_out) == 8
    with pytest.raises(UserError, match="got 8; wanted fewer than the 8 held-out"):
        group.shots(TASK, 8)


def test_a_policy_that_has_diverged_has_no_rollouts_and_the_page_says_so(trained: Trained):
    run = trained("run", evaluation={"learning_rate": 1e30})
    group = group_runs({"run": run})
    (section,) = sub_skill_sections(group, rollouts=1)
    assert choices_on(group, TASK, 1, 1)[1].timelines[ROLLOUTS] == []
    pictures = [part for part in section.parts if isinstance(part, Picture)]
    assert any("the policy has diverged" in picture.svg for picture in pictures)


def test_methods_without_sub_skills_get_no_section(trained: Trained):
    group = group_runs({"flat": trained("flat", "behaviour-cloning"), "one": trained("one", method={"sub_skills": 1})})
    assert sub_skill_sections(group) == []


def test_timelines_have_colours_numbers_and_names_of_both_adaptations():
    picture = draw_timelines("t", made_up(), DEMONSTRATIONS, 3)
    assert colours_in(picture.svg) == {colour_of(k) for k in range(3)}
    texts = re.findall(r">([^<>]+)</text>", picture.svg)
    assert {"DMIL, before adaptation", "DMIL, after adaptation", "080", "step", "sub-skill 2"} <= set(texts)
    assert texts.count("080") == 2
    assert "DMIL after adaptation: sub-skill 0 25%, sub-skill 2 75% of the steps of 1 " in picture.description
    assert "1.0 switches in each" in picture.description


def test_runs_stand_side_by_side_and_keep_their_colours():
    picture = draw_timelines("t", [*made_up("High"), *made_up("Low", 5)], DEMONSTRATIONS, 3)
    for name in ("High", "Low"):
        assert f"{name}, before adaptation" in picture.svg
    assert colours_in(picture.svg) == {colour_of(k) for k in range(5)}


def test_many_switches_make_no_large_picture():
    shown = [
        Choices(run, adaptation, 3, {DEMONSTRATIONS: [Timeline("0", np.arange(300) % 3)] * 3})
        for run in ("a", "b")
        for adaptation in ("before", "after")
    ]
    assert len(draw_timelines("t", shown, DEMONSTRATIONS, 3).svg) < 800_000


def test_usage_and_transitions_are_reported_in_numbers():
    use = draw_usage("t", made_up(), [DEMONSTRATIONS, ROLLOUTS])
    assert "DMIL after adaptation in held-out demonstrations: sub-skill 0 25%, sub-skill 2 75%" in use.description
    assert "DMIL, before, demonstrations" in use.svg
    assert "rollouts" not in use.svg
    transitions = draw_transitions("t", made_up(), DEMONSTRATIONS)
    assert {"0.90", "0.10", "1.00", "–"} <= set(re.findall(r">([^<>]+)</text>", transitions.svg))


def test_numbers_are_legible_on_every_colour():
    def luminance(colour: str) -> float:
        parts = [int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5)]
        linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
        return float(np.dot([0.2126, 0.7152, 0.0722], linear))

    for colour in COLOURS:
        under, over = luminance(colour), {"#000000": 0.0, "#ffffff": 1.0}[ink_on(colour)]
        assert (max(under, over) + 0.05) / (min(under, over) + 0.05) >= 4.5


def test_tables_hold_what_the_pictures_show(trained: Trained):
    group = group_runs({"A": trained("run"), "B": trained("other", method={"sub_skills": 5})})
    (section,) = sub_skill_sections(group, rollouts=2)
    use, transitions = (part for part in section.parts if isinstance(part, DataTable))
    assert len(use.rows) == 8
    for row in use.rows:
        own = [float(share) for share in row[6:11] if share]
        assert len(own) == {"A": 3, "B": 5}[str(row[0])]
        assert sum(own) == pytest.approx(1, abs=0.01)
        counts = [r[4:] for r in transitions.rows if r[:3] == row[:3]]
        assert sum(int(n) for r in counts for n in r if n != "") == int(row[4]) - int(row[3])


def test_the_program_writes_one_page_of_several_runs_and_of_tasks_that_are_not_theirs(
    trained: Trained, planar_visits: Path, open_page
):
    suite = {"train_tasks": ("red-green-blue", "red-blue-green"), "test_tasks": ("green-red-blue",)}
    trained("first", suite=suite)
    trained("second", "option-gail-offline", suite=suite)
    report_sub_skills.run(["DMIL=first", "second", "--tasks", TASK, "green-red-blue", "--output", "page.html"])
    opened = open_page(planar_visits / "page.html")
    assert opened.requests == opened.complaints == opened.faults() == []
    assert opened.page.locator("h2").all_inner_texts() == [
        f"Sub-skills on {TASK}", "Sub-skills on green-red-blue", "t-SNE of states by sub-skill"
    ]  # fmt: skip
    pictures = opened.pictures()
    assert len(pictures) == 2 * 4 + 2
    assert all(width > 200 and height > 100 for _, width, height in pictures)
    assert f"{TASK}: sub-skills in rollouts" in pictures[1][0]
    assert opened.page.get_by_text("second, after adaptation").count() >= 4
    assert set(opened.sorted_by("The runs", "method")) == {"dmil", "option-gail-offline"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["flat"], "got flat of behaviour-cloning; wanted at least one of a method with several sub-skills"),
        (["run", "run"], "got run twice"),
        (["nothing"], "RUN: got 'nothing'; wanted a folder with a config.json"),
        (["run", "A=longer"], "A: got per_task 12; wanted 14, as run has"),
        (["run", "--tasks", "red-red-red"], "red-red-red"),
        (["run", "--shots", "0"], "--shots: got 0; wanted at least 1"),
        (["run", "--shots", "8"], "--shots: got 8; wanted fewer than the 8"),
        (["run", "--perplexity", "nan"], "--perplexity: got nan"),
    ],
)
def test_mistakes_are_reported(trained: Trained, complaint, arguments: list[str], message: str):
    trained("run")
    if "flat" in arguments:
        trained("flat", "behaviour-cloning")
    if "A=longer" in arguments:
        trained("longer", demonstrations={"per_task": 12, "held_out": 8})
    assert message in complaint(report_sub_skills.run, *arguments)
