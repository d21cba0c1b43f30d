"""From result rows to the table that a run ends with."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int
from pydantic import BaseModel
from rich.table import Table

from dmil_core.checkpoint import Checkpoint
from dmil_core.files import write_file
from dmil_core.settings import MethodConfig
from dmil_core.statistics import interval_text, mean_score, share_entropy, success_rate
from services.cli.escapes import for_markdown
from services.evaluation.controls import HEAD, ControlRow, control_sentences
from services.evaluation.paper_results import Published, figure_of
from services.evaluation.results import AdaptationResult, EpisodeResult, grouped
from services.storage.run_folders import SUMMARY
from services.suites.base import Split

BEST = 5
"""So many of a task's episodes count in the authors' own figure for the kitchen."""
COLLAPSED = 0.99
"""A sub-skill with more of the states than this leaves nothing to the others."""


def against_collapse(method: MethodConfig) -> str:
    """Return what may help where one sub-skill takes nearly all states, without what is so already."""
    proposed = {
        "balance": ("none", "--method.balance sinkhorn"),
        "labels_until": (0, "--method.labels-until above 0"),
    }
    settings = [flag for name, (value, flag) in proposed.items() if getattr(method, name, None) == value]
    if getattr(method, "continuity_weight", 0) > 0:
        settings.append("--method.continuity-weight 0")
    return ", ".join([*settings, "another --seed or a smaller --training.learning-rate may help"])


class Evaluation(NamedTuple):
    """What an evaluation found, and of what."""

    checkpoint: Checkpoint
    protocol: str
    best_score: int
    """Of an episode in which all is done, see `TaskSuite`."""
    failed_attempts: dict[str, int]
    demonstrations: dict[str, int]
    """Of each task."""
    episodes: list[EpisodeResult]
    adaptations: list[AdaptationResult]


class Score(BaseModel):
    """Sub-tasks done in an episode."""

    best: int
    """Of an episode in which all are done."""
    mean: float
    deviation: float | None
    """Standard deviation over episodes; a single one has none, and no interval."""
    low: float | None
    high: float | None
    mean_of_best: float
    """The mean of the five best episodes of each task, which the authors' script prints."""
    per_task: dict[str, float]


class SummaryRow(BaseModel):
    """The success rate of one split and size of support set."""

    suite: str
    split: Split
    shots: int
    episodes: int
    success_rate: float
    low: float
    high: float
    per_task: dict[str, float]
    score: Score | None
    """In suites that count sub-tasks."""
    paper: Published | None
    """The paper's success rate for DMIL, or its score where there are scores."""
    diverged: int = 0
    """Adaptations after which an action was not finite: such episodes end there, as failures."""


class SubSkillShares(BaseModel):
    """How the adapted policies of one split use their sub-skills on held-out demonstrations."""

    share: list[float]
    """Of all states, the part that each sub-skill takes."""
    entropy: float
    """Of these shares: 0 if one takes all, 1 if all take the same."""
    in_use_per_task: float
    """Sub-skills with over a tenth of a task's states, on average over adaptations."""
    agreement: float
    """Of all states, the part where the high level takes the sub-skill that fits the demonstrated action best."""
    in_use_per_episode: float | None = None
    """Sub-skills that act in over a tenth of an episode's steps, on average over episodes; older files have none."""
    switches_per_episode: float | None = None
    """Changes of the sub-skill that acts, on average over episodes; older files have none."""

    @property
    def in_episodes(self) -> str:
        """What there is to say of episodes, in words."""
        if self.in_use_per_episode is None or self.switches_per_episode is None:
            return ""
        return f", {self.in_use_per_episode:.1f} in an episode, with {self.switches_per_episode:.1f} switches"


class Summary(BaseModel):
    """``summary.json``: what came of a run."""

    method: str
    environment_steps: int
    """Steps that an online method took in the environments of meta-training tasks."""
    rows: list[SummaryRow]
    seconds: dict[str, float]
    sub_skills: dict[Split, SubSkillShares]
    protocol: str
    seed: int
    checkpoint: str
    checkpoint_digest: str
    report: str
    mlflow_run_id: str | None
    failed_attempts: dict[str, int]
    """Attempts of each task's expert that were no success and so no demonstration."""
    demonstrations: dict[str, int] = {}
    """Of each task, those held out among them; older files have none."""
    controls: list[ControlRow] = []
    """Beside the run on meta-testing tasks, where the settings ask for any."""
    against_collapse: str = ""
    """What may help where one sub-skill takes nearly all states; older files have nothing."""
    faults: str = ""
    """In words, the episodes that do not count because the simulator gave numbers that are not finite."""

    @property
    def collapsed(self) -> bool:
        """Whether one of several sub-skills takes nearly all states."""
        return any(len(use.share) > 1 and max(use.share) > COLLAPSED for use in self.sub_skills.values())


def diverged_of(summary: Summary) -> str:
    """Return in words how many adaptations diverged; nothing where none did."""
    if not (count := sum(row.diverged for row in summary.rows)):
        return ""
    return (
        f"{count} adaptation{'s' if count > 1 else ''} diverged: an action was not finite, and the episode counts as a "
        "failure; fewer --evaluation.fine-tuning-steps or a smaller --evaluation.learning-rate may help"
    )


def faults_of(episodes: Sequence[EpisodeResult]) -> str:
    """Return in words how many episodes the simulator spoiled, and the first of them; nothing where there are none."""
    faulty = [row for row in episodes if row.fault is not None]
    if not faulty:
        return ""
    first = faulty[0]
    return (
        f"{len(faulty)} of {len(episodes)} episodes do not count: the simulator gave an observation that is not "
        f"finite, first in {first.label}, after step {first.fault}"
    )


def summary_rows(episodes: Sequence[EpisodeResult], best_score: int, method: MethodConfig) -> list[SummaryRow]:
    """Return one cell for each split and size of support set, with Wilson intervals, without `faults_of`.

    Where the score of an episode in which all is done is more than 1, scores are given too.
    """
    rows = []
    sound = [row for row in episodes if row.fault is None]
    for (suite, split, shots), of_group in grouped(sound, lambda row: (row.suite, row.split, row.shots)).items():
        rate = success_rate([row.success for row in of_group])
        by_task = grouped(of_group, lambda row: row.task)
        per_task = {task: float(np.mean([row.success for row in of_task])) for task, of_task in by_task.items()}
        rows.append(
            SummaryRow(
                suite=suite,
                split=split,
                shots=shots,
                episodes=rate.episodes,
                success_rate=rate.mean,
                low=rate.low,
                high=rate.high,
                per_task=per_task,
                score=_score(of_group, best_score) if best_score > 1 else None,
                paper=figure_of(method, suite, split, shots),
                diverged=len({(row.task, row.draw) for row in of_group if row.diverged}),
            )
        )
    return sorted(rows, key=lambda cell: (cell.suite, cell.split == "meta-testing", cell.shots))


def _score(rows: Sequence[EpisodeResult], best: int) -> Score:
    mean = mean_score([float(row.score) for row in rows])
    spread = {"deviation": mean.deviation, "low": mean.low, "high": mean.high}
    by_task = {task: [row.score for row in of_task] for task, of_task in grouped(rows, lambda row: row.task).items()}
    return Score(
        best=best,
        mean=mean.mean,
        **{name: None if np.isnan(value) else value for name, value in spread.items()},
        mean_of_best=float(np.mean([np.mean(sorted(scores)[-BEST:]) for scores in by_task.values()])),
        per_task={task: float(np.mean(scores)) for task, scores in by_task.items()},
    )


def sub_skill_shares(
    adaptations: Sequence[AdaptationResult], episodes: Sequence[EpisodeResult] = ()
) -> dict[Split, SubSkillShares]:
    """Return the use of sub-skills in each split, where there are several."""
    use: dict[Split, SubSkillShares] = {}
    for split in ("meta-training", "meta-testing"):
        rows = [row for row in adaptations if row.split == split and row.steps]
        if not rows or len(rows[0].sub_skill_steps) == 1:
            continue
        steps = np.array([row.sub_skill_steps for row in rows])
        share = steps.sum(0) / steps.sum()
        use[split] = SubSkillShares(
            share=share.tolist(),
            entropy=share_entropy(share),
            in_use_per_task=float(_in_use(steps).mean()),
            agreement=sum(row.agreeing for row in rows) / sum(row.steps for row in rows),
            **_use_in_episodes([row for row in episodes if row.split == split and row.steps]),
        )
    return use


def _in_use(steps: Int[np.ndarray, "rows sub_skills"]) -> Int[np.ndarray, " rows"]:
    """Return how many sub-skills have over a tenth of a row's steps."""
    return (steps / steps.sum(1, keepdims=True) > 0.1).sum(1)


def _use_in_episodes(episodes: Sequence[EpisodeResult]) -> dict[str, float]:
    switches = [row.sub_skill_switches for row in episodes if row.sub_skill_switches is not None]
    if not switches:
        return {}
    in_use = [_in_use(np.array([row.sub_skill_steps])) for row in episodes]
    return {"in_use_per_episode": float(np.mean(in_use)), "switches_per_episode": float(np.mean(switches))}


def rates(rows: Sequence[SummaryRow], use: Mapping[Split, SubSkillShares]) -> dict[str, float]:
    """Return the metrics of an evaluation by the names they are tracked under: of each task, and in all."""
    metrics: dict[str, float] = {}
    for cell in rows:
        name, score = f"{cell.split}/{cell.shots}-shot", cell.score
        metrics |= {f"diverged/{name}": float(cell.diverged)} if cell.diverged else {}
        means: dict[str, float | None] = {"success_rate": cell.success_rate, "success_rate_low": cell.low}
        means |= {"success_rate_high": cell.high, "episodes": float(cell.episodes)}
        if score is not None:
            means |= {"score": score.mean, f"score_best_{BEST}": score.mean_of_best}
            means |= {"score_low": score.low, "score_high": score.high}
        metrics |= {f"{metric}/{name}": value for metric, value in means.items() if value is not None}
        metrics |= {f"task_success_rate/{name}/{task}": rate for task, rate in cell.per_task.items()}
    for split, of_split in use.items():
        metrics |= {f"agreement/{split}": of_split.agreement, f"sub_skill_entropy/{split}": of_split.entropy}
        if (switches := of_split.switches_per_episode) is not None:
            metrics[f"sub_skill_switches/{split}"] = switches
    return metrics


def summarise(
    evaluation: Evaluation,
    *,
    seconds: dict[str, float],
    folder: Path,
    mlflow_run_id: str | None = None,
    controls: Sequence[ControlRow] = (),
) -> Summary:
    """Return the summary of an evaluation whose report is to lie in `folder`."""
    config = evaluation.checkpoint.manifest.config
    return Summary(
        method=config.method.name,
        environment_steps=evaluation.checkpoint.manifest.environment_steps,
        rows=summary_rows(evaluation.episodes, evaluation.best_score, config.method),
        seconds=seconds,
        sub_skills=sub_skill_shares(evaluation.adaptations, evaluation.episodes),
        protocol=evaluation.protocol,
        seed=config.seed,
        checkpoint=str(evaluation.checkpoint.path),
        checkpoint_digest=evaluation.checkpoint.digest,
        report=str(folder / "report"),
        mlflow_run_id=mlflow_run_id,
        failed_attempts=evaluation.failed_attempts,
        demonstrations=evaluation.demonstrations,
        controls=list(controls),
        against_collapse=against_collapse(config.method),
        faults=faults_of(evaluation.episodes),
    )


def table(summary: Summary) -> Table:
    """Lay the summary out for the terminal."""
    head, *rows = headline(summary)
    view = Table(title=f"Success rates of {described(summary)}")
    for column in head:
        named = column in ("suite", "split")
        view.add_column(column, justify="left" if named else "right", no_wrap=named)
    for row in rows:
        view.add_row(*row)
    return view


def control_table(summary: Summary) -> Table:
    """Lay the controls out for the terminal."""
    view = Table(title="Controls, in the same episodes")
    for number, column in enumerate(HEAD):
        view.add_column(column, justify="right" if number else "left")
    for row in summary.controls:
        view.add_row(*row.fields)
    return view


def table_markdown(summary: Summary) -> str:
    """Lay the summary out as Markdown, with the success rate, and the score if there is one, of each task below."""
    head, *rows = headline(summary)
    lines = markdown_rows(head, rows)
    for split in dict.fromkeys(cell.split for cell in summary.rows):
        cells = [cell for cell in summary.rows if cell.split == split]
        head = ["task", *(f"{cell.shots}-shot" for cell in cells)]
        tasks = ([task, *(_of_task(cell, task) for cell in cells)] for task in sorted(cells[0].per_task))
        lines += ["", *markdown_rows(head, tasks)]
    if summary.controls:
        rows = (row.fields for row in summary.controls)
        sentences = [f"{sentence}." for sentence in control_sentences(summary.controls)]
        lines += ["", *markdown_rows(HEAD, rows), "", *sentences]
    warnings = "".join(f"{for_markdown(words)}.\n\n" for words in (summary.faults, diverged_of(summary)) if words)
    return f"Success rates of {for_markdown(described(summary))}.\n\n{warnings}" + "\n".join(lines) + "\n"


def described(summary: Summary) -> str:
    """Return of what a summary is: the method, the protocol, the seed, and its steps in environments."""
    steps = f"; {summary.environment_steps:,} environment steps in meta-training" if summary.environment_steps else ""
    return f"{summary.method} ({summary.protocol}; seed {summary.seed}{steps})"


def headline(summary: Summary) -> list[list[str]]:
    """Return the head and the rows of the table; columns that no row has anything in are left out."""
    columns = ["suite", "split", "shots", "successes", "success rate", "95% interval", "diverged adaptations"]
    rows = [_fields(cell) for cell in summary.rows]
    best = max((cell.score.best for cell in summary.rows if cell.score), default=1)
    tables = {cell.paper.table for cell in summary.rows if cell.paper}
    columns += [f"score of {best}", "95% interval", f"best {BEST} a task", ", ".join(["paper", *sorted(tables)])]
    return without_empty_columns(columns, rows)


def without_empty_columns(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return the head and the rows without the columns that no row has anything in."""
    kept = [index for index in range(len(head)) if any(row[index] for row in rows)]
    return [[fields[index] for index in kept] for fields in (head, *rows)]


def _fields(cell: SummaryRow) -> list[str]:
    successes = f"{round(cell.success_rate * cell.episodes)}/{cell.episodes}"
    fields = [cell.suite, cell.split, str(cell.shots), successes, f"{cell.success_rate:.3f}"]
    fields += [interval_text(cell.low, cell.high, 3), str(cell.diverged or "")]
    if (score := cell.score) is None:
        fields += ["", "", ""]
    else:
        spread = "" if score.deviation is None else f" ± {score.deviation:.2f}"
        fields += [f"{score.mean:.2f}{spread}", interval_text(score.low, score.high, 2), f"{score.mean_of_best:.2f}"]
    return [*fields, "" if cell.paper is None else cell.paper.text(3 if score is None else 2)]


def _of_task(cell: SummaryRow, task: str) -> str:
    score = "" if cell.score is None else f", score {cell.score.per_task[task]:.2f}"
    return f"{cell.per_task[task]:.2f}{score}"


def markdown_rows(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table in Markdown; its fields are plain text, but for ``<br>``."""
    lines = [["<br>".join(map(for_markdown, field.split("<br>"))) for field in fields] for fields in (head, *rows)]
    return [f"| {' | '.join(fields)} |" for fields in (lines[0], ["---"] * len(head), *lines[1:])]


def write_summary(summary: Summary, folder: Path) -> None:
    """Write ``summary.json``."""
    write_file(folder, SUMMARY, summary.model_dump_json(indent=1) + "\n")
