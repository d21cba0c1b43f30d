"""What all programs share: settings from a preset, a YAML file and flags, and errors that teach."""

import argparse
import dataclasses
import errno
import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from dmil_core.errors import RunError, UserError, nearest
from dmil_core.files import FULL, at_home
from services.cli.escapes import for_terminal
from services.cli.help_texts import InvalidSettingsError, command_of, describe_flags, flowing, flowing_registry
from services.cli.progress import console_logging
from services.cli.stopping import stoppable
from services.cli.streams import steady_streams
from services.storage.redaction import redacted

T = TypeVar("T")
Quiet = Annotated[
    bool,
    tyro.conf.arg(
        help="In place of the live screen a plain line every few seconds, as where the output is no terminal; and of "
        "messages only warnings, results and errors."
    ),
]
"""The flag ``--quiet`` of programs that take long; `exit_code` applies it."""
LISTS = {"demos"}
"""Options that may be given several times, which makes a list."""
PROGRAMS = {
    "meta-train": "collect demonstrations, meta-train, evaluate",
    "collect-demos": "let the scripted experts make demonstrations",
    "adapt": "adapt a model to demonstrations of your own, and save the policy",
    "serve": "serve a model over HTTP: demonstrations in, actions out",
    "evaluate": "adapt a model to each task and measure its success rates",
    "export": "make a model to ship from a run",
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
        parser.add_argument(f"--{name}", type=at_home if kind is Path else kind, action="append")
    given = vars(parser.parse_known_args(arguments)[0])
    last = {name: values and (",".join(values) if name in LISTS else values[-1]) for name, values in given.items()}
    return argparse.Namespace(**last)


def parse(program: type[T], description: str, arguments: Sequence[str], defaults: T) -> T:
    """Read a program's arguments into its dataclass, over `defaults`; `--help` begins with `description`.

    Raises:
        UserError: for a value that a setting does not allow; what is no flag at all ends with exit code 2.
    """
    try:
        read = tyro.cli(
            program,
            config=(tyro.conf.AvoidSubcommands,),
            prog=command_of(program.__module__),
            args=arguments,
            description=flowing(description),
            default=defaults,
            registry=flowing_registry(),
        )
    except InvalidSettingsError as error:
        raise UserError(describe_flags(error.error, defaults)) from error
    paths = {name: at_home(value) for name, value in vars(read).items() if isinstance(value, Path)}
    texts = [field.name for field in dataclasses.fields(program) if field.type == str | None]  # type: ignore[arg-type]
    given = vars(peek(arguments, **dict.fromkeys(texts, str)))  # tyro takes the text None for no text
    told = {name: text for name, text in given.items() if text is not None}
    return dataclasses.replace(read, **paths, **told)  # type: ignore[type-var]  every program's is a dataclass


MISNAMED = {errno.ENAMETOOLONG, errno.ENOTDIR, errno.EEXIST, errno.EISDIR}
"""What is wrong with a path whose name is too long, or where a file stands for a folder or the other way round."""


def exit_code(program: Callable[[Sequence[str]], None], arguments: Sequence[str]) -> int:
    """Run a program, with what is logged on the console, and return its exit code.

    2 for the user's mistake, 1 for what stops a run otherwise, 129, 130 and 143 for SIGHUP, Ctrl-C and SIGTERM.
    """
    with steady_streams(), stoppable() as received:
        try:
            with console_logging(quiet="--quiet" in arguments):
                program(arguments)
        except (UserError, RunError, OSError) as error:
            if (told := _told(error)) is None:
                raise
            print(f"error: {for_terminal(told)}", file=sys.stderr)
            return 2 if isinstance(error, UserError) or getattr(error, "errno", None) in MISNAMED else 1
        except KeyboardInterrupt:
            return 128 + (received or [signal.SIGINT])[0]
    return 0


def _told(error: Exception) -> str | None:
    """Return what is told of an error in place of its traceback, or None for one of the program itself.

    A file that cannot be read or written is the machine's: a full or read-only disk, a folder in a file's place.
    """
    if isinstance(error, UserError | RunError):
        return str(error)
    if not isinstance(error, OSError):
        return None
    if error.filename is None:
        full = f"a disk: got {error.strerror}; wanted room for what is written; make some, then start again"
        return full if error.errno in FULL else None
    path = redacted(os.fsdecode(error.filename)) if isinstance(error.filename, str | bytes) else str(error.filename)
    return f"{path}: got {error.strerror}; wanted what can be read and written; mend that, or give another place"


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
        wanted = f"wanted one of {', '.join(PROGRAMS)}{nearest(name, PROGRAMS)}"
        print(f"\nerror: got the program {name!r}; {wanted}", file=sys.stderr)
        sys.exit(2)
