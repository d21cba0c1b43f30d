import re

import numpy as np
import pytest

from dmil_core.methods.dmil.config import DmilConfig
from services.demonstrations.store import DemoStore
from services.evaluation.results import EpisodeResult
from services.experiments.experiment import Experiment
from services.reporting.curves import HATCHES, MOST_POINTS, OTHERS, draw_metrics, draw_success
from services.reporting.drawing import colour_of
from tests.services.distributed.courses import alone
from tests.services.experiments.test_methods import LEARNERS, smoke
from tests.services.reporting.test_rates import episode, shown

DMIL = (
    "loss", "high_loss_before", "high_loss_after", "low_loss_before", "low_loss_after", "continuity_loss",
    "agreement", "sub_skill_entropy", "gradient_norm", "iterations_per_second", "overhead_share",
)  # fmt: skip


def course(count: int, sub_skills: int, **others: float) -> list[dict[str, float]]:
    shares = {f"sub_skill_share/{k}": 1 / sub_skills for k in range(sub_skills)}
    return [{"iteration": n + 1, **dict.fromkeys(DMIL, 0.5), **shares, **others} for n in range(count)]


@pytest.mark.parametrize("count", [1, 2, MOST_POINTS + 1, 7 * MOST_POINTS])
def test_curves_are_drawn_from_however_many_iterations(count: int):
    losses, use, step = draw_metrics(course(count, 3))
    assert [losses.title, use.title, step.title] == ["Losses", "Use of sub-skills", "Outer step"]
    assert {"high level", "sub-skills", "continuity", "iteration", "cross-entropy in nats"} <= set(shown(losses))
    assert shown(losses).count("before adaptation") == shown(losses).count("after adaptation") == 2
    assert {"sub-skill 0", "sub-skill 1", "sub-skill 2", "fraction of states"} <= set(shown(use))
    assert {"gradient", "norm", "iterations a second"} <= set(shown(step))


def test_a_sub_skill_has_its_colour_and_hatch_however_many_there_are():
    assert len(HATCHES) == len(set(HATCHES))
    for sub_skills in (2, 5, 10):
        _, use, _ = draw_metrics(course(3, sub_skills))
        assert all(colour_of(k) in use.svg for k in range(sub_skills))
        assert sum(text.startswith("sub-skill") for text in shown(use)) == sub_skills
        patterns = len(re.findall("<pattern ", use.svg))
        assert patterns == sub_skills - 1, "all but the first are hatched"


def test_a_point_is_the_mean_of_its_iterations():
    rows = [{"iteration": n + 1, "gradient_norm": float(n % 2)} for n in range(4 * MOST_POINTS)]
    (picture,) = draw_metrics(rows)
    assert picture.description == "Gradient: gradient norm from 0.5 to 0.5."


def test_what_a_method_of_ones_own_measures_is_drawn_too_but_no_evaluation():
    others = {"surprise_of_tasks": 3.0, "success_rate/meta-testing/1-shot": 1.0, "agreement/meta-training": 0.2}
    pictures = draw_metrics(course(3, 2, **others, **{"seconds/train": 9.0, "environment_steps": 500.0}))
    assert pictures[-1].title == OTHERS
    assert pictures[-1].description == "Surprise of tasks: surprise of tasks from 3 to 3."
    description = " ".join(picture.description for picture in pictures)
    assert not any(word in description for word in ("meta-t", "seconds", "environment steps"))


def test_losses_over_decades_are_drawn_by_their_logarithm_and_fractions_never():
    def powers(least: float) -> int:
        """Count the ticks that are powers of ten."""
        rows = [{"iteration": n, "high_loss_after": least**n, "agreement": 10.0**-n} for n in range(1, 6)]
        losses, use = draw_metrics(rows)
        assert {"0.0", "0.2", "1.0"} <= set(shown(use))
        return len({"0.1", "0.01", "0.001", "0.0001", "1e−05"} & set(shown(losses)))

    assert powers(0.1) == 5
    assert powers(0.9) == powers(-0.1) == 0


def test_nothing_measured_is_nothing_drawn():
    assert draw_metrics([]) == []
    assert draw_metrics([{"iteration": 0, "success_rate/meta-testing/1-shot": 1.0}]) == []


@pytest.mark.parametrize("method", LEARNERS)
def test_whatever_our_methods_measure_has_its_panel(store: DemoStore, data, method: str):
    slots = alone(Experiment(smoke(method, 4), store), data).slots
    rows = [
        {"iteration": number, **{name: float(np.mean([slot[name] for slot in own])) for name in own[0]}}
        for number, own in enumerate(slots, start=1)
    ]
    titles = [picture.title for picture in draw_metrics(rows)]
    assert titles[0] == "Losses"
    assert OTHERS not in titles


def evaluated(solved: int, best: int) -> list[EpisodeResult]:
    return [
        episode(split, "kettle", shots, n, best if n < solved else 0, best)
        for split in ("meta-training", "meta-testing")
        for shots in (1, 3)
        for n in range(10)
    ]


def test_success_is_drawn_over_the_iterations_with_scores_where_there_are_some():
    course = {500: evaluated(2, 1), 1000: evaluated(9, 1)}
    (picture,) = draw_success(course, DmilConfig(), 1)
    assert {"meta-training", "meta-testing", "1-shot", "3-shot", "success rate"} <= set(shown(picture))
    assert "meta-testing, 3-shot: 0.20 at 500, 0.90 at 1000" in picture.description
    rates, scores = draw_success({500: evaluated(2, 4), 1000: evaluated(9, 4)}, DmilConfig(), 4)
    assert rates.title == "Success over the iterations"
    assert "mean score" in shown(scores)
    assert "meta-training, 1-shot: 0.80 at 500, 3.60 at 1000" in scores.description
