"""Where sub-skills are chosen among states: t-SNE, its points, and what is said of it."""

import re
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmil_core.demonstrations import Demonstration
from dmil_core.errors import UserError
from services.experiments.finished_run import FinishedRun
from services.reporting.drawing import Picture, colour_of
from services.reporting.embedding import embed, embedding_section, thin_out
from services.reporting.run_group import group_runs, policies

TASK = "blue-green-red"
Trained = Callable[..., FinishedRun]


def demonstrations(*lengths: int) -> list[Demonstration]:
    """Return demonstrations whose states are numbered through."""
    starts = np.cumsum([0, *lengths])
    return [
        Demonstration(
            str(number),
            "task",
            np.arange(starts[number], starts[number] + length, dtype=np.float32)[:, None],
            np.zeros((length, 1), np.float32),
        )
        for number, length in enumerate(lengths)
    ]


def points_of(svg: str) -> Counter[str]:
    """Count the points of each colour: what is drawn again and again from one marker."""
    panels = re.findall(r"<use [^>]*style=\"fill: (#[0-9a-f]{6})[^>]*>", svg)
    return Counter(panels)


def picture_of(section) -> Picture:
    (picture,) = (part for part in section.parts if isinstance(part, Picture))
    return picture


def test_every_state_is_kept_where_there_are_few():
    kept = thin_out(demonstrations(3, 2), 5)
    assert kept.every == 1
    assert kept.of.tolist() == kept.states[:, 0].tolist() == [0, 1, 2, 3, 4]


def test_each_demonstration_keeps_its_first_state_and_every_other():
    kept = thin_out(demonstrations(5, 4), 5)
    assert kept.every == 2
    assert kept.of.tolist() == kept.states[:, 0].tolist() == [0, 2, 4, 5, 7]


@given(st.lists(st.integers(1, 30), min_size=1, max_size=6), st.integers(1, 60))
def test_no_less_would_do(lengths: list[int], most: int):
    kept = thin_out(demonstrations(*lengths), most)
    assert len(kept.states) <= max(most, len(lengths))
    if kept.every > 1:
        assert sum(len(range(0, length, kept.every - 1)) for length in lengths) > most
    assert set(np.cumsum([0, *lengths[:-1]])) <= set(kept.of.tolist())


def test_near_states_lie_near_each_other_and_a_seed_names_it_all():
    draw = np.random.default_rng(0)
    states = np.concatenate([draw.normal(centre, 0.1, (30, 4)) for centre in (-5, 5)]).astype(np.float32)
    places = embed(states, 10, 3)
    assert np.array_equal(places, embed(states, 10, 3))
    middles = places[:30].mean(0), places[30:].mean(0)
    nearer = [np.linalg.norm(place - middles[0]) < np.linalg.norm(place - middles[1]) for place in places]
    assert nearer == [True] * 30 + [False] * 30


def test_points_are_as_many_as_the_choices_of_each_sub_skill(trained: Trained):
    run = trained("run")
    group = group_runs({"run": run})
    picture = picture_of(embedding_section(group, perplexity=20, seed=7))
    support, others = group.shots(TASK, 3)
    chosen = [policy.sub_skill_use(other).chosen for policy in policies(run, support).values() for other in others]
    wanted = Counter(colour_of(k) for steps in chosen for k in steps.tolist())
    wanted.update(colour_of(k) for k in range(3))  # in the legend
    assert points_of(picture.svg) == wanted
    states = sum(map(len, others))
    for text in (
        f"{states} states, all of those in 5 held-out",
        "paper draws 16; no more are held out",
        "adapted to 3 ",
    ):
        assert text in picture.description
    assert "perplexity 20, seed 7" in picture.description


def test_all_panels_show_the_same_places(trained: Trained):
    group = group_runs({"A": trained("run"), "B": trained("other", "option-gail-offline")})
    picture = picture_of(embedding_section(group, perplexity=5))
    panels = re.split(r'<g id="[^"]*(?:axes_|legend_)\d', picture.svg)[1:5]
    heights = [
        sorted(float(y) for y in re.findall(r'<use [^>]*y="([\d.]+)" style="fill: #', panel)) for panel in panels
    ]
    spread = [np.subtract(one, one[0]) for one in heights]
    assert len(spread[0]) == int(picture.description.split()[0])
    assert all(np.allclose(one, spread[0], atol=0.05) for one in spread)
    for label in ("A, before adaptation", "B, after adaptation", "sub-skill 2"):
        assert label in picture.svg


@pytest.mark.thorough
def test_a_picture_of_many_states_stays_small(trained: Trained):
    longer = {"demonstrations": {"per_task": 26, "held_out": 20, "noise": 0.5}}
    group = group_runs({name: trained(name, **longer) for name in "ABCD"})
    picture = picture_of(embedding_section(group))
    assert len(picture.svg) < 300_000
    assert "of those in 16 held-out demonstrations; adapted to 3 others" in picture.description


def test_few_states_get_a_perplexity_that_they_allow(trained: Trained):
    group = group_runs({"run": trained("run", demonstrations={"per_task": 8, "held_out": 3})})
    picture = picture_of(embedding_section(group, shots=2, perplexity=1000))
    states = int(picture.description.split()[0])
    text = re.search(r"perplexity ([\d.]+)", picture.description)
    assert text is not None
    assert float(text[1]) == pytest.approx((states - 1) / 3, abs=0.01)


def test_without_sub_skills_or_demonstrations_there_is_nothing_to_draw(trained: Trained):
    assert embedding_section(group_runs({"flat": trained("flat", "behaviour-cloning")})).parts == []
    with pytest.raises(UserError, match="got 8; wanted fewer than the 8"):
        embedding_section(group_runs({"run": trained("run")}), shots=8)
