"""How often a run's adapted policies succeed: the table, and the bars of each task."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

from dmil_core.statistics import Mean, interval_text, mean_score, success_rate
from services.evaluation.controls import HEAD, control_sentences
from services.evaluation.results import EpisodeResult, grouped
from services.evaluation.summary import against_collapse, described, diverged_of, headline
from services.experiments.finished_run import FinishedRun
from services.reporting.drawing import INK, Picture, colour_of, panels, to_picture
from services.reporting.page import DataTable, Notice, Part, Prose, Section
from services.suites.base import Split

SUB_SKILLS = "Sub-skills on "
"""What titles of sections that show them begin with."""
ABREAST = 4
"""Panels side by side at most."""
INCHES_A_TASK = 0.22


def estimates(episodes: Sequence[EpisodeResult], *, scores: bool) -> dict[tuple[Split, int, str], Mean]:
    """Return the success rate, with Wilson's interval, by split, shots and task; of scores the mean with Student's."""
    sound = [row for row in episodes if row.fault is None]
    groups = grouped(sound, lambda row: (row.split, row.shots, row.task))
    if scores:
        return {key: mean_score([float(row.score) for row in rows]) for key, rows in groups.items()}
    return {key: success_rate([row.success for row in rows]) for key, rows in groups.items()}


def _count(mean: Mean, best: int) -> str:
    """Return what a success rate, whose best is 1, or a mean score is over, in a few characters."""
    return f"{round(mean.mean * mean.episodes)}/{mean.episodes}" if best == 1 else f"of {mean.episodes}"


def table_of_all(finished: FinishedRun) -> list[Part]:
    """Return the lead of a run's page: what it is, its success rates beside the paper's, and what to beware of."""
    summary = finished.summary
    head, *rows = headline(summary)
    parts: list[Part] = [Prose(f"Success rates of {described(summary)}.")]
    if summary.faults:
        parts.append(Notice(f"Warning: {summary.faults}."))
    if diverged := diverged_of(summary):
        parts.append(Notice(f"Warning: {diverged}."))
    if summary.collapsed:
        parts.append(
            Notice(
                "Warning: one sub-skill takes nearly all states, so the hierarchy is not used, whatever the success "
                f"rates; {against_collapse(finished.config.method)}.",
                SUB_SKILLS,
            )
        )
    elif use := summary.sub_skills.get("meta-testing"):
        shares = ", ".join(f"{share:.2f}" for share in use.share)
        text = f"Sub-skills take {shares} of the states of new tasks; {use.in_use_per_task:.1f} are in use in a task"
        text += f"{use.in_episodes}."
        parts.append(Notice(text, SUB_SKILLS))
    if finished.has_gone_on:
        parts.append(
            Notice(
                f"Warning: the run was trained on since: the figures are those of {summary.checkpoint}, its last "
                f"checkpoint is {finished.checkpoint.path}. To evaluate that: dmil meta-train --resume "
                f"{finished.folder}"
            )
        )
    intervals = "Wilson's; of scores Student's, over episodes" if finished.best_score > 1 else "Wilson's"
    beside = "; the paper's figures stand beside ours" if any(cell.paper for cell in summary.rows) else ""
    parts.append(DataTable("Success rates", head, rows))
    if summary.controls:
        rows = [row.fields for row in summary.controls]
        parts.append(DataTable("Controls, in the same episodes of new tasks", HEAD, rows))
        parts.append(Prose(" ".join(f"{sentence}." for sentence in control_sentences(summary.controls))))
    return [*parts, Prose(f"Shots are demonstrations adapted to. Intervals are {intervals}{beside}.")]


def rates_of_tasks(finished: FinishedRun) -> Section:
    """Return the section with each task's success rate, and its score where there are scores."""
    parts: list[Part] = []
    rates = estimates(finished.episodes, scores=False)
    best = finished.best_score
    scores = estimates(finished.episodes, scores=True) if best > 1 else {}
    splits: list[Split] = [split for split, _, _ in rates]
    for split in dict.fromkeys(splits):
        parts.append(_bars(split, rates, "success rate", 1))
        if scores:
            parts.append(_bars(split, scores, "mean score", best))
    head = ["task", "split", "shots", "successes", "success rate", "95% interval"]
    rows = []
    for (split, shots, task), rate in rates.items():
        row = [task, split, shots, _count(rate, 1), f"{rate.mean:.3f}", interval_text(rate.low, rate.high, 3)]
        if scores:
            score = scores[split, shots, task]
            row += [f"{score.mean:.2f}", interval_text(score.low, score.high, 2)]
        rows.append(row)
    head += [f"score of {best}", "interval of the score"] if scores else []
    return Section("Success of each task", [*parts, DataTable("Each task", head, rows)])


def _bars(split: Split, by_task: Mapping[tuple[Split, int, str], Mean], what: str, best: int) -> Picture:
    """Draw a split's tasks, the best on top in all panels alike, one panel for each number of shots."""
    by_shots: dict[int, dict[str, Mean]] = defaultdict(dict)
    for (of_split, shots, task), estimate in by_task.items():
        if of_split == split:
            by_shots[shots][task] = estimate
    means = {task: sum(of[task].mean for of in by_shots.values()) for task in by_shots[min(by_shots)]}
    tasks = sorted(means, key=lambda task: (means[task], task))
    columns = min(len(by_shots), ABREAST)
    rows = -(-len(by_shots) // columns)
    height = rows * (0.9 + INCHES_A_TASK * len(tasks))
    with panels(rows, columns, width=3.2 + 2.3 * columns, height=height) as (figure, axes):
        for index, (axis, shots) in enumerate(zip(axes, sorted(by_shots), strict=False)):
            of_tasks = [by_shots[shots][task] for task in tasks]
            reach = list(zip(*(estimate.reach for estimate in of_tasks), strict=True))
            axis.barh(range(len(tasks)), [e.mean for e in of_tasks], color=colour_of(0), alpha=0.75, height=0.7)
            axis.errorbar([e.mean for e in of_tasks], range(len(tasks)), xerr=reach, fmt="none", ecolor=INK, capsize=2)
            over_all = sum(estimate.mean for estimate in of_tasks) / len(of_tasks)
            axis.axvline(over_all, linestyle="dashed", color=colour_of(3))
            for place, estimate in enumerate(of_tasks):
                count = _count(estimate, best)
                axis.text(1.02, place, count, transform=axis.get_yaxis_transform(), va="center", size=7.5)
            axis.set(title=f"{shots}-shot: {over_all:.2f} on average", xlabel=what, xlim=(0, best * 1.02))
            axis.set_yticks(range(len(tasks)), tasks if index % columns == 0 else [])
            axis.set_ylim(-0.6, len(tasks) - 0.4)
            axis.grid(visible=False, axis="y")
        for axis in axes[len(by_shots) :]:
            axis.remove()
        return to_picture(figure, f"{split}: {what} of each task", _describe(by_shots, tasks, what))


def _describe(by_shots: Mapping[int, Mapping[str, Mean]], tasks: Sequence[str], what: str) -> str:
    texts = []
    for shots in sorted(by_shots):
        rates = {task: estimate.mean for task, estimate in by_shots[shots].items()}
        mean, worst, best = sum(rates.values()) / len(rates), tasks[0], tasks[-1]
        ends = f", from {worst} with {rates[worst]:.2f} to {best} with {rates[best]:.2f}" if len(rates) > 1 else ""
        texts.append(f"{shots}-shot {mean:.2f} on average (dashed){ends}")
    what_it_is = f"Bars are a task's {what}, whiskers its 95% interval; the order is that of the mean over all shots"
    return f"{what_it_is}: {'; '.join(texts)}."
