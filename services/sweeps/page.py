"""The page of a sweep: its rows side by side."""

from pathlib import Path

from services.evaluation.comparison import Comparison
from services.reporting.page import Commands
from services.reporting.side_by_side import write_comparison
from services.sweeps.tables import Tables


def write_sweep_page(tables: Tables, comparison: Comparison, path: Path) -> None:
    """Write the page of a sweep.

    Raises:
        DiskFullError: for want of space.
    """
    trials = ", ".join(f"{count} {status}" for status, count in tables.trials.items())
    paper = f" Beside it stands {tables.paper.replace('table', 'Table ')} of the paper." if tables.paper else ""
    lead = [
        f"{tables.metric.replace('_', ' ').capitalize()} at preset {tables.preset}; trials: {trials}.{paper} Begun "
        f"{tables.began}, commit {tables.commit[:12]}."
    ]
    lead += [f"Failed: {name}: {error}" for name, error in tables.failed.items()]
    write_comparison(path, tables.what, lead, comparison, [Commands("The sweep", [tables.command])])
