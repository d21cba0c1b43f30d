"""Write a page on the sub-skills that runs take in some tasks, side by side: the paper's Figure 4.

For example, with the variants of a sweep: dmil report sub-skills DMIL=trained/DIGEST OptionGAIL=NAME --tasks
hand-insert push-around-wall. The tasks may be any of the runs' kind of robot, also such as no run has; the experts
demonstrate those that there are no demonstrations of.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from dmil_core.errors import UserError
from services.cli.arguments import parse
from services.cli.places import announce
from services.reporting.options import EMBEDDING_SHOTS, PERPLEXITY, SEED
from services.storage.run_folders import CONFIG, find_folder

if TYPE_CHECKING:
    from services.experiments.finished_run import FinishedRun
    from services.reporting.page import DataTable
    from services.reporting.run_group import RunGroup


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``report sub-skills``."""

    which: tyro.conf.Positional[tuple[str, ...]]
    """Runs, by name or folder, or what sweeps have trained, as trained/DIGEST; LABEL=RUN has the page call it so."""
    tasks: tuple[str, ...] | None = None
    """Tasks to show; they need not be the runs', only of their kind of robot. If not given, the first run's
    meta-testing tasks, at most 4."""
    shots: int = 1
    """Demonstrations to adapt to for timelines and statistics; one, as in Figure 4b."""
    rollouts: int = 3
    """Episodes to run for each run and task, before adaptation and after."""
    embedding_shots: int = EMBEDDING_SHOTS
    """Demonstrations to adapt to for the t-SNE; three, as in Figure 4a."""
    perplexity: float = PERPLEXITY
    """Of the t-SNE."""
    seed: int = SEED
    """Of the t-SNE."""
    output: Path = Path("sub-skills.html")
    """File to write."""
    runs: Path = Path("runs")
    """The folder that runs' own folders are in."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    _check(args)
    announce(page=(args.output, "--output FILE"))
    import torch

    from services.reporting.embedding import embedding_section
    from services.reporting.page import Prose, write_page
    from services.reporting.run_group import group_runs
    from services.reporting.sub_skills import sub_skill_sections

    torch.set_num_threads(1)
    group = group_runs(_labelled_runs(args.which, args.runs), args.tasks)
    sections = sub_skill_sections(group, args.shots, args.rollouts)
    sections.append(embedding_section(group, args.embedding_shots, args.perplexity, args.seed))
    lead = [
        Prose("Which sub-skill the high level takes, and where, before adaptation to a task and after it."),
        _runs_table(group),
    ]
    write_page(args.output, f"Sub-skills on {', '.join(group.held_out)}", lead, sections)


def _check(args: Arguments) -> None:
    """Refuse numbers that nothing can be made of."""
    least = {"shots": 1, "rollouts": 0, "embedding_shots": 1, "perplexity": 1, "seed": 0}
    for name, bound in least.items():
        if not (got := getattr(args, name)) >= bound:
            raise UserError(f"--{name.replace('_', '-')}: got {got}; wanted at least {bound}")


def _labelled_runs(which: Sequence[str], runs: Path) -> "dict[str, FinishedRun]":
    """Return the runs by their labels."""
    from services.experiments.finished_run import FinishedRun
    from services.reporting.run_group import has_sub_skills

    by_label: dict[str, FinishedRun] = {}
    for named in which:
        label, _, name = named.rpartition("=")
        run = FinishedRun(find_folder(name, runs, CONFIG, "RUN"))
        if (label := label or run.name) in by_label:
            raise UserError(f"RUN: got {label} twice; wanted each once, or labels to tell them apart: LABEL=RUN")
        by_label[label] = run
    if not any(map(has_sub_skills, by_label.values())):
        got = ", ".join(f"{label} of {run.config.method.name}" for label, run in by_label.items()) or "none"
        raise UserError(f"RUN: got {got}; wanted at least one of a method with several sub-skills, as dmil")
    return by_label


def _runs_table(group: "RunGroup") -> "DataTable":
    from services.reporting.page import DataTable

    rows = []
    for label, run in group.runs.items():
        config, checkpoint = run.config, run.checkpoint
        method = [config.method.name, getattr(config.method, "sub_skills", "none"), config.suite.name, config.seed]
        tuning = [config.evaluation.fine_tuning_steps, f"{config.evaluation.learning_rate:g}"]
        rows.append([label, *method, checkpoint.manifest.iteration, *tuning, checkpoint.digest[:12]])
    head = ["run", "method", "sub-skills", "suite", "seed", "iterations", "fine-tuning steps", "learning rate"]
    return DataTable("The runs", [*head, "checkpoint"], rows)
