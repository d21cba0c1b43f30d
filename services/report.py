"""Draw what there is to look at, or lay tables out: ``dmil report gallery``."""

import sys
from collections.abc import Sequence
from importlib import import_module

from dmil_core.errors import UserError, nearest
from services.cli.arguments import exit_code
from services.cli.help_texts import REPORTS, command_of
from services.cli.progress import console


def run(arguments: Sequence[str]) -> None:
    """Run the program that draws what the first argument names.

    Raises:
        UserError: if it names nothing that can be drawn.
    """
    if arguments and arguments[0] in {"--help", "-h"}:
        console.print(f"usage: {command_of('services.report')} KIND [--help]\n")
        for kind, module in REPORTS.items():
            console.print(f"  {kind:12}{(import_module(module).__doc__ or '').splitlines()[0]}")
        return
    if not arguments or arguments[0] not in REPORTS:
        got = arguments[0] if arguments else "nothing"
        raise UserError(
            f"report: got {got}; wanted one of {', '.join(REPORTS)}, each with a --help of its own"
            f"{nearest(got, REPORTS)}"
        )
    import_module(REPORTS[arguments[0]]).run(arguments[1:])


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
