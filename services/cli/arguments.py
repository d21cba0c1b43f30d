"""What all programs share: settings from a preset, a YAML file and flags, and errors that teach."""

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import tyro
from pydantic import ValidationError

from dmil_core.errors import RunError, UserError, describe_errors
from services.cli.escapes import for_terminal
from services.cli.progress import console_logging

T = TypeVar("T")
Quiet = Annotated[
    bool,
    tyro.conf.arg(
        help="In place of the live screen a plain line every few seconds, as where the output is no terminal; and of "
        "messages only warnings, results and errors."
    ),
]
"""The flag ``--quiet`` of programs that take long; `exit_code` applies it."""
PROGRAMS = {
    "meta-train": "collect demonstrations, meta-train, evaluate",
    "collect-demos": "let the scripted experts make demonstrations",
    "adapt": "adapt a model to demonstrations of your own, and save the policy",
    "evaluate": "adapt a checkpoint to each task and measure its success rates",
    "tune-sweep": "run an ablation or a search on Ray Tune",
    "doctor": "check a machine or a cluster before a long run",
    "report": "draw what there is to look at, and lay tables out",
    "tracking": "deliver to MLflow what a run left behind, or serve its pages",
    "reproduce": "run the work item again in which a program failed",
}
"""Of ``dmil``, which imports nothing from the folder that it is called in, as ``python -m`` does."""


def peek(arguments: Sequence[str], **options: Callable[[str], Any]) -> argparse.Namespace:
    """Return some of the options, each converted by its function, which decide the defaults of all others."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name, kind in options.items():
        parser.add_argument(f"--{name}", type=kind)
    return parser.parse_known_args(arguments)[0]


def parse(program: type[T], description: str, arguments: Sequence[str], defaults: T) -> T:
    """Read a program's arguments into its dataclass, over `defaults`; `--help` begins with `description`.

    Raises:
        UserError: for a value that a setting does not allow; what is no flag at all ends with exit code 2.
    """
    module = program.__module__ if program.__module__ != "__main__" else f"services.{Path(sys.argv[0]).stem}"
    try:
        return tyro.cli(
            program,
            config=(tyro.conf.AvoidSubcommands,),
            prog=f"python -m {module}",
            args=arguments,
            description=description,
            default=defaults,
        )
    except ValidationError as error:
        raise UserError(describe_errors(error)) from error


def exit_code(program: Callable[[Sequence[str]], None], arguments: Sequence[str]) -> int:
    """Run a program, with what is logged on the console, and return its exit code.

    2 for the user's mistake, 1 for what stops a run otherwise, 130 and 143 for Ctrl-C and SIGTERM.
    """
    received: list[int] = []

    def terminate(number: int, frame: object) -> NoReturn:
        received.append(number)
        raise KeyboardInterrupt  # as Ctrl-C; of a class of our own nothing would be left where Ray waits

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        with console_logging(quiet="--quiet" in arguments):
            program(arguments)
    except (UserError, RunError) as error:
        print(f"error: {for_terminal(str(error))}", file=sys.stderr)
        return 2 if isinstance(error, UserError) else 1
    except KeyboardInterrupt:
        return 143 if received else 130
    finally:
        signal.signal(signal.SIGTERM, before)
    return 0


def main() -> None:
    """Run one of the programs as a subcommand of ``dmil``."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in PROGRAMS:
        module = "tracking.__main__" if name == "tracking" else name.replace("-", "_")
        sys.exit(exit_code(import_module(f"services.{module}").run, sys.argv[2:]))
    print("usage: dmil PROGRAM [--help]\n")
    for program, purpose in PROGRAMS.items():
        print(f"  {program:15}{purpose}")
    if name not in ("--help", "-h"):
        print(f"\nerror: got the program {name!r}; wanted one of {', '.join(PROGRAMS)}", file=sys.stderr)
        sys.exit(2)
