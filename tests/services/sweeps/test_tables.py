"""Tables of sweeps whose rows are made up."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from dmil_core.errors import UserError
from dmil_core.settings import sub_skills_of
from services import report
from services.evaluation.comparison import CellKey
from services.sweeps.folders import TrialResult
from services.sweeps.table_formats import write_tables
from services.sweeps.tables import comparison_of, tables_of
from tests.services.sweeps.made_up import EPISODES, TASKS, better, make


def test_a_cell_has_mean_interval_counts_and_the_papers_figure(tmp_path: Path) -> None:
    tables = tables_of(make(tmp_path, better))
    found = next(c for c in tables.cells if (c.row, c.split, c.shots) == ("DMIL", "meta-testing", 1))
    assert (found.seeds, found.tasks, found.episodes) == ([0, 1, 2], 2, 120)
    assert found.mean == pytest.approx(0.8)
    assert found.low is not None
    assert found.high is not None
    assert 0.65 < found.low < 0.75 < 0.85 < found.high < 0.95
    assert found.interquartile_mean == pytest.approx(0.8)
    assert found.paper is not None
    assert (found.paper.value, found.paper.spread, found.paper.table) == (0.396, 0.016, "Table 4")
    assert found.difference == pytest.approx(0.8 - 0.396)
    assert found.outside is True
    assert found.sub_skills_in_use == 2
    assert next(c for c in tables.cells if c.shots == 3).sub_skills_in_use == 1
    assert tables.trials == {"finished": 6}
    assert tables.seconds == 12


def test_a_figure_inside_our_interval_is_not_outside(tmp_path: Path) -> None:
    tables = tables_of(make(tmp_path, lambda *of: float(of[-1] < 15)))
    cells = {(c.split, c.shots): c for c in tables.cells if c.row == "DMIL"}
    paper = cells["meta-training", 1].paper
    assert paper is not None
    assert paper.value == pytest.approx(0.775)
    assert cells["meta-training", 1].outside is False
    assert cells["meta-testing", 1].outside is True


@pytest.mark.parametrize(("metric", "kind"), [("success_rate", "Wilson"), ("score", "Student")])
def test_one_seed_has_an_interval_over_its_episodes(tmp_path: Path, metric: str, kind: str) -> None:
    tables = tables_of(make(tmp_path, lambda *of: float(2 * (of[-1] < 10)), seeds=[4], metric=metric))
    found = tables.cells[0]
    assert found.interval == kind
    assert found.mean == pytest.approx(0.5 if metric == "success_rate" else 1.0)
    assert found.low is not None
    assert found.high is not None
    half = found.mean - found.low
    assert found.high - found.mean == pytest.approx(half)
    n = 2 * EPISODES
    wanted = 0.5 - (0.5 - 1.96 * (0.25 / n + 1.96**2 / (4 * n**2)) ** 0.5 / (1 + 1.96**2 / n))
    assert half == pytest.approx(wanted if metric == "success_rate" else 2.0227 * 1.0127 / n**0.5, rel=1e-3)


def test_rows_are_compared_episode_by_episode(tmp_path: Path) -> None:
    differences = {(d.split, d.shots): d for d in tables_of(make(tmp_path, better)).differences}
    assert len(differences) == 4
    testing, training = differences["meta-testing", 1], differences["meta-training", 3]
    assert (testing.row, testing.baseline, testing.seeds, testing.pairs) == ("DMIL-High", "DMIL", [0, 1, 2], 120)
    assert testing.mean == pytest.approx(-0.1)
    assert testing.low < -0.1 < testing.high < 0
    assert testing.differs == "yes, lower"
    assert (training.mean, training.low, training.high, training.differs) == (0, 0, 0, "not decided")


def test_pairing_decides_what_the_intervals_alone_do_not(tmp_path: Path) -> None:
    """Tasks of very different difficulty and seeds far apart: all that is common falls out of the difference."""

    def solved(variant: str, seed: int, split: str, shots: int, task: str, episode: int) -> float:
        return float(episode < 5 * (seed + 1) - 3 * (variant == "DMIL"))

    tables = tables_of(make(tmp_path, solved, baseline="DMIL"))
    one, other = (next(c for c in tables.cells if c.row == row) for row in ("DMIL", "DMIL-High"))
    assert one.high is not None
    assert other.low is not None
    assert one.high > other.low
    assert {d.differs for d in tables.differences} == {"yes, higher"}


def test_rows_that_win_in_turn_are_not_distinguished(tmp_path: Path) -> None:
    def solved(variant: str, seed: int, split: str, shots: int, task: str, episode: int) -> float:
        return float((episode % 2 == 0) == (variant == "DMIL"))

    for difference in tables_of(make(tmp_path, solved)).differences:
        assert difference.low < 0 < difference.high
        assert difference.differs == "not decided"


def test_what_was_not_run_is_empty_and_not_zero(tmp_path: Path) -> None:
    sweep = make(tmp_path, better, finished=["DMIL"])
    sweep.of_trial("ml10-DMIL-High-seed-1").mkdir(parents=True)
    sweep.finish("ml10-DMIL-High-seed-1", TrialResult(status="failed", error="it broke | here"))
    tables = write_tables(sweep)
    assert {c.row for c in tables.cells} == {"DMIL"}
    assert not tables.differences
    assert tables.trials == {"finished": 3, "not run": 2, "failed": 1}
    assert tables.failed == {"ml10-DMIL-High-seed-1": "it broke | here"}
    text = (sweep.path / "tables" / "table.md").read_text()
    assert "| DMIL-High |  |  |  |  |" in text
    assert "Failed: ml10-DMIL-High-seed-1: it broke" in text
    assert "3 seeds, 120 episodes" in text


def test_rows_of_other_episodes_are_not_compared_and_the_table_says_so(tmp_path: Path) -> None:
    sweep = make(tmp_path, better)
    for name, trial in sweep.trials.items():
        result = sweep.result(name)
        if trial.variant == "DMIL-High" and result is not None:
            file = tmp_path / result.evaluated["DMIL-High"] / "episodes.jsonl"
            file.write_text(file.read_text().replace('"goal":[]', '"goal":[0.5]'))
    tables = write_tables(sweep)
    assert not tables.differences
    assert {(found.row, found.baseline) for found in tables.unpaired} == {("DMIL-High", "DMIL")}
    text = (sweep.path / "tables" / "table.md").read_text()
    assert "Not compared: DMIL-High with DMIL (ml10, meta-testing, 3-shot): their episodes are others" in text


def test_a_cell_says_how_many_seeds_it_has(tmp_path: Path) -> None:
    sweep = make(tmp_path, better)
    (sweep.of_trial("ml10-DMIL-seed-1") / "result.json").unlink()
    tables = tables_of(sweep)
    assert {tuple(c.seeds) for c in tables.cells if c.row == "DMIL"} == {(0, 2)}
    assert {tuple(d.seeds) for d in tables.differences} == {(0, 2)}


def test_seeds_with_other_episodes_are_no_one_cell(tmp_path: Path) -> None:
    sweep = make(tmp_path, better)
    file = tmp_path / "trained" / "0" / "evaluated" / "one" / "episodes.jsonl"
    file.write_text("".join(file.read_text().splitlines(keepends=True)[1:]))
    with pytest.raises(UserError, match="got rows of DMIL with not as many episodes"):
        tables_of(sweep)


def test_the_table_is_written_in_every_form(tmp_path: Path) -> None:
    sweep = make(tmp_path, better)
    tables = write_tables(sweep)
    folder = sweep.path / "tables"
    rows, differences = (
        list(csv.DictReader((folder / f"{name}.csv").read_text().splitlines())) for name in ("cells", "differences")
    )
    assert len(rows) == len(tables.cells) == 8
    assert float(rows[0]["mean"]) == tables.cells[0].mean
    assert rows[0]["seeds"] == "0 1 2"
    assert float(rows[0]["paper"]) == pytest.approx(0.775)
    assert len(differences) == 4
    assert json.loads((folder / "tables.json").read_text())["name"] == "made-up"
    assert (folder / "table.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "report.html").read_text().startswith("<!doctype html>")
    tex = (folder / "table.tex").read_text()
    assert tex.count(r"\begin{tabular}{lcccc}") == tex.count(r"\end{tabular}") == 1
    body = tex[tex.index(r"\midrule") :].splitlines()[1:3]
    assert [len(re.findall(r"(?<!\\)&", line)) for line in body] == [4, 4]


def test_latex_is_given_no_character_of_its_own(tmp_path: Path) -> None:
    write_tables(make(tmp_path, better, variants={"DMIL_nc": {}, "λ = 1 & 50%": {}}, paper="table7"))
    tex = (tmp_path / "made-up" / "tables" / "table.tex").read_text()
    (one, other) = tex[tex.index(r"\midrule") :].splitlines()[1:3]
    assert one.startswith(r"DMIL\_nc & \shortstack{")
    assert other.startswith(r"$\lambda$ = 1 \& 50\% & ")


def test_suites_may_stand_in_the_rows(tmp_path: Path) -> None:
    variants = {f"K={k}": {"method": {"sub_skills": k}} for k in (2, 4)}
    suites = ["kitchen-topburner", "kitchen-kettle"]
    changes = {"variants": variants, "suites": suites, "rows": "suites", "metric": "score", "paper": "table5"}
    sweep = make(tmp_path, lambda *of: float(of[-1] % 4), splits=["meta-testing"], seeds=[0], **changes)
    tables = tables_of(sweep)
    assert tables.rows == suites
    assert tables.columns == [f"K={k}, meta-testing, {shots}-shot" for k in (2, 4) for shots in (1, 3)]
    papers = {(c.suite, c.row): c.paper.value for c in tables.cells if c.paper}
    assert papers == {
        ("kitchen-topburner", "K=2"): 1.9, ("kitchen-topburner", "K=4"): 1.5,
        ("kitchen-kettle", "K=2"): 2.45, ("kitchen-kettle", "K=4"): 3.15,
    }  # fmt: skip
    assert {c.mean for c in tables.cells} == {1.5}


def test_a_search_is_ranked_and_its_best_is_a_file_of_settings(tmp_path: Path) -> None:
    from services.cli.composition import config_from

    space = {"method.sub_skills": [2, 3, 4, 5], "method.inner_learning_rate": {"low": 1e-3, "high": 1e-2}}
    suite = {"train_tasks": ["reach"], "test_tasks": ["push"]}
    changes = {"variants": {}, "search": {"space": space, "samples": 3}, "paper": None, "seeds": [0]}
    sweep = make(tmp_path, better, settings={"suite": suite, "evaluation": {"every": 500}}, **changes)
    ends = [("stopped", 10, 0.9), ("finished", 20, 0.5), ("finished", 20, 0.7)]
    for name, (status, iteration, held_out) in zip(sweep.trials, ends, strict=True):
        sweep.finish(name, TrialResult.model_validate({"status": status, "iteration": iteration, "held_out": held_out}))
    tables = write_tables(sweep)
    assert [sample.sample for sample in tables.samples] == ["sample 2", "sample 1", "sample 0"]
    best = config_from("ml10-quick", sweep.path / "tables" / "best.yaml")
    assert sub_skills_of(best.method) == sub_skills_of(sweep.trials["ml10-sample-2-seed-0"].config.method)
    text = (sweep.path / "tables" / "table.md").read_text()
    assert text.index("sample 2") < text.index("sample 1") < text.index("sample 0")


def test_a_sweep_s_title_stays_in_its_comment(tmp_path: Path) -> None:
    sweep = make(tmp_path, better, what="$a$\n\\input{/etc/passwd}\nseed: 1")
    write_tables(sweep)
    first, *others = (sweep.path / "tables" / "table.tex").read_text().splitlines()
    assert first.startswith("% $a$ \\input{/etc/passwd} seed: 1: ")
    assert "input" not in "".join(others)


def test_report_tables_finds_a_sweep_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str], complaint) -> None:
    make(tmp_path, better)
    report.run(["tables", "made-up", "--runs", str(tmp_path)])
    printed = capsys.readouterr().out
    for words in ("DMIL-High", "0.800 (0.", "paper 0.396", "yes, lower", "not decided", "3 seeds, 120 episodes"):
        assert words in printed
    assert "got 'none-such'" in complaint(report.run, "tables", "none-such", "--runs", str(tmp_path))
    (tmp_path / "made-up" / "sweep.json").write_text("{}")
    assert "sweep.json: got name" in complaint(report.run, "tables", "made-up", "--runs", str(tmp_path))


def test_outcomes_keep_their_order(tmp_path: Path) -> None:
    sweep = make(tmp_path, lambda *of: float(of[4] == "push" and of[5] == of[1]))
    outcomes = comparison_of(sweep).outcomes[CellKey("DMIL", "ml10", "meta-testing", 3)]
    for seed, seed_outcomes in outcomes.items():
        wanted = np.zeros((2, EPISODES))
        wanted[sorted(TASKS).index("push"), seed] = 1
        np.testing.assert_array_equal(seed_outcomes.outcomes, wanted)
