import re
from pathlib import Path

from services.reporting.drawing import colour_of
from services.reporting.means import draw_means, means
from services.sweeps.tables import comparison_of
from tests.services.sweeps.made_up import better, make


def test_each_row_stands_in_a_panel_for_each_split_with_the_papers_figure_beside_it(tmp_path: Path) -> None:
    found = means(comparison_of(make(tmp_path, better)))
    texts = re.findall(r">([^<>]+)</text>", found.svg)
    words = ("DMIL", "DMIL-High", "ml10, meta-training", "ml10, meta-testing", "mean success rate")
    assert [texts.count(word) for word in words] == [2, 2, 1, 1, 2]
    legend = ("1-shot", "1-shot, paper", "3-shot", "3-shot, paper")
    assert [texts.count(word) for word in legend] == [1, 1, 1, 1], "one legend for all panels"
    assert "ml10, meta-testing, 1-shot: DMIL 0.800, DMIL-High 0.700" in found.description
    assert found.description.startswith("Hollow marks are the paper's figures.")
    assert {colour_of(0), colour_of(1)} <= set(re.findall(r"#[0-9a-f]{6}", found.svg))


def test_without_the_papers_figures_none_are_told_of(tmp_path: Path) -> None:
    found = means(comparison_of(make(tmp_path, better, paper=None)))
    assert "paper" not in found.svg + found.description


def test_a_row_that_was_not_run_has_no_place(tmp_path: Path) -> None:
    comparison = comparison_of(make(tmp_path, better, finished=["DMIL"]))
    assert "DMIL-High" not in means(comparison).svg
    draw_means(comparison, tmp_path / "table.png", "a test")
    assert (tmp_path / "table.png").read_bytes().startswith(b"\x89PNG")
