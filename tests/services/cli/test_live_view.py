"""What the live screen and the lines show: labels, counts, and each sub-skill in its own part of the strip."""

from io import StringIO

import pytest
from rich.console import Console
from rich.text import Text

from services.cli.colours import COLOURS
from services.cli.live_view import Pace, Screen, Status, Strip, Tally, Workers

LOSSES = {"loss": 0.61, "high_loss_before": 0.34, "high_loss_after": 0.12, "continuity_loss": 0.01}
STATUS = Status(
    losses=LOSSES,
    shares=(0.5, 0.3, 0.2),
    success=[Tally("meta-training", 1, 45, 60), Tally("meta-training", 3, 50, 60), Tally("meta-testing", 1, 10, 20)],
    after=500,
    workers=[Workers("adaptation", 2, 1)],
    at="door-close",
)
PACE = Pace(done=750, total=2000, seconds=200, rate=4.0, unit="iterations")


def drawn(what, width: int, *, colours: bool = False) -> str:
    file = StringIO()
    kind = "truecolor" if colours else None
    Console(file=file, width=width, force_terminal=True, color_system=kind, legacy_windows=False).print(what)
    return file.getvalue()


def plain(what, width: int) -> list[str]:
    return Text.from_ansi(drawn(what, width)).plain.splitlines()


@pytest.mark.parametrize("width", [80, 160])
def test_a_screen_says_all_that_is_known(width: int):
    lines = plain(Screen("meta-training", PACE, STATUS), width)
    shown = "\n".join(lines)
    for words in (
        "750/2000", "4 iterations/s, 0:03:20 so far, 0:05:12 left",
        "losses         loss 0.610   high 0.340 to 0.120   continuity 0.010",
        "0 50%   1 30%   2 20%",
        "success        meta-training 1-shot 0.750 (45/60)   3-shot 0.833 (50/60)",
        "meta-testing 1-shot 0.500 (10/20)",
        "after 500", "adaptation 2 alive, 1 restarted", "at             door-close",
    ):  # fmt: skip
        assert words in shown
    assert shown.count("after 500") == 1
    assert all(len(line) <= min(width, 80) for line in lines)
    assert len(lines) <= 12


@pytest.mark.parametrize("width", [1, 5, 16, 30, 79])
def test_no_terminal_is_too_narrow(width: int):
    lines = plain(Screen("meta-training", PACE, STATUS), width)
    assert lines
    assert all(len(line) <= width for line in lines)


def test_what_is_not_known_is_left_out():
    lines = plain(Screen("evaluating", Pace(0, 0, 0.0, 0.0, "episodes"), Status()), 80)
    assert [line.split() for line in lines if line.strip()][1:] == [["0:00:00", "so", "far"]]
    assert lines[0].split()[0] == "evaluating"
    assert Status().line == ""


def test_each_sub_skill_has_its_colour_and_its_number():
    """In the share of the columns that it has of the states; the number tells them apart without colours."""
    strip = Strip((0.5, 0.3, 0.2))
    assert plain(strip, 60) == ["0" * 30 + "1" * 18 + "2" * 12]
    painted = drawn(strip, 60, colours=True)
    for colour in COLOURS[:3]:
        red, green, blue = (int(colour[at : at + 2], 16) for at in (1, 3, 5))
        assert f"48;2;{red};{green};{blue}m" in painted
    assert f"48;2;{int(COLOURS[3][1:3], 16)}" not in painted


@pytest.mark.parametrize("shares", [(0.0, 0.0), (1.0, 0.0), (float("nan"), 0.5), (0.1,) * 15, (1 / 3,) * 3])
def test_a_strip_is_as_wide_as_there_is_room(shares: tuple[float, ...]):
    (line,) = plain(Strip(shares), 70) or [""]
    assert len(line) == (70 if any(share > 0 for share in shares) else 0)


def test_a_line_says_it_in_words():
    assert STATUS.line == (
        "loss 0.610; sub-skills in use 3/3; after 500; meta-training 1-shot 0.750 (45/60); "
        "meta-training 3-shot 0.833 (50/60); "
        "meta-testing 1-shot 0.500 (10/20); workers restarted 1; door-close"
    )
    assert Status(losses={"loss": float("nan")}, shares=[1.0]).line == "loss nan"
    assert PACE.line == "4 iterations/s, 0:03:20 so far, 0:05:12 left"
    assert PACE._replace(done=2000, rate=0.0).line == "0:03:20 so far"
