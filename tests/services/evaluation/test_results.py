"""Rows of results: written whole, read back equal, and a damaged line is refused by file and number."""

from pathlib import Path

import pytest

from dmil_core.errors import UserError
from services.evaluation.results import AdaptationResult, read_rows, write_rows


@pytest.fixture
def rows() -> list[AdaptationResult]:
    return [
        AdaptationResult(
            suite="ml10", protocol="p", method="dmil", checkpoint="c", split="meta-testing", task="reach", shots=1,
            draw=draw, support=("008",), data="d", fine_tuning_steps=5, learning_rate=0.003, versions={"torch": "2"},
            steps=30, agreeing=3, sub_skill_steps=(10, 20),
        )
        for draw in range(3)
    ]  # fmt: skip


@pytest.fixture
def path(rows: list[AdaptationResult], tmp_path: Path) -> Path:
    path = tmp_path / "adaptations.jsonl"
    write_rows(path, rows)
    return path


def test_what_is_written_is_read(path: Path, rows: list[AdaptationResult]):
    assert read_rows(path, AdaptationResult) == rows
    write_rows(path, rows[:1])
    assert read_rows(path, AdaptationResult) == rows[:1], "written in place of those there were"
    write_rows(path, [])
    assert read_rows(path, AdaptationResult) == []


def change(path: Path, old: bytes, new: bytes) -> None:
    path.write_bytes(path.read_bytes().replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b'"draw":1', b'"draw":"1"', ":2: draw: got '1'; input should be a valid integer"),
        (b'"draw":1', b'"draw":true', ":2: draw: got True"),
        (b'"draw":1,', b"", ":2: draw: got "),
        (b'"draw":1', b'"draw":1,"x":1', ":2: x: got 1"),
        (b"0.003", b"NaN", ":1: learning_rate: got nan"),
        (b"meta-testing", b"testing", ":1: split: got 'testing'"),
        (b"}\n", b"}", ":1: got half a line"),
        (b"}\n", b"}\n\n", ":2: row: got b''"),
        (b"reach", b"\xff", ":1: row: got "),
        (b"reach", b"x" * 2**20, ":1: got a line of 10"),
    ],
)
def test_a_damaged_row_is_refused_by_file_and_line(path: Path, old: bytes, new: bytes, words: str):
    change(path, old, new)
    with pytest.raises(UserError) as error:
        read_rows(path, AdaptationResult)
    assert f"{path}{words}" in str(error.value)
    assert len(str(error.value)) < 1000


def test_the_half_line_of_a_killed_writer_is_refused_by_its_number(path: Path):
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(UserError, match=r"adaptations.jsonl:3: got half a line"):
        read_rows(path, AdaptationResult)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path):
    with pytest.raises(UserError, match="nowhere: got No such file"):
        read_rows(tmp_path / "nowhere", AdaptationResult)
