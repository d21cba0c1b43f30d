import json
import shutil
from pathlib import Path

import pytest

from services import report
from services.evaluation.results import write_rows
from services.experiments.finished_run import FinishedRun
from services.reporting.film_strip import example_episode
from services.reporting.page import Commands, DataTable, Prose, Section
from services.reporting.provenance import episodes_of_run, origin_of_run
from services.reporting.run_report import AT_THE_END, write_run_page
from services.reporting.settings import settings_of_run

TITLES = [
    "A new task, step by step", "Success of each task", "Training curves", "Settings", "Where it comes from", "Episodes"
]  # fmt: skip
MOST_BYTES = 5_000_000


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_runs_page_opens_from_disk_whole_and_accessible(finished: FinishedRun, open_page, scheme: str):
    path = finished.folder / "report" / "report.html"
    assert path.stat().st_size < MOST_BYTES
    opened = open_page(path)
    opened.page.emulate_media(color_scheme=scheme)
    assert opened.requests == []
    assert opened.complaints == []
    assert opened.faults() == []
    assert opened.page.title() == "tiny: dmil on ml10"
    assert opened.page.locator("h2").all_inner_texts() == TITLES
    pictures = opened.pictures()
    assert [description.partition(": ")[0] for description, _, _ in pictures] == [
        "An episode from its start to its end",
        "meta-training", "meta-testing", "Success over the iterations", "Losses", "Use of sub-skills", "Outer step",
    ]  # fmt: skip
    assert all(len(description) > 80 and width > 300 and height > 60 for description, width, height in pictures)


def test_its_tables_sort(finished: FinishedRun, open_page):
    opened = open_page(finished.folder / "report" / "report.html")
    assert not opened.page.locator("details table").is_visible(), "the episodes are folded"
    opened.page.locator("summary").click()
    seeds = [int(seed) for seed in opened.sorted_by("Each episode", "seed")]
    assert seeds == sorted(row.seed for row in finished.episodes)
    steps = [int(count) for count in opened.sorted_by("Each episode", "steps")]
    assert steps == sorted(row.steps for row in finished.episodes)
    rates = [float(rate) for rate in opened.sorted_by("Each task", "success rate")]
    assert rates == sorted(rates)
    assert len(rates) == 8
    assert opened.sorted_by("Demonstrations", "demonstrations") == ["12"] * 4


def table(section: Section, caption: str) -> list[list[str | int | float]]:
    (found,) = [part for part in section.parts if isinstance(part, DataTable) and part.caption == caption]
    return [list(row) for row in found.rows]


def lines(section: Section) -> list[str]:
    return [line for part in section.parts if isinstance(part, Commands) for line in part.lines]


def prose(section: Section) -> str:
    return " ".join(part.text for part in section.parts if isinstance(part, Prose))


def test_its_settings_are_explained_those_that_differ_from_the_preset_first(finished: FinishedRun):
    section = settings_of_run(finished)
    assert prose(section).startswith("The preset smoke of dmil on ml10 is the nearest; 5 of ")
    assert [row[:3] for row in table(section, "Settings that differ")] == [
        ["training.iterations", "4", "20"],
        ["training.checkpoint_every", "2", "10"],
        ["evaluation.shots", "1, 2", "1, 3"],
        ["evaluation.fine_tuning_steps", "1", "5"],
        ["evaluation.every", "2", "none"],
    ]
    assert all(row[2] for row in table(section, "Settings as in the preset")), "every setting is explained"


def test_it_says_what_the_run_is_made_of_and_how_to_have_it_again(finished: FinishedRun):
    section = origin_of_run(finished)
    more, again, evaluate, page = lines(section)
    assert more == f"dmil report run {finished.folder} --videos --adaptation"
    assert again == (
        "python -m services.meta_train --suite ml10 --preset smoke --training.iterations 4 "
        "--training.checkpoint-every 2 --evaluation.shots 1 2 --evaluation.fine-tuning-steps 1 --evaluation.every 2"
    )
    assert evaluate == f"dmil evaluate {finished.checkpoint.path}"
    assert page == f"dmil report run {finished.folder}"
    assert finished.origin.commits[0] in prose(section)
    assert finished.summary.checkpoint_digest in prose(section)
    manifest = finished.checkpoint.manifest
    for task, dataset, count, failed, digest in table(section, "Demonstrations"):
        assert str(dataset).startswith(f"metaworld/{task}/")
        assert (count, failed) == (12, finished.summary.failed_attempts[str(task)])
        assert manifest.data[str(task)].startswith(str(digest))
    assert table(section, "Versions") == [list(version) for version in manifest.versions.items()]
    assert {"train", "evaluate", "total"} <= {row[0] for row in table(section, "Time")}


def test_an_older_run_that_tells_less_has_its_page_too(finished: FinishedRun, tmp_path: Path):
    shutil.copytree(finished.folder, tmp_path / "old")
    (tmp_path / "old" / "tracking.jsonl").unlink()
    summary = json.loads((tmp_path / "old" / "summary.json").read_text())
    del summary["demonstrations"]
    (tmp_path / "old" / "summary.json").write_text(json.dumps(summary))
    old = FinishedRun(tmp_path / "old")
    section = origin_of_run(old)
    assert "Commit of the code: unknown" in prose(section)
    assert {tuple(row[1:3]) for row in table(section, "Demonstrations")} == {("", "")}
    write_run_page(old, tmp_path / "page.html")
    assert ">Losses<" not in (tmp_path / "page.html").read_text(), "nothing is known of its iterations"


def test_a_page_of_very_many_episodes_says_what_it_leaves_out(finished: FinishedRun, tmp_path: Path):
    shutil.copytree(finished.folder, tmp_path / "many")
    many = [
        row.model_copy(update={"episode": n, "task": "button-press-topdown-wall"})
        for row in finished.episodes
        for n in range(500)
    ]
    write_rows(tmp_path / "many" / "episodes.jsonl", many)
    run = FinishedRun(tmp_path / "many")
    section = episodes_of_run(run)
    assert prose(section).startswith("The first 6,000 of 8,000 episodes")
    assert lines(section)[0].endswith("--task TASK --shots SHOTS --episode EPISODE")
    write_run_page(run, tmp_path / "page.html", AT_THE_END[1:])  # they cannot be run again
    assert (tmp_path / "page.html").stat().st_size < MOST_BYTES


def test_the_program_writes_it_where_it_should_and_prints_how_to_open_it(finished: FinishedRun, tmp_path: Path, capsys):
    path = tmp_path / "made" / "page.html"
    report.run(["run", "tiny", "--runs", str(finished.folder.parent), "--output", str(path)])
    printed = capsys.readouterr().out
    assert f"report: {path}" in printed
    assert path.as_uri() in printed
    assert "<title>tiny: dmil on ml10</title>" in path.read_text()
    assert ">What failed</h2>" in path.read_text()


def test_what_is_no_finished_run_is_reported_in_words(finished: FinishedRun, tmp_path: Path, complaint, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "RUN: got 'nothing'; wanted a folder with a summary.json" in complaint(report.run, "run", "nothing")
    begun = tmp_path / "runs" / "begun"
    begun.mkdir(parents=True)
    (begun / "config.json").write_text("{}")
    message = complaint(report.run, "run", "begun")
    assert "RUN: got runs/begun, which has not come to its end" in message
    assert "--resume runs/begun" in message
    evaluation = tmp_path / "evaluation"
    evaluation.mkdir()
    shutil.copy(finished.folder / "summary.json", evaluation)
    assert "has neither checkpoints nor evaluation.json" in complaint(report.run, "run", "evaluation")
    message = complaint(report.run, "run", str(finished.folder), "--output", str(tmp_path))
    assert f"--output: got {tmp_path}, a folder; wanted a file" in message
    damaged = tmp_path / "runs" / "damaged"
    shutil.copytree(finished.folder, damaged)
    (damaged / "summary.json").write_text("{}")
    message = complaint(report.run, "run", "damaged")
    assert "summary.json: got" in message
    assert "wanted what a run writes at its end" in message


def test_the_strip_is_of_the_solved_episode_with_the_fewest_shots(finished: FinishedRun):
    row = next(row for row in finished.episodes if row.split == "meta-testing")

    def example(*changes: dict[str, object]) -> int | None:
        rows = [row.model_copy(update={"episode": number, "steps": 9, **of}) for number, of in enumerate(changes)]
        found = example_episode(rows)
        return None if found is None else found.episode

    few, many, solved = {"shots": 1, "success": False}, {"shots": 3, "success": True}, {"shots": 1, "success": True}
    assert example(many, few, solved) == 2
    assert example(few, many) == 1, "solved comes before few shots"
    assert example({**many, "success": False}, few) == 1
    assert example({**few, "split": "meta-training"}, {**few, "steps": 0}) is None
