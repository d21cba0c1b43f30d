"""Run the work item again in which a program failed: alone, in this process, with the whole traceback."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from services.cli.arguments import exit_code, parse
from services.cli.progress import console
from services.distributed.failures import read_failure


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``reproduce``."""

    failure: Annotated[Path, tyro.conf.Positional]
    """The failure.json that the program named, or the folder it is in."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    failure = read_failure(args.failure)
    console.print(f"{failure.where}: it failed with\n{failure.problem}\nand is done again:")
    from services.experiments.reproduction import work_again

    work_again(failure)()
    console.print("it comes to its end here: look for what differs, such as memory, versions or the machine")


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
