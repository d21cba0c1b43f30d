"""What a run shows at its end, on the terminal and as tables; its page is `reporting.run_report`'s.

As a program it draws what there is to look at: ``python -m services.report gallery``.
"""

import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from services.cli.arguments import ConfigError, exit_code
from services.cli.progress import console
from services.evaluation.summary import AGAINST_COLLAPSE, Summary, rates, table, table_markdown, write_summary
from services.storage.checkpoints import Checkpoint
from services.tracking import Tracker

__all__ = ["PAGE", "publish", "run", "show", "write_report"]

PAGE = "report.html"
"""In a run's report folder."""
KINDS = {
    "run": "services.reporting.run_report",
    "compare": "services.sweeps.compare",
    "sub-skills": "services.reporting.sub_skill_report",
    "video": "services.reporting.video",
    "gallery": "services.reporting.gallery",
    "tables": "services.sweeps.table_formats",
}
"""What the program draws, and the module that does."""


def write_report(summary: Summary, folder: Path) -> None:
    """Write ``summary.json``, and the folder ``report`` with the tables."""
    write_summary(summary, folder / "summary.json")
    report = folder / "report"
    report.mkdir(exist_ok=True)
    (report / "table.md").write_text(table_markdown(summary))


def publish(tracker: Tracker, summary: Summary, folder: Path) -> None:
    """Record the success rates, of each task and in all, the report and the episodes on the MLflow run."""
    metrics = rates(summary.rows, summary.sub_skills)
    metrics |= {f"seconds/{phase}": spent for phase, spent in summary.seconds.items()}
    tracker.metrics(Checkpoint(Path(summary.checkpoint)).manifest.iteration, metrics, anew=True)
    tracker.tags({"mlflow.note.content": table_markdown(summary)})
    for path, destination in (
        (folder / "report", "report"),
        (folder / "summary.json", None),
        (folder / "episodes.jsonl", None),
    ):
        tracker.artifact(path, destination)


def show(summary: Summary, whereabouts: Sequence[str] = ()) -> None:
    """Print the table, the use of sub-skills, the seconds, and where everything is, the MLflow run too if given."""
    console.print(table(summary))
    for split, use in summary.sub_skills.items():
        shares = ", ".join(f"{share:.2f}" for share in use.share)
        console.print(
            f"{split}: sub-skills take {shares} of the states; {use.in_use_per_task:.1f} in use per task; "
            f"the high level agrees with the best-fitting sub-skill on {use.agreement:.2f}"
        )
    if summary.collapsed:
        console.print(
            f"warning: one sub-skill takes nearly all states, so the hierarchy is not used; {AGAINST_COLLAPSE}"
        )
    if failed := {task: count for task, count in summary.failed_attempts.items() if count}:
        console.print("failed expert attempts: " + ", ".join(f"{task} {count}" for task, count in failed.items()))
    console.print("seconds: " + ", ".join(f"{phase} {spent:.0f}" for phase, spent in summary.seconds.items()))
    page = Path(summary.report) / PAGE
    console.print(f"checkpoint: {summary.checkpoint}\nreport: {page if page.exists() else summary.report}")
    for line in whereabouts:
        console.print(line, markup=False, soft_wrap=True)


def run(arguments: Sequence[str]) -> None:
    """Run the program that draws what the first argument names.

    Raises:
        ConfigError: if it names nothing that can be drawn.
    """
    if arguments and arguments[0] in {"--help", "-h"}:
        console.print("usage: python -m services.report KIND [--help]\n")
        for kind, module in KINDS.items():
            console.print(f"  {kind:10}{(import_module(module).__doc__ or '').splitlines()[0]}", markup=False)
        return
    if not arguments or arguments[0] not in KINDS:
        got = arguments[0] if arguments else "nothing"
        raise ConfigError(f"report: got {got}; wanted one of {', '.join(KINDS)}, each with a --help of its own")
    import_module(KINDS[arguments[0]]).run(arguments[1:])


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
