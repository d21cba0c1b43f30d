import re

import numpy as np
import pytest
from matplotlib import colormaps

from services.reporting.drawing import ink_on
from services.reporting.heat_map import COLOURS, heat_map


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
