"""Lay the table of a sweep beside the paper's: on the terminal, in files of several forms, as a page, in MLflow."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from services.cli.arguments import parse
from services.cli.places import announce
from services.storage.run_folders import find_folder
from services.sweeps.folders import MARK, SweepFolder


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``report tables``."""

    sweep: tyro.conf.Positional[str]
    """Name or folder of a sweep, which may be still under way."""
    runs: Path = Path("runs")
    """The folder that sweeps' own folders are in."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    from services.sweeps.table_formats import show, write_tables

    sweep = SweepFolder(find_folder(args.sweep, args.runs, MARK, "SWEEP"))
    announce(tables=(sweep.path / "tables", "--runs FOLDER"))
    show(write_tables(sweep), sweep)
