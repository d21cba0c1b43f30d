"""What a run shows at its end, on the terminal and as tables; its page is `reporting.run_report`'s.

As a program it draws what there is to look at: ``python -m services.report gallery``.
"""

import sys
from collections.abc import Sequence
from importlib import import_module

from dmil_core.errors import UserError, nearest
from services.cli.arguments import exit_code
from services.cli.help_texts import command_of
from services.cli.progress import console

KINDS = {
    "run": "services.report_run",
    "compare": "services.report_compare",
    "sub-skills": "services.report_sub_skills",
    "video": "services.report_video",
    "gallery": "services.report_gallery",
    "tables": "services.report_tables",
}
"""What the program draws, and the module that does."""


def run(arguments: Sequence[str]) -> None:
    """Run the program that draws what the first argument names.

    Raises:
        UserError: if it names nothing that can be drawn.
    """
    if arguments and arguments[0] in {"--help", "-h"}:
        console.print(f"usage: {command_of('services.report')} KIND [--help]\n")
        for kind, module in KINDS.items():
            console.print(f"  {kind:12}{(import_module(module).__doc__ or '').splitlines()[0]}")
        return
    if not arguments or arguments[0] not in KINDS:
        got = arguments[0] if arguments else "nothing"
        raise UserError(
            f"report: got {got}; wanted one of {', '.join(KINDS)}, each with a --help of its own{nearest(got, KINDS)}"
        )
    import_module(KINDS[arguments[0]]).run(arguments[1:])


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
