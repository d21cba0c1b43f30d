import re
from pathlib import Path

import imageio.v3 as imageio
import matplotlib
import numpy as np
import pytest

from services.reporting.drawing import COLOURS, colour_of, panels, style_of, to_picture
from services.reporting.page import Clip, Commands, DataTable, Prose, Section, write_page


def lines(title: str):
    with panels(1, 2) as (figure, axes):
        for index, axis in enumerate(axes):
            axis.plot([0, 1], [index, 1], label="a < b & c", **style_of(index))
            axis.fill_between([0, 1], [0, 1], [1, 2], hatch="//", alpha=0.3, color=colour_of(index))
            axis.legend()
            axis.set(title=title, xlabel="iteration")
        return to_picture(figure, title, "Two lines <rising> & crossing.")


@pytest.fixture
def page(tmp_path: Path) -> Path:
    film = tmp_path / "film.mp4"
    imageio.imwrite(film, np.zeros((5, 64, 64, 3), np.uint8), fps=10)
    still = tmp_path / "film.gif"
    imageio.imwrite(still, np.zeros((5, 64, 64, 3), np.uint8), duration=100)
    table = DataTable(
        "rates", ["task", "rate"], [["b", "0.9 of 20"], ["a", "0.10"], ["c", ""], ["d", "−1"], ["e", 1234]]
    )
    sections = [
        Section("Tables, and more", [table, Prose("Told & <b>plainly</b>."), Commands("again", ["python -m x"])]),
        Section("Pictures", [lines("losses"), lines("rates"), Clip("a film", film), Clip("another", still)]),
        Section("Nothing", []),
    ]
    path = tmp_path / "page.html"
    write_page(path, "A <run>", [Prose("lead")], sections)
    return path


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_page_opens_from_disk_whole_and_accessible(page: Path, open_page, scheme: str):
    opened = open_page(page)
    opened.page.emulate_media(color_scheme=scheme)
    assert opened.requests == []
    assert opened.complaints == []
    assert opened.faults() == []
    assert opened.page.title() == "A <run>"
    assert opened.page.locator("h2").all_inner_texts() == ["Tables, and more", "Pictures"]
    pictures = opened.pictures()
    assert [description for description, _, _ in pictures] == [
        "losses: Two lines <rising> & crossing.", "rates: Two lines <rising> & crossing.", "a film", "another"
    ]  # fmt: skip
    assert all(width >= 64 and height >= 64 for _, width, height in pictures)


def test_a_table_sorts_by_numbers_and_keeps_empty_fields_last_and_back(page: Path, open_page):
    opened = open_page(page)
    assert opened.sorted_by("rates", "rate") == ["−1", "0.10", "0.9 of 20", "1234", ""]
    assert opened.page.locator("th[aria-sort=ascending]").all_inner_texts() == ["rate"]
    assert opened.sorted_by("rates", "rate") == ["1234", "0.9 of 20", "0.10", "−1", ""]
    assert opened.page.locator("th[aria-sort=descending]").all_inner_texts() == ["rate"]
    assert opened.sorted_by("rates", "task") == ["a", "b", "c", "d", "e"]


def test_a_table_is_sorted_by_keyboard(page: Path, open_page):
    opened = open_page(page)
    opened.page.get_by_role("button", name="task").focus()
    opened.page.keyboard.press("Enter")
    assert opened.page.locator("tbody th").first.inner_text() == "a"


def test_text_is_text_and_no_markup(page: Path):
    assert "Told &amp; &lt;b&gt;plainly&lt;/b&gt;." in page.read_text()


def test_ids_are_of_one_picture_and_colours_follow_the_page():
    first, second = lines("losses"), lines("losses")
    ids = [set(re.findall(r'\bid="([^"]+)"', picture.svg)) for picture in (first, second)]
    assert not ids[0] & ids[1]
    for picture, own in zip((first, second), ids, strict=True):
        assert set(re.findall(r'(?:xlink:href="#|url\(#)([^")]+)', picture.svg)) <= own
        assert "currentColor" in picture.svg
        assert "a &lt; b &amp; c" in picture.svg


def test_a_sub_skill_keeps_its_colour_and_lines_differ_beyond_the_colours():
    assert len(set(COLOURS)) == 10
    assert colour_of(3) == colour_of(13) == COLOURS[3]
    assert style_of(3) != style_of(13)


def test_a_name_in_a_picture_is_text(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(matplotlib.rcParams, "text.usetex", True)  # as a matplotlibrc in the working directory might
    svg = str(lines(r"$\input{/etc/passwd}^2$ <script>").svg)
    assert svg.count(r"$\input{/etc/passwd}^2$ &lt;script&gt;</text>") == 2
    assert "<script" not in svg
