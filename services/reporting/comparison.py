"""Finished runs as the rows of a comparison: those that differ only in the seed are one row."""

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from itertools import takewhile

from dmil_core.errors import UserError
from services.evaluation.comparison import CellKey, Comparison, SeedEvaluation
from services.experiments.finished_run import FinishedRun


def compare_runs(runs: Sequence[FinishedRun], baseline: str | None = None) -> Comparison:
    """Return finished runs as they are put side by side.

    The baseline is a row or a run: that of the first run if none is named.

    Raises:
        UserError: for runs of different suites, the same run twice, or a baseline that is none of them.
    """
    names = _names(runs)
    suites = {name: run.config.suite.name for name, run in names.items()}
    if len(set(suites.values())) > 1:
        text = ", ".join(f"{name} of {suite}" for name, suite in suites.items())
        raise UserError(f"RUN: got {text}; wanted runs of one suite: rates on different tasks cannot be compared")
    rows = _rows(names)
    evaluations = [_evaluation(row, name, names[name]) for row, run_names in rows.items() for name in run_names]
    named = baseline or next(iter(names))
    baseline_row = next((row for row, run_names in rows.items() if named == row or named in run_names), None)
    if baseline_row is None:
        raise UserError(f"--baseline: got {named!r}; wanted one of {', '.join([*rows, *names])}")
    cells = [cell for run in runs for cell in run.summary.rows]
    suite = evaluations[0].suite
    return Comparison(
        rows=list(rows),
        suites=[suite],
        splits=list(dict.fromkeys(cell.split for cell in cells)),
        shots=sorted({cell.shots for cell in cells}),
        metric="score" if any(cell.score for cell in cells) else "success_rate",
        by="variants",
        baseline=baseline_row,
        evaluations=evaluations,
        published={
            CellKey(row, suite, cell.split, cell.shots): cell.paper
            for row, run_names in rows.items()
            for cell in names[run_names[0]].summary.rows
            if cell.paper is not None
        },
    )


def _names(runs: Sequence[FinishedRun]) -> dict[str, FinishedRun]:
    """Return runs by the name of their folder, or where two have the same, by its path."""
    count = Counter(run.name for run in runs)
    names = {run.name if count[run.name] == 1 else str(run.folder): run for run in runs}
    folders = Counter(run.folder.resolve() for run in runs)
    if twice := [folder for folder, times in folders.items() if times > 1]:
        raise UserError(f"RUN: got {twice[0]} twice; wanted each run once")
    return names


def _rows(runs: dict[str, FinishedRun]) -> dict[str, list[str]]:
    """Return the names of the runs of each row: those that differ only in the seed."""
    groups: dict[tuple[str, int], list[str]] = defaultdict(list)
    times: Counter[tuple[str, int]] = Counter()
    for name, run in runs.items():
        settings = run.config.model_dump_json(exclude={"seed"})
        # The same seed again, as of other code, is another row.
        groups[settings, times[settings, run.config.seed]].append(name)
        times[settings, run.config.seed] += 1
    rows = {_row_name(names): names for names in groups.values()}
    return rows if len(rows) == len(groups) else {", ".join(names): names for names in groups.values()}


def _row_name(names: Sequence[str]) -> str:
    """Return what the names of one row's runs have in common, as dmil of dmil-seed-0 and dmil-seed-1."""
    if len(names) == 1:
        return names[0]
    shared = takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    common = "".join(letters[0] for letters in shared)
    return re.sub(r"[-_. ]*(seed)?[-_. ]*\d*$", "", common) or ", ".join(names)


def _evaluation(row: str, name: str, run: FinishedRun) -> SeedEvaluation:
    return SeedEvaluation(
        measured=run,
        row=row,
        suite=run.config.suite.name,
        seed=run.config.seed,
        name=name,
        config=run.config,
        environment_steps=run.summary.environment_steps,
        home=run.folder,
    )
