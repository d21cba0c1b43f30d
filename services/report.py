"""What a run shows at its end: the table on the terminal, and its report folder with tables and plots.

As a program it draws what there is to look at: ``python -m services.report gallery``.
"""

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.axes import Axes

from services.checkpoints import Checkpoint
from services.command_line import ConfigError, exit_code
from services.progress import console
from services.summary import AGAINST_COLLAPSE, COLLAPSED, Summary, rates, table, table_markdown, write_summary
from services.tracking import Tracker, redacted
from services.tracking.spool import Measured, read_spool

__all__ = ["draw_curves", "publish", "read_metrics", "run", "show", "write_report"]

PANELS: Mapping[str, tuple[str, ...]] = {
    "high-level loss": ("high_loss_before", "high_loss_after"),
    "sub-skill loss": ("low_loss_before", "low_loss_after"),
    "continuity loss": ("continuity_loss",),
    "share of states": ("sub_skill_share/",),
    "agreement and usage entropy": ("agreement", "sub_skill_entropy"),
    "gradient norm": ("gradient_norm",),
}
KINDS = {
    "gallery": "services.gallery",
    "tables": "services.sweeps.layout",
    "video": "services.reporting.video",
}
"""What the program draws, and the module that does."""
SMOOTHED = 50
"""A curve is drawn through so many means at most."""


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """Return the metrics of each iteration from a run's ``tracking.jsonl``; an iteration done again counts once.

    Raises:
        SpoolError: names the line that is damaged.
    """
    by_step: dict[int, dict[str, float]] = {}
    for line in read_spool(folder / "tracking.jsonl"):
        if isinstance(line.value, Measured):
            by_step.setdefault(line.value.step, {"iteration": line.value.step}).update(line.value.values)
    return [by_step[step] for step in sorted(by_step)]


def draw_curves(metrics: list[dict[str, float]], path: Path) -> None:
    """Draw losses, sub-skill usage and gradient norms over the iterations."""
    figure, axes = pyplot.subplots(2, 3, figsize=(13, 6.5), layout="constrained")
    for axis, (title, prefixes) in zip(axes.flat, PANELS.items(), strict=True):
        _draw_panel(axis, title, prefixes, metrics)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _draw_panel(axis: Axes, title: str, prefixes: tuple[str, ...], metrics: list[dict[str, float]]) -> None:
    for name in dict.fromkeys(name for row in metrics for name in row if name.startswith(prefixes)):
        rows = [row for row in metrics if name in row]
        size = -(-len(rows) // SMOOTHED)
        parts = [rows[first : first + size] for first in range(0, len(rows), size)]
        means = [sum(row[name] for row in part) / len(part) for part in parts]
        axis.plot([part[-1]["iteration"] for part in parts], means, label=name.replace("_", " "))
    axis.set(title=title, xlabel="iteration")
    if "share" not in title and "agreement" not in title:
        axis.set_yscale("symlog", linthresh=0.01)
    if axis.lines:
        axis.legend(fontsize="small")


def write_report(summary: Summary, folder: Path) -> None:
    """Write ``summary.json``, and the folder ``report`` with the tables and the curves."""
    write_summary(summary, folder / "summary.json")
    report = folder / "report"
    report.mkdir(exist_ok=True)
    (report / "table.md").write_text(table_markdown(summary))
    if metrics := read_metrics(folder):
        draw_curves(metrics, report / "curves.png")


def publish(tracker: Tracker, summary: Summary, folder: Path) -> None:
    """Record the success rates, of each task and in all, the report and the checkpoint on the MLflow run."""
    metrics = rates(summary.rows, summary.sub_skills)
    metrics |= {f"seconds/{phase}": spent for phase, spent in summary.seconds.items()}
    tracker.metrics(Checkpoint(Path(summary.checkpoint)).manifest.iteration, metrics, anew=True)
    tracker.tags({"mlflow.note.content": table_markdown(summary)})
    for path, destination in (
        (folder / "report", "report"),
        (folder / "summary.json", None),
        (folder / "episodes.jsonl", None),
        (Path(summary.checkpoint), "checkpoint"),
    ):
        tracker.artifact(path, destination)


def show(summary: Summary, tracking_uri: str | None = None) -> None:
    """Print the table, the use of sub-skills, the seconds, and where everything is."""
    console.print(table(summary))
    for split, use in summary.sub_skills.items():
        shares = ", ".join(f"{share:.2f}" for share in use.share)
        console.print(
            f"{split}: sub-skills take {shares} of the states; {use.in_use_per_task:.1f} in use per task; "
            f"the high level agrees with the best-fitting sub-skill on {use.agreement:.2f}"
        )
    if any(len(use.share) > 1 and max(use.share) > COLLAPSED for use in summary.sub_skills.values()):
        console.print(
            f"warning: one sub-skill takes nearly all states, so the hierarchy is not used; {AGAINST_COLLAPSE}"
        )
    if failed := {task: count for task, count in summary.failed_attempts.items() if count}:
        console.print("failed expert attempts: " + ", ".join(f"{task} {count}" for task, count in failed.items()))
    console.print("seconds: " + ", ".join(f"{phase} {spent:.0f}" for phase, spent in summary.seconds.items()))
    console.print(f"checkpoint: {summary.checkpoint}\nreport: {summary.report}")
    if tracking_uri is not None:
        console.print(f"MLflow run: {summary.mlflow_run_id or 'not there yet'} at {redacted(tracking_uri)}")
        if tracking_uri.startswith("sqlite"):
            console.print(f"to look at it: mlflow ui --backend-store-uri {tracking_uri} --host 127.0.0.1")


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
