"""The page that puts rows side by side: of a few runs, or of a sweep."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dmil_core.checksums import sha256
from dmil_core.statistics import interval_text
from services.evaluation.comparison import DIGITS, Cell, CellKey, Comparison, Difference, SeedEvaluation, Unpaired
from services.evaluation.summary import without_empty_columns
from services.reporting.bands import curves
from services.reporting.comparison_pictures import Runs, heat_map, means, profiles
from services.reporting.drawing import Picture
from services.reporting.page import Commands, DataTable, Part, Prose, Section, write_page
from services.suites.base import Split


def write_comparison(
    path: Path, title: str, lead: Sequence[str], comparison: Comparison, commands: Sequence[Commands]
) -> None:
    """Write the page.

    Raises:
        UserError: if a row has not as many episodes of each task and seed.
        DiskFullError: for want of space.
    """
    sections = [
        Section(f"{_metric(comparison).capitalize()}s", _overview(comparison)),
        Section("Paired differences", _differences(comparison)),
        Section("Performance profiles", _profiles(comparison)),
        Section("Each task", _heat_maps(comparison)),
        Section("Training curves", _curves(comparison)),
        Section("Settings that differ", _settings(comparison)),
        Section("Runs and commands", [*_runs(comparison), *commands]),
    ]
    write_page(path, title, [Prose(text) for text in (*lead, *_warnings(comparison))], sections)


def _metric(comparison: Comparison) -> str:
    return comparison.metric.replace("_", " ")


def _warnings(comparison: Comparison) -> Iterator[str]:
    """Say what keeps rows from being compared fairly."""
    for suite in comparison.suites:
        outcomes = {key: next(iter(seeds.values())) for key, seeds in comparison.outcomes.items() if key.suite == suite}
        protocols = _rows_by({key.row: first.protocol for key, first in outcomes.items()})
        if len(protocols) > 1:
            text = "; ".join(f"{', '.join(rows)}: {protocol}" for protocol, rows in protocols.items())
            yield f"The protocols of {suite} differ, so the figures are of different things: {text}."
        for split in comparison.splits:
            tasks = _rows_by({key.row: first.tasks for key, first in outcomes.items() if key.split == split})
            if len(tasks) > 1:
                text = "; ".join(f"{', '.join(rows)}: {', '.join(names)}" for names, rows in tasks.items())
                yield f"The {split} tasks of {suite} differ, so the means are over different tasks: {text}."


def _rows_by(values: Mapping[str, Any]) -> dict[Any, list[str]]:
    rows: dict[Any, list[str]] = defaultdict(list)
    for row, value in values.items():
        rows[value].append(row)
    return rows


def _overview(comparison: Comparison) -> list[Part]:
    if not comparison.cells:
        return [Prose("Nothing is finished yet.")]
    digits = DIGITS[comparison.metric]
    rows = []
    for cell in comparison.cells:
        interval = _together(interval_text(cell.low, cell.high, digits))
        paper = "" if cell.paper is None else _together(cell.paper.text(digits))
        apart = "" if cell.difference is None else f"{cell.difference:+.{digits}f}{', outside' if cell.outside else ''}"
        in_use = "" if cell.sub_skills_in_use is None else f"{cell.sub_skills_in_use:.1f}"
        counts = [f"{len(cell.seeds)}", f"{cell.tasks}", f"{cell.episodes}"]
        figures = [f"{cell.mean:.{digits}f}", interval, f"{cell.interquartile_mean:.{digits}f}"]
        rows.append([*_place(comparison, cell), *figures, *counts, paper, apart, in_use])
    head = ["row", "suite", "split", "shots", f"mean {_metric(comparison)}", "95% interval", "interquartile mean"]
    head += ["seeds", "tasks", "episodes", "paper", "from the paper", "sub-skills in use"]
    text = (
        "Over several seeds the interval is a stratified bootstrap's: seeds are drawn with replacement, then the "
        "episodes of each task; over one seed it is Wilson's, or Student's for scores, and says nothing of what "
        "another seed would do. The interquartile mean is over tasks and seeds. Outside: the paper's figure lies "
        "outside our interval, and our mean outside its spread. In use is a sub-skill with over a tenth of a task's "
        "states after adaptation."
    )
    return [means(comparison), _filled(f"{_metric(comparison).capitalize()}s", head, rows), Prose(text)]


def _together(figures: str) -> str:
    """Return figures that stay on one line."""
    return figures.replace(" ", "\u00a0")


def _place(comparison: Comparison, cell: Cell | Difference) -> list[str]:
    return [cell.row, cell.suite if len(comparison.suites) > 1 else "", cell.split, f"{cell.shots}"]


def _filled(caption: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> DataTable:
    kept, *fields = without_empty_columns(head, rows)
    return DataTable(caption, kept, fields)


def _differences(comparison: Comparison) -> list[Part]:
    if comparison.baseline is None or not comparison.pairs:
        return []
    digits = DIGITS[comparison.metric]
    rows = []
    for pair in comparison.pairs:
        if isinstance(pair, Difference):
            interval = interval_text(pair.low, pair.high, digits, "+")
            counts = f"{pair.pairs}", f"{len(pair.seeds)}"
            rows.append([*_place(comparison, pair), f"{pair.mean:+.{digits}f}", interval, pair.differs, *counts])
    text = (
        f"Each row less {comparison.baseline}, on the same seeds and the same episodes, so that what both share falls "
        "out. The interval is a stratified bootstrap's over seeds and episodes, over one seed of its episodes. "
        "Where it holds zero, nothing is decided, which is not to say that there is no difference."
    )
    head = ["row", "suite", "split", "shots", "difference", "95% interval", "differs?", "pairs", "seeds"]
    parts = [Prose(text), _filled(f"Differences from {comparison.baseline}", head, rows)] if rows else []
    return [*parts, *map(Prose, _unpaired(comparison))]


def _unpaired(comparison: Comparison) -> Iterator[str]:
    by_reason: dict[tuple[str, str], list[Unpaired]] = defaultdict(list)
    for pair in comparison.pairs:
        if isinstance(pair, Unpaired):
            by_reason[pair.row, pair.why].append(pair)
    for (row, why), pairs in by_reason.items():
        everywhere = len(pairs) == sum(pair.row == row for pair in comparison.pairs)
        places = "; ".join(f"{pair.suite}, {pair.split}, {pair.shots}-shot" for pair in pairs)
        where = "" if everywhere else f" on {places}"
        yield f"{row} is not paired with {comparison.baseline}{where}: {why}."


def _benchmarks(comparison: Comparison) -> dict[str, Sequence[str]]:
    """Return the suites whose tasks stand in one picture, by its name."""
    if comparison.by == "suites" and len(comparison.suites) > 1:
        return {f"{len(comparison.suites)} suites": comparison.suites}
    return {suite: [suite] for suite in comparison.suites}


def _profiles(comparison: Comparison) -> list[Part]:
    pictures: list[Part] = []
    for called, suites in _benchmarks(comparison).items():
        for split in comparison.splits:
            by_shots = {shots: _runs_of(comparison, suites, split, shots) for shots in comparison.shots}
            by_shots = {shots: runs for shots, runs in by_shots.items() if any(of.size > 1 for of in runs.values())}
            if by_shots:
                metric, digits = _metric(comparison), DIGITS[comparison.metric]
                pictures.append(profiles(f"{called}, {split}", comparison.rows, by_shots, metric, digits))
    several = any(len(cell.seeds) > 1 for cell in comparison.cells)
    band = (
        "The band is a stratified bootstrap's, 95%, threshold by threshold: seeds are drawn with replacement, all runs "
        "of a seed together, for one training serves all tasks."
        if several
        else "There is one seed of each row, which says nothing of another: so there are no bands."
    )
    text = (
        f"A run is one seed on one task. The curve is the fraction of runs whose {_metric(comparison)} is above τ: the "
        f"higher the better, and a row whose curve is nowhere below another's is better throughout. {band} (Agarwal et "
        "al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021.)"
    )
    return [Prose(text), *pictures] if pictures else []


def _runs_of(comparison: Comparison, suites: Sequence[str], split: Split, shots: int) -> Runs:
    """Return what each row came to that was run on all of some suites: of each seed on each task."""
    runs = {}
    for row in comparison.rows:
        by_suite = [comparison.outcomes.get(CellKey(row, suite, split, shots), {}) for suite in suites]
        if seeds := sorted(set.intersection(*map(set, by_suite))):
            rates = [np.concatenate([outcomes[seed].outcomes.mean(1) for outcomes in by_suite]) for seed in seeds]
            runs[row] = np.stack(rates)
    return runs


def _heat_maps(comparison: Comparison) -> list[Part]:
    pictures: list[Part] = []
    outcomes = [seed.outcomes for seeds in comparison.outcomes.values() for seed in seeds.values()]
    top = max(1.0, *(float(values.max()) for values in outcomes)) if outcomes else 1.0
    for called, suites in _benchmarks(comparison).items():
        for split in comparison.splits:
            by_shots = {shots: _by_task(comparison, suites, split, shots) for shots in comparison.shots}
            order = _from_the_easiest([by_task for by_row in by_shots.values() for by_task in by_row.values()])
            for shots, by_row in by_shots.items():
                if by_row:
                    values = [[by_task.get(task, np.nan) for by_task in by_row.values()] for task in order]
                    title = f"{_metric(comparison).capitalize()} on each task: {called}, {split}, {shots}-shot"
                    names = [task if len(suites) == 1 else f"{suite}: {task}" for suite, task in order]
                    pictures.append(
                        heat_map(
                            title, list(by_row), names, np.array(values), top=top, metric=f"mean {_metric(comparison)}"
                        )
                    )
    text = "The mean over seeds and episodes. Tasks stand in one order for all shots, from that which most rows solve."
    return [Prose(text), *pictures] if pictures else []


Task = tuple[str, str]
"""Suite and name."""


def _by_task(comparison: Comparison, suites: Sequence[str], split: Split, shots: int) -> dict[str, dict[Task, float]]:
    """Return the mean of each row on each task, of the rows that have any."""
    by_row: dict[str, dict[Task, float]] = {}
    for row in comparison.rows:
        for suite in suites:
            if seeds := comparison.outcomes.get(CellKey(row, suite, split, shots)):
                means = np.mean([seed.outcomes.mean(1) for seed in seeds.values()], 0)
                tasks = next(iter(seeds.values())).tasks
                by_row.setdefault(row, {}).update(zip([(suite, task) for task in tasks], means.tolist(), strict=True))
    return by_row


def _from_the_easiest(means: Sequence[Mapping[Task, float]]) -> list[Task]:
    tasks = sorted({task for by_task in means for task in by_task})
    return sorted(tasks, key=lambda task: -float(np.mean([by_task[task] for by_task in means if task in by_task])))


def _curves(comparison: Comparison) -> list[Part]:
    pictures: list[Picture | None] = []
    for suite in comparison.suites:
        rows = _trained(comparison, suite)
        metrics = {", ".join(names): [seed.metrics for seed in seeds] for names, seeds in rows.items()}
        places = [(split, shots) for split in comparison.splits for shots in comparison.shots]
        rates = {f"{split}, {shots}-shot": f"{comparison.metric}/{split}/{shots}-shot" for split, shots in places}
        title = f"{_metric(comparison).capitalize()} over training, {suite}"
        pictures.append(curves(title, metrics, rates, rate=comparison.metric == "success_rate"))
        names = dict.fromkeys(name for seeds in metrics.values() for seed in seeds for row in seed for name in row)
        losses = {name.replace("_", " "): name for name in names if "loss" in name}
        pictures.append(curves(f"Losses over training, {suite}", metrics, losses))
    text = (
        "The line is the mean over a row's seeds, in means of neighbouring iterations, and the band reaches from the "
        "lowest seed to the highest. Over one seed a success rate's band is its 95% interval over episodes, and a loss "
        "has none. Losses of different methods are different things: compare their course, not their height."
    )
    kept = [picture for picture in pictures if picture is not None]
    return [Prose(text), *kept] if kept else []


def _trained(comparison: Comparison, suite: str) -> dict[tuple[str, ...], list[SeedEvaluation]]:
    """Return the evaluations on a suite by their rows; rows that differ only in how they are evaluated are one here."""
    homes: dict[str, dict[Path, SeedEvaluation]] = {}
    for evaluation in comparison.evaluations:
        if evaluation.suite == suite:
            homes.setdefault(evaluation.row, {})[evaluation.home] = evaluation
    rows = _rows_by({row: tuple(evaluations) for row, evaluations in homes.items()})
    return {tuple(names): list(homes[names[0]].values()) for names in rows.values()}


def _settings(comparison: Comparison) -> list[Part]:
    by_setting: dict[str, dict[str, list[str]]] = {}
    for evaluation in comparison.evaluations:
        for setting, value in _flat(evaluation).items():
            values = by_setting.setdefault(setting, {}).setdefault(evaluation.row, [])
            if value not in values:
                values.append(value)
    rows = list(dict.fromkeys(evaluation.row for evaluation in comparison.evaluations))
    table = [[setting, *("; ".join(by_row.get(row, [])) for row in rows)] for setting, by_row in by_setting.items()]
    # A method's own settings stand together, wherever the first row that has them came.
    sections = list(dict.fromkeys(setting.partition(".")[0] for setting in by_setting))
    differing = [line for line in table if len(set(line[1:])) > 1]
    differing.sort(key=lambda line: sections.index(line[0].partition(".")[0]))
    text = "All else is the same, but for the seed. An empty field is a setting that the method does not have."
    if not differing:
        return [Prose("None but the seed.")] if by_setting else []
    return [DataTable("Settings that differ", ["setting", *rows], differing), Prose(text)]


def _flat(evaluation: SeedEvaluation) -> dict[str, str]:
    """Return all settings of an evaluation but the seed, with what else decides its figures."""
    settings_by_name: dict[str, str] = {}
    for section, settings in evaluation.config.model_dump(mode="json", exclude={"seed"}).items():
        for name, value in settings.items():
            settings_by_name[f"{section}.{name}"] = (
                ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            )
    data = {f"{row.task} {row.data}" for row in evaluation.measured.episodes}
    versions = evaluation.measured.episodes[0].versions if evaluation.measured.episodes else {}
    settings_by_name["data sets' SHA-256"] = sha256("\n".join(sorted(data)).encode())[:12]
    return settings_by_name | {f"version of {name}": version for name, version in versions.items()}


def _runs(comparison: Comparison) -> list[Part]:
    rows = []
    for evaluation in comparison.evaluations:
        steps_taken = f"{evaluation.environment_steps:,}" if evaluation.environment_steps else ""
        checkpoint = evaluation.measured.episodes[0].checkpoint[:12] if evaluation.measured.episodes else ""
        which = [evaluation.name, evaluation.row, evaluation.suite, f"{evaluation.seed}", evaluation.config.method.name]
        rows.append([*which, f"{evaluation.config.training.iterations}", steps_taken, checkpoint])
    head = ["run", "row", "suite", "seed", "method", "iterations", "environment steps", "checkpoint"]
    return [_filled("Runs", head, rows)] if rows else []
