"""What a run or an evaluation writes, records and shows at its end."""

from collections.abc import Sequence
from pathlib import Path

from dmil_core.checkpoint import Checkpoint
from dmil_core.files import inside, write_file
from services.cli.progress import Clock, aside, console
from services.evaluation.controls import ControlRow, control_sentences
from services.evaluation.summary import (
    Evaluation,
    Summary,
    control_table,
    diverged_of,
    rates,
    summarise,
    table,
    table_markdown,
    write_summary,
)
from services.experiments.finished_run import PAGE, REPORT, FinishedRun
from services.storage.run_folders import SUMMARY
from services.tracking.spool import NOTE
from services.tracking.tracker import Tracker


def conclude(
    evaluation: Evaluation, controls: Sequence[ControlRow], folder: Path, tracker: Tracker, clock: Clock
) -> Summary:
    """Summarise what was evaluated, write that and its page to `folder`, and record it on the MLflow run."""
    summary = summarise(
        evaluation, seconds=clock.seconds, folder=folder, mlflow_run_id=tracker.run_id, controls=controls
    )
    write_report(summary, folder)
    from services.reporting.run_report import write_run_page  # takes seconds to import: not before the work

    with aside("the page"):
        write_run_page(FinishedRun(folder), inside(folder, REPORT) / PAGE)
    publish(tracker, summary, folder)
    return summary


def write_report(summary: Summary, folder: Path) -> None:
    """Write ``summary.json``, and the folder ``report`` with the tables."""
    write_summary(summary, folder)
    write_file(folder, f"{REPORT}/table.md", table_markdown(summary))


def publish(tracker: Tracker, summary: Summary, folder: Path) -> None:
    """Record the success rates, of each task and in all, the report and the episodes on the MLflow run."""
    metrics = rates(summary.rows, summary.sub_skills)
    metrics |= {f"seconds/{phase}": spent for phase, spent in summary.seconds.items()}
    if summary.faults:
        tracker.tags({"simulator_faults": summary.faults})
    tracker.metrics(Checkpoint(Path(summary.checkpoint)).manifest.iteration, metrics, anew=True)
    tracker.tags({NOTE: table_markdown(summary)})
    tracker.artifact(folder / REPORT, REPORT)
    for name in (SUMMARY, "episodes.jsonl"):
        tracker.artifact(folder / name)


def show(summary: Summary, addresses: Sequence[str] = ()) -> None:
    """Print the table, the use of sub-skills, the seconds, and where everything is, the MLflow run too if given."""
    console.print(table(summary))
    if summary.controls:
        console.print(control_table(summary))
        for sentence in control_sentences(summary.controls):
            console.print(sentence)
    for split, use in summary.sub_skills.items():
        shares = ", ".join(f"{share:.2f}" for share in use.share)
        console.print(
            f"{split}: sub-skills take {shares} of the states; {use.in_use_per_task:.1f} in use in a task"
            f"{use.in_episodes}; the high level agrees with the best-fitting sub-skill on {use.agreement:.2f}"
        )
    if summary.collapsed:
        console.print(
            f"warning: one sub-skill takes nearly all states, so the hierarchy is not used; {summary.against_collapse}"
        )
    if diverged := diverged_of(summary):
        console.print(f"warning: {diverged}")
    if summary.faults:
        console.print(f"warning: {summary.faults}")
    if failed := {task: count for task, count in summary.failed_attempts.items() if count}:
        console.print("failed expert attempts: " + ", ".join(f"{task} {count}" for task, count in failed.items()))
    console.print("seconds: " + ", ".join(f"{phase} {spent:.0f}" for phase, spent in summary.seconds.items()))
    page = Path(summary.report) / PAGE
    console.print(f"checkpoint: {summary.checkpoint}\nreport: {page if page.exists() else summary.report}")
    for line in addresses:
        console.print(line, soft_wrap=True)
