"""Make a model to ship from a run: what is needed to adapt and evaluate it, and a card with its figures and limits.

The learner's state stays behind, so nobody can go on with its meta-training. For example:

  python -m services.export ml10-0 models/ml10
"""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dmil_core.checksums import checked_file
from dmil_core.errors import UserError
from dmil_core.files import create_file, making_folder, read_json
from services.cli.arguments import exit_code, parse
from services.cli.progress import console
from services.storage.run_folders import SUMMARY

if TYPE_CHECKING:
    from dmil_core.checkpoint import Checkpoint
    from services.evaluation.summary import Summary


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``export``."""

    run: Annotated[str, tyro.conf.Positional]
    """Name or folder of a run; its newest checkpoint is taken."""
    folder: Annotated[Path, tyro.conf.Positional]
    """New folder for the model, whose name is the model's."""
    figures: Path | None = None
    """Folder of the evaluation of this checkpoint that the card tells of; the run's own if not given."""
    runs: Path = Path("runs")
    """The folder that runs' own folders are in."""


def run(arguments: Sequence[str]) -> None:
    """Run the program.

    Raises:
        UserError: for no run, figures of another checkpoint, or a folder that is there already.
    """
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING, tyro.MISSING))
    if args.folder.exists():
        raise UserError(f"FOLDER: got {args.folder}, which is there already; wanted the name of a new folder")
    from dmil_core.checkpoint import Checkpoint
    from dmil_core.model import load
    from services.reporting.model_card import CARD, model_card

    checkpoint = load(args.run, args.runs).checkpoint
    summary = _figures(checkpoint, args.figures or checkpoint.path.parents[1])
    files = _files(checkpoint)
    with making_folder(args.folder.absolute().parent, args.folder.name) as made:
        for name, content in files.items():
            create_file(made, name, content)
        shipped = summary.model_copy(update={"checkpoint_digest": Checkpoint(made).digest})
        create_file(made, SUMMARY, (shipped.model_dump_json(indent=1) + "\n").encode())
        size = sum(map(len, files.values()))
        create_file(made, CARD, model_card(args.folder.name, checkpoint, summary, size).encode())
    console.print(f"{args.folder}: {size / 1e6:.1f} MB; to evaluate it: dmil evaluate {shlex.quote(str(args.folder))}")


def _figures(checkpoint: "Checkpoint", folder: Path) -> "Summary":
    """Return the summary of an evaluation without what is only of the machine that it was made on."""
    from services.evaluation.expectation import MOST_BYTES
    from services.evaluation.summary import Summary

    advice = (
        "wanted the summary of an evaluation of the run's newest checkpoint: dmil evaluate RUN, then --figures FOLDER"
    )
    if not (folder / SUMMARY).is_file():
        raise UserError(f"{folder}: got no {SUMMARY}; {advice}")
    summary = read_json(folder, SUMMARY, Summary, MOST_BYTES, advice)
    if summary.checkpoint_digest != checkpoint.digest:
        got, wanted = summary.checkpoint_digest[:12], checkpoint.digest[:12]
        raise UserError(f"{folder / SUMMARY}: checkpoint_digest: got {got}; wanted {wanted}, of {checkpoint.path}")
    return summary.model_copy(update={"checkpoint": "", "report": "", "mlflow_run_id": None})


def _files(checkpoint: "Checkpoint") -> dict[str, bytes]:
    """Return the files of a checkpoint by name, without the optimiser's."""
    from dmil_core.checkpoint import CONSTANTS, FILES, MANIFEST, MARKER, PARAMETERS, sealed

    manifest = checkpoint.manifest
    kept = PARAMETERS, CONSTANTS
    files = {name: checked_file(checkpoint.path, name, manifest.files[name], FILES[name]) for name in kept}
    return sealed(files, manifest.model_copy(update={"mlflow_run_id": None}), MANIFEST, MARKER)


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
