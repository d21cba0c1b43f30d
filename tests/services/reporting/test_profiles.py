import re

import numpy as np

from services.reporting.drawing import colour_of
from services.reporting.profiles import profiles

RATES = {"DMIL": np.array([[0.9, 1.0], [0.8, 0.6]]), "MIL": np.array([[0.2, 0.4]])}


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
