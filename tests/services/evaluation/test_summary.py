from statistics import stdev

import pytest
from scipy.stats import norm, t

from dmil_core.methods.dmil.config import DmilConfig
from services.evaluation.paper_results import Published
from services.evaluation.results import AdaptationResult, EpisodeResult
from services.evaluation.summary import (
    Summary,
    against_collapse,
    diverged_of,
    headline,
    rates,
    sub_skill_shares,
    summary_rows,
    table_markdown,
)

ROW = {
    "suite": "ml10",
    "protocol": "success at any step within 300",
    "method": "dmil",
    "checkpoint": "c",
    "draw": 0,
    "support": ("080",),
    "data": "d",
    "fine_tuning_steps": 50,
    "learning_rate": 0.01,
    "versions": {},
}


def episode(split: str, task: str, shots: int, number: int, success: bool) -> EpisodeResult:
    return EpisodeResult.model_validate(
        ROW
        | {"split": split, "task": task, "shots": shots, "episode": number, "seed": number, "goal": (0.0,)}
        | {"success": success, "score": int(success), "steps": 10, "sub_skill_steps": (10,)}
    )


def adaptation(split: str, counts: tuple[int, ...], agreeing: int) -> AdaptationResult:
    return AdaptationResult.model_validate(
        ROW
        | {"split": split, "task": "reach", "shots": 1, "steps": sum(counts), "agreeing": agreeing}
        | {"sub_skill_steps": counts}
    )


def test_a_cell_counts_its_own_episodes_and_has_wilsons_interval() -> None:
    rows = [episode("meta-training", "reach", 1, n, n < 3) for n in range(4)]
    rows += [episode("meta-training", "push", 1, n, n < 1) for n in range(4)]
    rows += [episode("meta-testing", "lever-pull", 3, n, False) for n in range(2)]
    train, test = summary_rows(rows, 1, DmilConfig())
    assert (train.split, train.shots, train.episodes, train.success_rate) == ("meta-training", 1, 8, 0.5)
    assert train.per_task == {"reach": 0.75, "push": 0.25}
    assert train.paper is not None
    assert (train.paper.value, train.score) == (0.775, None)
    assert (test.split, test.episodes, test.success_rate) == ("meta-testing", 2, 0.0)
    z = norm.ppf(0.975)
    half = z * (0.25 / 8 + z**2 / (4 * 64)) ** 0.5 / (1 + z**2 / 8)
    assert (train.low, train.high) == pytest.approx((0.5 - half, 0.5 + half))


def test_a_part_of_a_suite_has_no_figure_of_the_papers_beside_it() -> None:
    rows = [episode("meta-training", "reach", 1, 0, True).model_copy(update={"suite": "ml10-part"})]
    assert summary_rows(rows, 1, DmilConfig())[0].paper is None


def test_sub_skill_use_is_weighted_by_states_and_counts_those_in_use() -> None:
    use = sub_skill_shares(
        [adaptation("meta-training", (90, 10, 0), 100), adaptation("meta-training", (50, 0, 50), 50)]
    )
    assert set(use) == {"meta-training"}
    assert use["meta-training"].share == pytest.approx([0.7, 0.05, 0.25])
    assert use["meta-training"].agreement == pytest.approx(0.75)
    assert use["meta-training"].in_use_per_task == pytest.approx(1.5)


def test_what_is_in_use_in_an_episode_and_its_switches_are_means_over_episodes() -> None:
    of_task = [adaptation("meta-testing", (50, 50, 0), 100)]
    old = episode("meta-testing", "reach", 1, 0, True)
    assert not sub_skill_shares(of_task, [old])["meta-testing"].in_episodes, "older rows do not say"
    changes = [
        {"sub_skill_steps": (45, 5, 50), "sub_skill_switches": 4},
        {"sub_skill_steps": (9,), "sub_skill_switches": 0},
    ]
    episodes = [old.model_copy(update=change) for change in changes]
    use = sub_skill_shares(of_task, [*episodes, episode("meta-training", "push", 1, 0, True)])["meta-testing"]
    assert (use.in_use_per_episode, use.switches_per_episode) == (1.5, 2)
    assert use.in_episodes == ", 1.5 in an episode, with 2.0 switches"


def test_collapse_is_entropy_zero() -> None:
    assert sub_skill_shares([adaptation("meta-testing", (0, 7, 0), 7)])["meta-testing"].entropy == 0


def test_the_papers_figures_are_those_it_prints() -> None:
    printed = "DMIL 0.775±0.010 0.949±0.009 0.396±0.016 0.710±0.021"
    rows = [episode(split, "reach", shots, 0, True) for split in ("meta-training", "meta-testing") for shots in (1, 3)]
    papers = [cell.paper for cell in summary_rows(rows, 1, DmilConfig())]
    assert [f"{paper.value:.3f}±{paper.spread:.3f}" for paper in papers if paper] == printed.split()[1:]


def test_a_suite_of_sub_tasks_has_scores():
    rows = [
        episode("meta-testing", task, 1, n, score == 4).model_copy(update={"suite": "kitchen-kettle", "score": score})
        for task, scores in (("a", (0, 1, 2, 3, 4, 4, 2)), ("b", (1, 1, 1, 1, 1, 1, 0)))
        for n, score in enumerate(scores)
    ]
    (cell,) = summary_rows(rows, 4, DmilConfig(sub_skills=2))
    assert cell.success_rate == 2 / 14
    score = cell.score
    assert score is not None
    assert (score.best, score.mean, score.mean_of_best) == (4, 22 / 14, (15 / 5 + 1) / 2)
    assert score.per_task == {"a": 16 / 7, "b": 6 / 7}
    values = [row.score for row in rows]
    assert score.deviation == pytest.approx(stdev(values))
    half = t.ppf(0.975, 13) * stdev(values) / 14**0.5
    assert (score.low, score.high) == pytest.approx((22 / 14 - half, 22 / 14 + half))
    assert cell.paper == Published(value=2.45, spread=0.25, table="Table 5")
    assert summary_rows(rows, 4, DmilConfig())[0].paper is None
    (alone,) = summary_rows(rows[:1], 4, DmilConfig(sub_skills=2))
    assert alone.score is not None
    assert (alone.score.mean, alone.score.deviation, alone.score.low) == (0, None, None)


def test_adaptations_that_diverged_are_counted_and_named() -> None:
    rows = [episode("meta-testing", "reach", 1, n, False).model_copy(update={"draw": n % 2}) for n in range(4)]
    rows = [row.model_copy(update={"diverged": row.draw == 0}) for row in rows]
    rows += [episode("meta-testing", "reach", 3, 0, True)]
    one, three = summary_rows(rows, 1, DmilConfig())
    assert (one.diverged, one.episodes, three.diverged) == (1, 4, 0)
    assert rates([one, three], {})["diverged/meta-testing/1-shot"] == 1
    assert "diverged/meta-testing/3-shot" not in rates([one, three], {})
    summary = Summary.model_construct(
        method="dmil", protocol="p", seed=0, environment_steps=0, rows=[one, three], controls=[], faults=""
    )
    assert "diverged adaptations" in headline(summary)[0]
    assert "1 adaptation diverged: an action was not finite" in table_markdown(summary)
    assert diverged_of(summary.model_copy(update={"rows": [three]})) == ""


def test_what_is_so_already_is_not_proposed_against_collapse() -> None:
    assert against_collapse(DmilConfig(continuity_weight=0.1)).startswith(
        "--method.balance sinkhorn, --method.labels-until above 0, --method.continuity-weight 0, another --seed"
    )
    so = DmilConfig(balance="sinkhorn", labels_until=5, continuity_weight=0)
    assert against_collapse(so) == "another --seed or a smaller --training.learning-rate may help"
