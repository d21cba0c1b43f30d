"""Records on disk: whole ones only, and a damaged one is named by file and line."""

import json
from pathlib import Path

import pytest

from dmil_core.errors import UserError
from dmil_core.files import DiskFullError
from services.tracking.__main__ import run as tracking_program
from services.tracking.delivery import Identity
from services.tracking.spool import Spool, read_spool
from services.tracking.tracker import Tracker
from tests.services.tracking.conftest import records


@pytest.mark.parametrize(
    "line",
    [
        "no JSON",
        "[]",
        '["metrics", {"step": 1}]',
        '["artifact", {"path": "/etc/passwd"}]',
        '["artifact", {"path": "summary.json", "folder": "../elsewhere"}]',
        '["tags", {"mlflow.runName": "defaced"}]',
        '["tags", {"seed": "0", "dmil.folder": "/elsewhere"}]',
    ],
)
def test_a_damaged_record_is_named_by_file_and_line(tmp_path: Path, line: str, complaint):
    Identity.find_or_make(tmp_path, "an experiment")
    (tmp_path / "tracking.jsonl").write_text(f'["tags", {{}}]\n{line}\n["tags", {{}}]\n')
    printed = complaint(tracking_program, "flush", str(tmp_path))
    assert f"{tmp_path / 'tracking.jsonl'}, line 2: got " in printed
    with pytest.raises(UserError, match=r"tracking\.jsonl, line 2"):
        Tracker(tmp_path, "an experiment")


@pytest.mark.parametrize("path", ["/etc/passwd", "../other", "report/../../other"])
def test_only_what_is_the_run_s_is_ever_sent(tmp_path: Path, path: str):
    (tmp_path / "tracking.jsonl").write_text(json.dumps(["artifact", {"path": path, "folder": None}]) + "\n")
    with pytest.raises(UserError, match="line 1"):
        list(read_spool(tmp_path / "tracking.jsonl"))


def test_a_line_that_a_killed_process_did_not_finish_is_cut_off(tmp_path: Path):
    (tmp_path / "tracking.jsonl").write_text('["tags", {}]\n["tags", {"a')
    spool = Spool(tmp_path / "tracking.jsonl")
    spool.append("tags", {"b": "c"})
    spool.close()
    assert records(tmp_path, "tags") == [{}, {"b": "c"}]


class HalfFull:
    """A file on a disk that becomes full in the middle of a write."""

    def __init__(self, file) -> None:
        self._file = file
        self.close, self.truncate = file.close, file.truncate

    def write(self, line: bytes) -> int:
        return self._file.write(line[:5])


def test_a_full_disk_ends_the_run_in_words_and_leaves_whole_records(tmp_path: Path):
    spool = Spool(tmp_path / "tracking.jsonl")
    spool.append("tags", {"a": "b"})
    file = spool._file
    spool._file = HalfFull(file)  # type: ignore[assignment]
    with pytest.raises(DiskFullError, match=r"tracking\.jsonl"):
        spool.append("tags", {"c": "d"})
    spool._file = file
    spool.append("tags", {"e": "f"})
    spool.close()
    assert records(tmp_path, "tags") == [{"a": "b"}, {"e": "f"}]
