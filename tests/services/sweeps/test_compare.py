"""Pages that put runs and sweeps side by side, in a real browser."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from services import report
from services.experiments.finished_run import FinishedRun
from services.reporting.comparison import compare_runs
from tests.services.reporting.made_runs import make_run
from tests.services.sweeps.made_up import better, make

METHODS = {"dmil": 16, "mil": 12}
"""What each solves of 20 episodes of each task, and one more by its seed."""
CELL = re.compile(r"^\s*\d\.\d\d\s*$")
MIL = {"method": {"name": "mil"}}


def on_the_way(level: float) -> list[dict[str, float]]:
    """Return 40 iterations with two evaluations on the way and one at the end."""
    losses = [{"loss": level / iteration, "gradient_norm": 1.0} for iteration in range(1, 41)]
    for iteration in (10, 20, 40):
        rate = {"success_rate": level / 2, "success_rate_low": level / 4, "success_rate_high": level}
        losses[iteration - 1] |= {f"{name}/meta-testing/1-shot": value for name, value in rate.items()}
    return losses


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with the folder `runs`: two methods, two seeds of each."""
    monkeypatch.chdir(tmp_path)
    for method, count in METHODS.items():
        for seed in (0, 1):
            make_run(
                Path("runs") / f"{method}-seed-{seed}",
                lambda task, number, most=count + seed: number < most,
                seed=seed,
                settings=MIL if method == "mil" else {},
                metrics=on_the_way(0.5 + seed / 4),
            )
    return tmp_path


def compared(*names: str, baseline: str | None = None):
    return compare_runs([FinishedRun.find(name, Path("runs")) for name in names], baseline)


ALL = [f"{method}-seed-{seed}" for method in METHODS for seed in (0, 1)]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_methods_and_seeds_stand_side_by_side_on_a_page(place: Path, open_page, scheme: str) -> None:
    report.run(["compare", *ALL])
    opened = open_page(place / "comparison.html")
    opened.page.emulate_media(color_scheme=scheme)
    assert opened.requests == []
    assert opened.complaints == []
    assert opened.faults() == []
    assert opened.page.title() == "dmil, mil side by side"
    assert opened.page.locator("h2").all_inner_texts() == [
        "Success rates", "Paired differences", "Performance profiles", "Each task", "Training curves",
        "Settings that differ", "Runs and commands",
    ]  # fmt: skip
    pictures = opened.pictures()
    assert all(description and width > 300 and height > 60 for description, width, height in pictures)
    titles = [description.partition(":")[0] for description, _, _ in pictures]
    assert titles == [
        "Mean success rate of each row; bars are 95% intervals",
        *(f"Performance profile, ml10, {split}" for split in ("meta-training", "meta-testing")),
        *["Success rate on each task"] * 2, "Success rate over training, ml10", "Losses over training, ml10",
    ]  # fmt: skip
    cells = opened.page.get_by_role("img", name="Success rate on each task").locator("text", has_text=CELL)
    inks = cells.evaluate_all("found => found.map(text => getComputedStyle(text).fill)")
    assert len(inks) == 2 * len(METHODS) * 3
    assert set(inks) <= {"rgb(0, 0, 0)", "rgb(255, 255, 255)"}, "whatever the colour of the page"
    assert opened.sorted_by("Success rates", "mean success rate") == ["0.625", "0.625", "0.825", "0.825"]
    assert opened.sorted_by("Success rates", "seeds") == ["2"] * 4
    assert opened.sorted_by("Success rates", "episodes") == ["120"] * 4
    assert opened.sorted_by("Differences from dmil", "difference") == ["-0.200", "-0.200"]
    assert opened.sorted_by("Differences from dmil", "differs?") == ["yes, lower"] * 2
    assert opened.sorted_by("Runs", "run") == sorted(ALL)
    assert (place / "comparison.html").stat().st_size < 5_000_000


def test_the_papers_figure_stands_beside_ours(place: Path, open_page) -> None:
    report.run(["compare", *ALL])
    opened = open_page(place / "comparison.html")
    table = opened.page.get_by_role("table", name="Success rates")
    row = table.locator("tbody tr", has_text="dmil").filter(has_text="meta-testing").inner_text()
    assert "0.396 ± 0.016" in row.replace("\u00a0", " ")
    assert "+0.429, outside" in row


def test_only_settings_that_differ_are_shown(place: Path, open_page) -> None:
    make_run(place / "runs" / "wide", lambda *of: True, settings={"method": {"hidden_units": 64}})
    report.run(["compare", "dmil-seed-0", "wide", "--output", "pages/wide.html"])
    table = open_page(place / "pages/wide.html").page.get_by_role("table", name="Settings that differ")
    assert table.locator("tbody tr").all_inner_texts() == ["method.hidden_units\t512\t64"]


def test_runs_that_differ_only_in_the_seed_are_one_row_and_the_same_seed_again_is_another(place: Path) -> None:
    make_run(place / "runs" / "again-0", lambda *of: False)
    make_run(place / "runs" / "again-1", lambda *of: False, seed=1)
    comparison = compared(*ALL, "again-0", "again-1")
    assert list(comparison.rows) == ["dmil", "mil", "again"]
    assert [(of.row, of.name, of.seed) for of in comparison.evaluations if of.row == "again"] == [
        ("again", "again-0", 0), ("again", "again-1", 1)
    ]  # fmt: skip
    assert {tuple(cell.seeds) for cell in comparison.cells} == {(0, 1)}


@pytest.mark.parametrize(("named", "row"), [(None, "dmil"), ("mil", "mil"), ("mil-seed-1", "mil")])
def test_the_baseline_is_a_row_or_one_of_its_runs(place: Path, named: str | None, row: str) -> None:
    comparison = compared(*ALL, baseline=named)
    assert comparison.baseline == row
    assert {pair.baseline for pair in comparison.pairs} == {row}
    assert {pair.row for pair in comparison.pairs} == {"dmil", "mil"} - {row}


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"protocol": "q"}, "their protocols differ: q, against p"),
        ({"episodes": 4}, "they have 4 against 20 episodes of each task"),
        ({"tasks": ("reach", "sweep")}, "their tasks differ: sweep in the one alone, push, window-open in the other"),
        ({"first_seed": 7}, "their episodes are others"),
        ({"seed": 5}, "they have no seed in common: 5 against 0"),
    ],
)
def test_what_was_tried_otherwise_is_not_paired_and_the_page_says_why(
    place: Path, open_page, changes: dict[str, object], why: str
) -> None:
    make_run(place / "runs" / "other", lambda *of: True, settings={**MIL, "training": {"iterations": 7}}, **changes)  # type: ignore[arg-type]
    report.run(["compare", "dmil-seed-0", "other", "mil-seed-0"])
    opened = open_page(place / "comparison.html")
    assert set(opened.sorted_by("Differences from dmil-seed-0", "row")) == {"mil-seed-0"}
    text = opened.page.inner_text("main")
    assert f"other is not paired with dmil-seed-0: {why}" in text
    assert ("The protocols of ml10 differ" in text) == ("protocol" in changes)
    assert ("tasks of ml10 differ" in text) == ("tasks" in changes)
    assert opened.faults() == []


def test_scores_are_compared_where_there_are_scores(place: Path) -> None:
    kitchen = {"suite": {"name": "kitchen-kettle"}, "method": {"sub_skills": 4}}
    for name, most in (("one", 5), ("two", 15)):
        make_run(
            place / "runs" / name,
            lambda task, number, most=most: number < most,
            best=4,
            tasks=["kettle"],
            settings={**kitchen, "training": {"iterations": most}},
        )
    comparison = compared("one", "two")
    assert comparison.metric == "score"
    assert [cell.mean for cell in comparison.cells if cell.split == "meta-testing"] == [1, 3]
    assert [cell.paper and cell.paper.value for cell in comparison.cells] == [None, 3.15] * 2
    report.run(["compare", "one", "two"])
    assert "<h2" in (place / "comparison.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["dmil-seed-0"], "RUN: got dmil-seed-0; wanted two finished runs or more"),
        (["dmil-seed-0", "none-such"], "RUN: got 'none-such'; wanted a folder with a summary.json"),
        (["dmil-seed-0", "runs/dmil-seed-0"], "twice; wanted each run once"),
        (["dmil-seed-0", "elsewhere"], "got dmil-seed-0 of ml10, elsewhere of ml45; wanted runs of one suite"),
        (
            ["dmil-seed-0", "mil-seed-0", "--baseline", "x"],
            "--baseline: got 'x'; wanted one of dmil-seed-0, mil-seed-0",
        ),
        (["dmil-seed-0", "made-up"], "RUN: got the sweep made-up with others"),
        (["made-up", "--baseline", "x"], "--baseline: got 'x'; wanted one of DMIL, DMIL-High"),
    ],
)
def test_mistakes_are_reported(place: Path, complaint: Callable[..., str], arguments: list[str], message: str) -> None:
    make_run(place / "runs" / "elsewhere", lambda *of: True, settings={"suite": {"name": "ml45"}})
    make(place / "runs", better)
    assert message in complaint(report.run, "compare", *arguments)
    assert not (place / "comparison.html").exists()


def test_a_sweep_has_the_same_page(tmp_path: Path, open_page) -> None:
    sweep = make(tmp_path, better)
    report.run(["compare", str(sweep.path)])
    opened = open_page(sweep.path / "tables" / "report.html")
    assert (opened.requests, opened.complaints, opened.faults()) == ([], [], [])
    text = opened.page.inner_text("main")
    assert "Success rate at preset quick; trials: 6 finished. Beside it stands Table 4 of the paper." in text
    assert "seeds are drawn with replacement, all runs of a seed together" in text
    assert opened.sorted_by("Success rates", "mean success rate") == ["0.700"] * 2 + ["0.800"] * 6
    assert "None but the seed." in text
    assert len(opened.pictures()) == 7, "one of the means, a profile a split, a heat map for each split and shots"
    report.run(["compare", str(sweep.path), "--baseline", "DMIL-High", "--output", str(tmp_path / "turned.html")])
    turned = open_page(tmp_path / "turned.html")
    assert turned.sorted_by("Differences from DMIL-High", "difference") == ["+0.000", "+0.000", "+0.100", "+0.100"]


def test_a_sweep_without_a_finished_trial_has_a_page_that_says_so(tmp_path: Path, open_page) -> None:
    sweep = make(tmp_path, better, finished=["none"])
    report.run(["compare", str(sweep.path)])
    opened = open_page(sweep.path / "tables" / "report.html")
    assert "trials: 6 not run" in opened.page.inner_text("main")
    assert "Nothing is finished yet." in opened.page.inner_text("main")


def test_suites_in_the_rows_are_tasks_of_one_profile(tmp_path: Path, open_page) -> None:
    variants = {f"K={k}": {"method": {"sub_skills": k}} for k in (2, 4)}
    changes = {"variants": variants, "suites": ["kitchen-topburner", "kitchen-kettle"], "rows": "suites"}
    sweep = make(
        tmp_path, lambda *of: float(of[-1] % 4), splits=["meta-testing"], metric="score", paper="table5", **changes
    )
    report.run(["compare", str(sweep.path)])
    pictures = open_page(sweep.path / "tables" / "report.html").pictures()
    profiles = [description for description, _, _ in pictures if description.startswith("Performance")]
    assert len(profiles) == 1
    assert "1-shot K=4: 1.50 over 12 runs" in profiles[0]
    maps = [description for description, _, _ in pictures if description.startswith("Score on each task")]
    assert len(maps) == 2
    assert all("kitchen-kettle: " in description for description in maps)


def test_real_runs_with_evaluations_on_the_way(train, workplace: Path, open_page) -> None:
    settings = ["--training.iterations", "4", "--training.checkpoint-every", "2", "--evaluation.every", "2"]
    for seed in ("0", "1"):
        train(f"smoke-seed-{seed}", *settings, "--seed", seed)
    train("behaviour", *settings, "--method", "behaviour-cloning")
    report.run(["compare", "smoke-seed-0", "smoke-seed-1", "behaviour"])
    opened = open_page(workplace / "comparison.html")
    assert (opened.requests, opened.complaints, opened.faults()) == ([], [], [])
    curve = next(
        description for description, _, _ in opened.pictures() if description.startswith("Success rate over training")
    )
    assert "meta-training, 1-shot: smoke from" in curve
    assert set(opened.sorted_by("Runs", "row")) == {"smoke", "behaviour"}
    assert opened.sorted_by("Success rates", "tasks")[0] in "13"
