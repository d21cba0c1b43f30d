"""Each benchmark runs, small, and its rows have the columns that others read."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

PROJECT = Path(__file__).parents[2]


def rows_of(program: str, *arguments: str, folder: Path) -> Any:
    command = [sys.executable, "-m", f"benchmarks.{program}", *arguments, "--json", str(folder / "rows.json")]
    subprocess.run(command, cwd=PROJECT, check=True, capture_output=True)
    return json.loads((folder / "rows.json").read_text())


@pytest.mark.thorough
def test_meta_gradient(tmp_path: Path) -> None:
    flags = ["--sizes", "quick", "--sub-skills", "2", "3", "--orders", "second", "--rounds", "1"]
    rows = rows_of("meta_gradient", *flags, folder=tmp_path)
    assert [(row["size"], row["order"], row["k"]) for row in rows] == [("quick", "second", 2), ("quick", "second", 3)]
    for row in rows:
        assert row["ratio"] == pytest.approx(row["twin_seconds"] / row["seconds"])
        assert row["ratio_spread"] == [row["ratio"]] * 2
        assert row["roofline_share"] > 0
        assert 100 < row["peak_mb"] < 1500
        assert row["forwards"] == pytest.approx(4 * row["k"] + 64, rel=0.1), "the count of work of own states only"
        assert row["relative_error"] < 1e-5


@pytest.mark.thorough
def test_device(tmp_path: Path) -> None:
    rows = rows_of("device", "--sizes", "quick", "--rounds", "1", "--no-whole", folder=tmp_path)
    assert [(row["device"], row["path"]) for row in rows][:2] == [("cpu", "loop"), ("cpu", "batched")]
    for row in rows:
        assert row["ms_an_iteration"] == pytest.approx(10 * row["ms_a_slot"])
        assert 0 < row["roofline_share"] < 1


@pytest.mark.thorough
def test_adaptation(tmp_path: Path) -> None:
    rows = rows_of("adaptation", "--fine-tuning-steps", "2", "--rounds", "1", folder=tmp_path)
    *ours_and_reference, mil, imported, loaded, acting, adapting = rows
    assert [row["target_seconds"] for row in (imported, loaded, acting, adapting)] == [1.5, 0.2, 150e-6, 0.5]
    assert acting["seconds"] < adapting["seconds"]
    assert [row["what"] for row in ours_and_reference] == [
        "adapt, 1 shot, 2 steps",
        "act in 1 state",
        "act in 20 states",
    ]
    assert all(row["seconds"] > 0 and row["twin_seconds"] > 0 for row in ours_and_reference)
    assert (mil["what"], mil["twin_seconds"]) == ("MIL: act in 1 state", None)
    assert 0 < mil["floor_seconds"] < mil["seconds"]


@pytest.mark.thorough
def test_simulation(tmp_path: Path) -> None:
    rows = rows_of("simulation", "--quick", folder=tmp_path)
    *steps, median, evaluation = rows
    assert [row["task"] for row in rows] == ["reach", "push", "median", "evaluation"]
    assert evaluation["ratio"] > 0
    assert median["ratio"] == pytest.approx(sum(row["ratio"] for row in steps) / 2)
    for row in steps:
        assert row["ratio"] == pytest.approx(row["ours_steps_per_s"] / row["stock_steps_per_s"])
        assert row["physics_steps_per_s"] > 0


@pytest.mark.thorough
def test_scaling(tmp_path: Path) -> None:
    rows = rows_of("scaling", "--sizes", "quick", "--rounds", "1", "--iterations", "2", folder=tmp_path)
    assert [(row["runner"], row["workers"], row["size"]) for row in rows] == [
        ("local", 1, "quick"),
        ("ray", 1, "quick"),
        ("ray", 2, "quick"),
    ]
    for row in rows:
        assert 0 <= row["overhead_share"] < 1
        assert row["speedup"] == pytest.approx(row["iterations_per_s"] / rows[1]["iterations_per_s"])


@pytest.mark.thorough
def test_sizing(tmp_path: Path) -> None:
    given = ("--presets", "ml10-quick", "--rounds", "1", "--workers", "1", "2", "1000")
    rows = rows_of("sizing", *given, folder=tmp_path)
    fixed, each = rows[:3], rows[3:]
    assert [(row["workers"], row["used"], row["slots"]) for row in fixed] == [(1, 1, 10), (2, 2, 10), (1000, 2, 10)]
    assert [(row["workers"], row["used"], row["slots"]) for row in each] == [(1, 1, 5), (2, 2, 10), (1000, 1000, 5000)]
    one, two, thousand = fixed
    assert thousand["iteration"] == two["iteration"] < one["iteration"] == pytest.approx(one["hours"] * 3600 / 2500)
    assert (one["efficiency"], thousand["dollars"]) == (1, pytest.approx(500 * two["dollars"]))
    assert each[2]["sent"] > each[0]["sent"] == 0
    assert 0 < each[2]["tree"] < each[2]["alone"]


@pytest.mark.thorough
def test_tracking(tmp_path: Path) -> None:
    rows = rows_of("tracking", "--rounds", "1", "--iterations", "2", folder=tmp_path)
    assert [row["mlflow"] for row in rows] == ["no tracking", "down", "slow", "up (SQLite)", "no tracking, again"]
    none, down, slow, up, again = rows
    assert (none["ratio"], none["records"], again["records"]) == (1, 0, 0)
    for row in (down, slow, up):
        assert row["ratio"] > 0
        assert row["call_us"] > 0
        assert row["records"] == 3 + 2 + 2, "iterations, and where the run begins and ends"
    assert [row["delivered"] for row in (down, slow, up)] == [0, 0, 7]


@pytest.mark.thorough
def test_faults(tmp_path: Path) -> None:
    small = ("--kills", "1", "--seed", "1", "--iterations", "60", "--folder", str(tmp_path / "campaign"))
    found = rows_of("faults", *small, folder=tmp_path)
    assert (found["kills"], found["equal"], found["lost"], found["different"]) == (1, 1, 0, 0)
    assert found["seconds"] > 0
    assert set(found["cost"]) == {"worker", "all workers", "learner", "driver"}


@pytest.mark.thorough
def test_serving(tmp_path: Path) -> None:
    few = ["--rate", "20", "--seconds", "2", "--mixed-seconds", "8", "--kill-seconds", "3"]
    act, loop, mixed = rows_of("serving", *few, folder=tmp_path)
    assert (act["what"], loop["what"], mixed["what"]) == ("act", "control loop", "mixed, 8 s")
    assert act["right"] > 20
    assert mixed["killed"] >= 1
    assert act["wrong"] == loop["wrong"] == mixed["wrong"] == 0
    assert 0 < loop["p50_ms"] <= loop["p99_ms"]
