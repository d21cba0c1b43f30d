"""Rivals are timed in alternation, and rows come back as they were written."""

import json
import subprocess
import sys
import time

import pytest

from benchmarks.harness import Ratio, alternate, write_rows


def test_rivals_take_turns_and_every_other_round_goes_backwards():
    calls: list[str] = []
    seconds = alternate({name: lambda name=name: calls.append(name) for name in "abc"}, rounds=3)
    assert "".join(calls) == "abccbaabc"
    assert {name: len(times) for name, times in seconds.items()} == {"a": 3, "b": 3, "c": 3}


def test_the_seconds_are_those_of_the_call():
    seconds = alternate({"long": lambda: time.sleep(0.05)}, rounds=2)
    assert min(seconds["long"]) >= 0.05


def test_preparation_comes_before_each_call_and_is_not_timed(monkeypatch: pytest.MonkeyPatch):
    calls: list[str] = []
    monkeypatch.setattr(time, "perf_counter", lambda: calls.append("|") or len(calls))
    rivals = {"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}
    seconds = alternate(rivals, rounds=2, prepare={"a": lambda: calls.append("-")})
    assert "".join(calls) == "-|a||b||b|-|a|"
    assert seconds == {"a": [2, 2], "b": [2, 2]}


def test_a_ratio_whose_rounds_disagree_is_refused():
    assert Ratio.of([3.0, 4.0, 2.9], [1.0, 1.0, 1.0]) == (3.0, 2.9, 4.0)
    refused = Ratio.of([3.0, 99.0], [1.0, 1.0])
    assert refused.median is None
    assert str(refused) == "the rounds disagree, 3.00 to 99.00"


def test_rows_are_read_back_as_written(tmp_path):
    rows = [{"task": "reach", "ratio": 1.5}, {"task": "evaluation", "ratio": 2.0}]
    write_rows(tmp_path / "new" / "rows.json", rows)
    assert json.loads((tmp_path / "new" / "rows.json").read_text()) == rows


def test_a_benchmark_is_called_as_its_usage_line_says():
    asked = [sys.executable, "-m", "benchmarks.sizing", "--help"]
    told = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
    assert told.startswith("usage: python -m benchmarks.sizing ")
