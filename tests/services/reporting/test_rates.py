import re
from pathlib import Path

import pytest

from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.statistics import mean_score, success_rate
from services.evaluation.results import EpisodeResult, write_rows
from services.evaluation.summary import Summary, summary_rows, write_summary
from services.experiments.finished_run import FinishedRun
from services.reporting.drawing import Picture
from services.reporting.page import DataTable, Prose
from services.reporting.rates import estimates, rates_of_tasks, table_of_all

TASKS = {"reach": 7, "push": 2, "door-open": 9}
"""Tasks of meta-training, and how many of ten episodes are successes with one shot; with three shots one more."""


def episode(split: str, task: str, shots: int, number: int, score: int, best: int = 1) -> EpisodeResult:
    return EpisodeResult.model_validate(
        {"suite": "ml10", "protocol": "p", "method": "dmil", "checkpoint": "c", "draw": 0, "support": ("080",)}
        | {"data": "d", "fine_tuning_steps": 50, "learning_rate": 0.01, "versions": {}, "split": split, "task": task}
        | {"shots": shots, "episode": number, "seed": number, "goal": (0.0,), "success": score == best}
        | {"score": score, "steps": 10, "sub_skill_steps": (10,)}
    )


def written(folder: Path, episodes: list[EpisodeResult], best: int = 1) -> FinishedRun:
    """Write what of a run's folder the rates are read from."""
    write_rows(folder / "episodes.jsonl", episodes)
    summary = Summary(
        method="dmil",
        environment_steps=0,
        rows=summary_rows(episodes, best, DmilConfig()),
        seconds={},
        sub_skills={},
        protocol="p",
        seed=0,
        checkpoint="c",
        checkpoint_digest="c",
        report="r",
        mlflow_run_id=None,
        failed_attempts={},
    )
    write_summary(summary, folder)
    return FinishedRun(folder)


def shown(picture: Picture) -> list[str]:
    """Return the texts in a picture, in their order."""
    return re.findall(r"<text [^>]*>([^<]*)</text>", picture.svg)


def test_each_task_has_a_bar_with_its_count_the_best_on_top(tmp_path: Path):
    episodes = [
        episode("meta-training", task, shots, n, int(n < solved + (shots == 3)))
        for task, solved in TASKS.items()
        for shots in (1, 3)
        for n in range(10)
    ]
    episodes += [episode("meta-testing", "lever-pull", 1, n, 0) for n in range(4)]
    section = rates_of_tasks(written(tmp_path, episodes))
    train, test, table = section.parts
    assert isinstance(train, Picture)
    assert isinstance(test, Picture)
    assert isinstance(table, DataTable)
    assert [train.title, test.title] == [f"meta-{kind}: success rate of each task" for kind in ("training", "testing")]
    texts = shown(train)
    assert [text for text in texts if text in TASKS] == ["push", "reach", "door-open"], "from the bottom up"
    assert [text for text in texts if "/" in text] == ["2/10", "7/10", "9/10", "3/10", "8/10", "10/10"]
    assert {"1-shot: 0.60 on average", "3-shot: 0.70 on average", "success rate"} <= set(texts)
    assert "1-shot 0.60 on average (dashed), from push with 0.20 to door-open with 0.90" in train.description
    assert "0/4" in shown(test)
    assert "1-shot 0.00 on average (dashed)." in test.description

    rate = success_rate([True] * 7 + [False] * 3)
    assert ["reach", "meta-training", 1, "7/10", "0.700", f"{rate.low:.3f} to {rate.high:.3f}"] in table.rows
    assert len(table.rows) == 7


def test_scores_have_bars_of_their_own_and_students_interval(tmp_path: Path):
    scores = [0, 1, 2, 4]
    episodes = [episode("meta-testing", "kettle", 1, n, score, best=4) for n, score in enumerate(scores)]
    episodes.append(episode("meta-testing", "kettle", 3, 0, 2, best=4))
    section = rates_of_tasks(written(tmp_path, episodes, best=4))
    rates, means, table = section.parts
    assert isinstance(rates, Picture)
    assert isinstance(means, Picture)
    assert isinstance(table, DataTable)
    assert {"1/4", "0/1"} <= set(shown(rates))
    assert {"of 4", "of 1", "mean score", "1-shot: 1.75 on average"} <= set(shown(means))
    mean = mean_score([0.0, 1.0, 2.0, 4.0])
    assert list(table.head[6:]) == ["score of 4", "interval of the score"]
    assert [list(row[6:]) for row in table.rows] == [["1.75", f"{mean.low:.2f} to {mean.high:.2f}"], ["2.00", ""]]


def test_an_estimate_reaches_from_its_mean_to_the_ends_of_its_interval():
    rows = [episode("meta-testing", "kettle", 1, n, int(n < 3), best=1) for n in range(4)]
    (rate,) = estimates(rows, scores=False).values()
    wanted = success_rate([True, True, True, False])
    assert rate.reach == pytest.approx((0.75 - wanted.low, wanted.high - 0.75))
    (single,) = estimates(rows[:1], scores=True).values()
    assert single.reach == (0.0, 0.0), "a single score has no interval"


def test_the_lead_says_what_was_measured_and_warns(finished: FinishedRun):
    prose = [part.text for part in table_of_all(finished) if isinstance(part, Prose)]
    assert prose[0].startswith("Success rates of dmil (goal visible; success at any step within 300; seed 0)")
    assert not any("trained on since" in text for text in prose)
    (table,) = [part for part in table_of_all(finished) if isinstance(part, DataTable)]
    assert [row[1:3] for row in table.rows] == [
        [split, shots] for split in ("meta-training", "meta-testing") for shots in ("1", "2")
    ]

    collapsed = finished.summary.model_copy(deep=True)
    collapsed.sub_skills["meta-testing"].share = [0.0, 0.995, 0.005]
    collapsed.checkpoint_digest = "another"
    other = FinishedRun(finished.folder)
    other.__dict__["summary"] = collapsed
    prose = [part.text for part in table_of_all(other) if isinstance(part, Prose)]
    assert any("the hierarchy is not used" in text for text in prose)
    assert any(f"--resume {finished.folder}" in text for text in prose)
