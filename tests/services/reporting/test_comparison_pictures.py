import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib import colormaps

from services.reporting.comparison_pictures import COLOURS, draw_means, heat_map, means, profiles
from services.reporting.drawing import colour_of, ink_on
from services.sweeps.tables import comparison_of
from tests.services.sweeps.made_up import better, make

RATES = {"DMIL": np.array([[0.9, 1.0], [0.8, 0.6]]), "MIL": np.array([[0.2, 0.4]])}


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


def test_without_the_papers_figures_none_are_shown(tmp_path: Path) -> None:
    found = means(comparison_of(make(tmp_path, better, paper=None)))
    assert "paper" not in found.svg + found.description


def test_a_row_that_was_not_run_has_no_place(tmp_path: Path) -> None:
    comparison = comparison_of(make(tmp_path, better, finished=["DMIL"]))
    assert "DMIL-High" not in means(comparison).svg
    draw_means(comparison, tmp_path / "table.png", "a test")
    assert (tmp_path / "table.png").read_bytes().startswith(b"\x89PNG")


def luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_a_number_stands_in_each_cell_and_none_where_nothing_was_run() -> None:
    values = np.array([[0.9, np.nan], [0.25, 1.0]])
    found = heat_map("each task", ["DMIL", "a < b"], ["push", "reach"], values, top=1.0, metric="mean success rate")
    texts = re.findall(r">([^<>]+)</text>", found.svg)
    assert [text for text in texts if re.fullmatch(r"\d\.\d\d", text)] == ["0.90", "0.25", "1.00"]
    assert {"DMIL", "a &lt; b", "push", "reach", "mean success rate"} <= set(texts)
    assert "DMIL from 0.25 (reach) to 0.90 (push); a < b from 1.00 (reach) to 1.00 (reach)" in found.description
    assert "<image" not in found.svg, "all of it is drawn"


def test_numbers_stand_out_from_every_colour() -> None:
    values = np.linspace(0, 1, 60)[:, None]
    found = heat_map("all", ["row"], [f"t{i}" for i in range(60)], values, top=1.0, metric="rate")
    by_number = {}
    for style, number in re.findall(r'<text style="([^"]*)"[^>]*>(\d\.\d\d)</text>', found.svg):
        ink = re.search(r"fill: (#\w+)", style)
        by_number[number] = ink[1] if ink else "#000000"  # black is what SVG has where nothing is said
    assert set(by_number.values()) == {"#000000", "#ffffff"}
    for value in values[:, 0]:
        red, green, blue = (round(255 * part) for part in COLOURS(value)[:3])
        ground, ink = luminance(f"#{red:02x}{green:02x}{blue:02x}"), luminance(by_number[f"{value:.2f}"])
        low, high = sorted((ground, ink))
        assert (high + 0.05) / (low + 0.05) >= 4.5


@pytest.mark.parametrize(("colour", "ink"), [((0, 0, 0), "#ffffff"), ((1, 1, 1), "#000000"), ((0, 0, 1), "#ffffff")])
def test_ink_is_black_on_light_and_white_on_dark(colour: tuple[float, ...], ink: str) -> None:
    assert ink_on(colour) == ink


def test_the_scale_gets_lighter_all_the_way() -> None:
    greys = [np.dot(colormaps["cividis"].resampled(21)(i)[:3], (0.2126, 0.7152, 0.0722)) for i in range(21)]
    assert (np.diff(greys) > 0).all()


def test_a_profile_has_a_line_of_each_row_with_its_interquartile_mean_and_a_band_over_seeds() -> None:
    found = profiles("ml10, meta-testing", ["DMIL", "none", "MIL"], {1: RATES, 3: RATES}, "success rate", 3)
    texts = re.findall(r">([^<>]+)</text>", found.svg)
    assert texts.count("DMIL: 0.850") == texts.count("MIL: 0.300") == 2
    assert texts.count("success rate τ") == 2
    assert "ml10, meta-testing, 3-shot" in texts
    assert "1-shot DMIL: 0.850 over 4 runs" in found.description
    bands = re.findall(r'id="p\d+-FillBetweenPolyCollection_\d+".*?</g>', found.svg, re.DOTALL)
    assert len(bands) == 2, "of the row with two seeds alone, in each panel"
    assert all(colour_of(0) in band for band in bands)


def test_a_row_keeps_its_colour_where_others_are_not_there() -> None:
    found = profiles("ml10", ["DMIL", "MIL"], {1: {"MIL": RATES["MIL"]}}, "success rate", 3)
    assert colour_of(1) in found.svg
    assert colour_of(0) not in found.svg


def test_lines_differ_without_their_colours() -> None:
    rows = dict.fromkeys("abcd", RATES["MIL"])
    found = profiles("ml10", list(rows), {1: rows}, "success rate", 3)
    dashes = {index: set() for index in range(4)}
    for index in dashes:
        for style in re.findall(rf'style="([^"]*stroke: {colour_of(index)}[^"]*)"', found.svg):
            dashes[index].update(re.findall(r"stroke-dasharray: ([\d., ]+)", style) or ["solid"])
    assert len({frozenset(own) for own in dashes.values()}) == 4
