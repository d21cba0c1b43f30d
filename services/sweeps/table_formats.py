"""The table of a sweep beside the paper's: on the terminal, in files of several forms, as a page, in MLflow."""

import csv
import io
from collections.abc import Mapping, Sequence

import yaml
from rich.table import Table

from dmil_core.files import inside, write_file
from dmil_core.statistics import interval_text
from services.cli.escapes import for_csv, for_latex, for_markdown, one_line
from services.cli.progress import console
from services.evaluation.comparison import DIGITS, Cell, Difference, Unpaired
from services.evaluation.summary import markdown_rows
from services.reporting.comparison_pictures import draw_means
from services.sweeps.folders import MARK, TABLES, SweepFolder
from services.sweeps.page import write_sweep_page
from services.sweeps.tables import Sample, Tables, column_of, comparison_of, tables_of
from services.tracking.tracker import Tracker

SAMPLE = ("sample", "suite", "seed", "status", "iterations", "held out", "settings")
DIFFERENCE = ("row", "against", "where", "difference", "95% interval", "pairs", "seeds", "differs?")


def _where(of: Cell | Difference | Unpaired) -> str:
    return f"{of.suite}, {of.split}, {of.shots}-shot"


def _in_use(cell: Cell) -> str:
    return "" if cell.sub_skills_in_use is None else f"{cell.sub_skills_in_use:.1f}"


def _grid(tables: Tables) -> dict[str, dict[str, Cell]]:
    grid: dict[str, dict[str, Cell]] = {row: {} for row in tables.rows}
    for cell in tables.cells:
        grid[cell.suite if tables.by == "suites" else cell.row][column_of(cell, tables.by)] = cell
    return grid


def _mean_and_paper(cell: Cell | None, digits: int) -> list[str]:
    """Return a cell's mean and the paper's, a line each: none if it was not run."""
    if cell is None:
        return []
    interval = interval_text(cell.low, cell.high, digits)
    lines = [f"{cell.mean:.{digits}f}" + (f" ({interval})" if interval else "")]
    if cell.paper is not None:
        mark = " outside" if cell.outside else ""
        lines.append(f"paper {cell.paper.text(digits)}: {cell.difference:+.{digits}f}{mark}")
    return lines


def _lines(cell: Cell | None, digits: int) -> list[str]:
    """Return a cell's figures, and what they come from."""
    if cell is None:
        return []
    lines = _mean_and_paper(cell, digits)
    if cell.environment_steps:
        lines.append(f"{cell.environment_steps:,} environment steps")
    if in_use := _in_use(cell):
        lines.append(f"{in_use} sub-skills in use")
    plural = "seed" if len(cell.seeds) == 1 else "seeds"
    return [*lines, f"{len(cell.seeds)} {plural}, {cell.episodes} episodes"]


def _head(tables: Tables) -> str:
    trials = ", ".join(f"{count} {status}" for status, count in tables.trials.items())
    against = f"; beside it {tables.paper.replace('table', 'Table ')} of the paper" if tables.paper else ""
    return f"{tables.what}: {tables.metric.replace('_', ' ')} at preset {tables.preset}{against} (trials: {trials})"


def _origin(tables: Tables) -> str:
    """Return what a table is of, and the command that made it, as a comment has it."""
    return one_line(f"{_head(tables)}; {tables.command}")


def show(tables: Tables, sweep: SweepFolder) -> None:
    """Print the table, the differences, what failed, and where all of it is written."""
    digits = DIGITS[tables.metric]
    if tables.samples:
        view = Table(*SAMPLE, title=_head(tables))
        for sample in tables.samples:
            view.add_row(*_sample_fields(sample))
    else:
        grid = _grid(tables)
        view = Table(
            "", *[column.replace(", ", "\n") for column in tables.columns], title=_head(tables), show_lines=True
        )
        for row in tables.rows:
            view.add_row(row, *["\n".join(_lines(grid[row].get(column), digits)) for column in tables.columns])
    console.print(view)
    if tables.differences:
        view = Table(*DIFFERENCE)
        for pair in tables.differences:
            view.add_row(*_difference_fields(pair, digits))
        console.print(view)
    for pair in tables.unpaired:
        console.print(_not_compared(pair))
    for name, error in tables.failed.items():
        console.print(f"failed: {name}: {error}")
    console.print(f"tables: {sweep.path / 'tables'}")
    console.print(f"page: {sweep.path / 'tables' / 'report.html'}")


def _sample_fields(sample: Sample) -> list[str]:
    held_out = "" if sample.held_out is None else f"{sample.held_out:.3f}"
    settings = yaml.safe_dump(sample.settings, default_flow_style=True, width=1000).strip()
    return [sample.sample, sample.suite, str(sample.seed), sample.status, str(sample.iteration), held_out, settings]


def _difference_fields(pair: Difference, digits: int) -> list[str]:
    interval = interval_text(pair.low, pair.high, digits, "+")
    fields = [pair.row, pair.baseline, _where(pair), f"{pair.mean:+.{digits}f}", interval]
    return [*fields, str(pair.pairs), str(len(pair.seeds)), pair.differs]


def _not_compared(pair: Unpaired) -> str:
    return f"Not compared: {pair.row} with {pair.baseline} ({_where(pair)}): {pair.why}"


def write_tables(sweep: SweepFolder) -> Tables:
    """Write the folder ``tables``: JSON, Markdown, CSV, LaTeX, a plot, a page; of a search also the best settings."""
    comparison = comparison_of(sweep)
    tables = tables_of(sweep, comparison)
    folder = inside(sweep.path, TABLES)
    write_file(folder, "tables.json", tables.model_dump_json(indent=1) + "\n")
    write_file(folder, "table.md", _markdown(tables))
    write_file(folder, "cells.csv", _csv([_flat(of) for of in tables.cells]))
    write_file(folder, "differences.csv", _csv([of.model_dump() for of in tables.differences]))
    write_file(folder, "table.tex", _latex(tables))
    if tables.samples:
        best = yaml.safe_dump(tables.samples[0].settings, sort_keys=False)
        write_file(folder, "best.yaml", f"# {_origin(tables)}\n{best}")
    if tables.cells:
        draw_means(comparison, folder / "table.png", _head(tables))
    write_sweep_page(tables, comparison, folder / "report.html")
    return tables


def _flat(cell: Cell) -> dict[str, object]:
    row = cell.model_dump()
    paper = row.pop("paper")
    row["paper"], row["paper_spread"] = (paper["value"], paper["spread"]) if paper else (None, None)
    return row


def _csv(rows: Sequence[Mapping[str, object]]) -> str:
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            fields = {key: " ".join(map(str, v)) if isinstance(v, list) else v for key, v in row.items()}
            writer.writerow({key: for_csv(value) for key, value in fields.items()})
    return text.getvalue()


def _markdown(tables: Tables) -> str:
    digits, grid = DIGITS[tables.metric], _grid(tables)
    begun = for_markdown(f"Begun {tables.began}, commit {tables.commit[:12]}: {tables.command}")
    lines = [f"{for_markdown(_head(tables))}.", "", begun, ""]
    if tables.samples:
        lines += markdown_rows(SAMPLE, map(_sample_fields, tables.samples))
    else:
        rows = ([row, *["<br>".join(_lines(grid[row].get(c), digits)) for c in tables.columns]] for row in tables.rows)
        lines += markdown_rows(["", *tables.columns], rows)
    if tables.cells:
        lines += ["", "Interquartile means over tasks and seeds; sub-skills with over a tenth of a task's states:", ""]
        rows = (
            [cell.row, _where(cell), f"{cell.interquartile_mean:.{digits}f}", _in_use(cell), cell.interval]
            for cell in tables.cells
        )
        lines += markdown_rows(["row", "where", "interquartile mean", "sub-skills in use", "interval"], rows)
    if tables.differences:
        lines += ["", "On the same seeds and episodes:", ""]
        lines += markdown_rows(DIFFERENCE, (_difference_fields(pair, digits) for pair in tables.differences))
    lines += [f"\n{for_markdown(_not_compared(pair))}" for pair in tables.unpaired]
    lines += [f"\n{for_markdown(f'Failed: {name}: {error}')}" for name, error in tables.failed.items()]
    return "\n".join(lines) + "\n"


def _latex(tables: Tables) -> str:
    """Lay the table out for the package booktabs."""
    digits, grid = DIGITS[tables.metric], _grid(tables)

    def stacked(lines: list[str]) -> str:
        return r"\shortstack{" + r" \\ ".join(map(for_latex, lines)) + "}" if lines else ""

    lines = [f"% {_origin(tables)}", rf"\begin{{tabular}}{{l{'c' * len(tables.columns)}}}", r"\toprule"]
    head = [stacked(column.split(", ")) for column in tables.columns]
    lines += [" & ".join(["", *head]) + r" \\", r"\midrule"]
    for row in tables.rows:
        fields = [stacked(_mean_and_paper(grid[row].get(column), digits)) for column in tables.columns]
        lines.append(" & ".join([for_latex(row), *fields]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def publish(tracker: Tracker, tables: Tables, sweep: SweepFolder) -> None:
    """Record the table, its plot and its means on the sweep's MLflow run."""
    tracker.metrics(0, {_metric_name(cell): cell.mean for cell in tables.cells}, anew=True)
    tracker.tags({"mlflow.note.content": _markdown(tables)})
    tracker.artifact(sweep.path / "tables", "tables")
    tracker.artifact(sweep.path / MARK)


def _metric_name(cell: Cell) -> str:
    """Return a name of characters that MLflow takes."""
    name = f"{cell.row}/{cell.suite}/{cell.split}/{cell.shots}-shot"
    return "".join(c if c.isascii() and (c.isalnum() or c in "/_-. ") else "_" for c in name)
