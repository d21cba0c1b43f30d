import json
from pathlib import Path

import pytest

from dmil_core.errors import UserError
from services.tracking.history import Origin, read_metrics, read_origin


def spool(folder: Path, *records: tuple[str, object]) -> None:
    (folder / "tracking.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))


def metrics(step: int, **values: float) -> tuple[str, object]:
    return "metrics", {"step": step, "time": 0, "values": values}


def test_metrics_are_read_in_order_and_an_iteration_done_again_counts_once(tmp_path: Path) -> None:
    spool(tmp_path, ("tags", {}), metrics(2, agreement=0.5), metrics(1, agreement=0.1), metrics(2, agreement=0.7))
    assert read_metrics(tmp_path) == [{"iteration": 1, "agreement": 0.1}, {"iteration": 2, "agreement": 0.7}]


@pytest.mark.parametrize(
    "line",
    [
        "\n",
        '{"step": 1}\n',
        '["metrics", {"step": "one", "time": 1, "values": {}}]\n',
        '["metrics", {"step": 1, "time": 1, "values": {"agreement": "high"}}]\n',
    ],
)
def test_a_damaged_record_is_refused_by_file_and_line(tmp_path: Path, line: str) -> None:
    spool(tmp_path, metrics(1, agreement=0.5))
    assert len(read_metrics(tmp_path)) == 1
    with (tmp_path / "tracking.jsonl").open("a") as file:
        file.write('["metrics", {"step": 2, "ti')
    assert len(read_metrics(tmp_path)) == 1, "a record that is being written is none yet"
    spool(tmp_path, metrics(1, agreement=0.5))
    with (tmp_path / "tracking.jsonl").open("a") as file:
        file.write(line)
    with pytest.raises(UserError) as error:
        read_metrics(tmp_path)
    assert f"{tmp_path / 'tracking.jsonl'}, line 2: " in str(error.value)


def test_a_folder_without_records_has_no_metrics(tmp_path: Path) -> None:
    assert read_metrics(tmp_path) == []


def test_what_a_run_was_made_of_is_read_from_its_records(tmp_path: Path) -> None:
    assert read_origin(tmp_path) == Origin((), {})
    spool(
        tmp_path,
        ("tags", {"git_commit": "a", "suite": "ml10"}),
        ("inputs", {"metaworld/reach/x": "1"}),
        ("tags", {"git_commit": "b-dirty"}),
        ("inputs", {"metaworld/reach/x": "1", "metaworld/push/x": "2"}),
        ("tags", {"git_commit": "a"}),
    )
    assert read_origin(tmp_path) == Origin(("a", "b-dirty"), {"metaworld/reach/x": "1", "metaworld/push/x": "2"})
