"""What the programs that a command line names say of it, without running it."""

import contextlib
import importlib.util
import io
import re
import shlex
import sys
import warnings
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import click
import pytest

from dmil_core.errors import UserError
from services import report, tune_sweep
from services.cli.arguments import PROGRAMS as PROGRAMS_OF_DMIL
from services.cli.arguments import parse
from services.suites.registry import open_suite
from tests.deploy.manifests import DEPLOY, ask

PROGRAMS = {"ray", "mlflow", "python", "weed", "prometheus", "pg_isready", "wget"}
CONTAINER_SCRIPTS = "/usr/local/bin/"
"""Where the Dockerfile puts what is in deploy/docker."""
IN_CONTAINERS_ONLY = {"weed", "pg_isready", "wget"}
"""Programs of other projects' images, which nothing here can ask."""


def refused(arguments: Sequence[str]) -> str | None:
    """Return what is wrong with a command line, or None."""
    match arguments:
        case ["ray", "start" | "stop" | "health-check" | "up" | "dashboard" | "rsync-down" as name, *flags]:
            return _refused_by_click(_imported("ray.scripts.scripts").cli.commands[name], flags)
        case ["ray", "job", "submit", *flags]:
            own = flags[: flags.index("--")] if "--" in flags else flags
            submit = _imported("ray.dashboard.modules.job.cli").submit
            return _refused_by_click(submit, [*own, "true"]) or refused(flags[len(own) + 1 :])
        case ["mlflow", "server", *flags]:
            return _refused_by_click(_imported("mlflow.cli").server, flags)
        case ["python", "-m", module, *flags]:
            return _refused_by_module(module, flags)
        case ["dmil", name, *flags] if name in PROGRAMS_OF_DMIL:
            return _refused_by_module(f"services.{name.replace('-', '_')}", flags)
        case ["make", target]:
            makefile = (DEPLOY.parent / "Makefile").read_text("utf-8")
            return None if re.search(rf"^{target}\b.*:", makefile, re.MULTILINE) else f"{target}: no target of make"
        case ["python", "-c", code]:
            compile(code, "-c", "exec")
            return None
        case ["python", script, *_] if script.startswith(CONTAINER_SCRIPTS):
            there = (DEPLOY / "docker" / script.removeprefix(CONTAINER_SCRIPTS)).is_file()
            return None if there else f"{script}: there is no such file in deploy/docker"
        case ["prometheus", *flags]:
            code, output = ask("prometheus", *flags, "--version")
            return None if code == 0 else output.strip()
        case [name, *_] if name in IN_CONTAINERS_ONLY:
            return None
    return f"{shlex.join(arguments)}: nothing here knows this program"


def _imported(module: str) -> Any:
    """Import a module that is only to say how it reads its arguments: what it warns of is not ours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return import_module(module)


def _refused_by_click(command: click.Command, flags: Sequence[str]) -> str | None:
    try:
        command.make_context(str(command.name), list(flags))
    except click.exceptions.Exit:  # of --help
        return None
    except click.ClickException as error:
        return error.format_message()
    return None


class _ReadError(BaseException):
    """A program has read its arguments, and goes no further."""


def _read_only(*arguments: Any) -> NoReturn:
    read = parse(*arguments)
    if experiment := getattr(read, "experiment", None):
        open_suite(experiment.suite)
    raise _ReadError(read)


def _refused_by_module(module: str, flags: Sequence[str]) -> str | None:
    """Let a program read its arguments, and stop it there."""
    if importlib.util.find_spec(module) is None:
        return f"{module}: there is no such module"
    if module == "pytest":
        return None
    said = io.StringIO()
    for each in report.REPORTS.values():
        import_module(each)  # before they are patched
    program = import_module("services.tracking.__main__" if module == "services.tracking" else module)
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        for loaded in [each for name, each in sys.modules.items() if name.startswith(("services.", "benchmarks."))]:
            if getattr(loaded, "parse", None) is parse:
                patch.setattr(loaded, "parse", _read_only)
        try:
            if module.startswith("benchmarks."):
                _read_only(program.Arguments, "", flags, program.Arguments())
            program.run(flags)
        except _ReadError as read:
            sweep = read.args[0].sweep if isinstance(read.args[0], tune_sweep.Arguments) else None
            if sweep is None or (tune_sweep.CONFIGS / f"{Path(sweep).stem}.yaml").is_file():
                return None
            return f"{sweep}: there is no such sweep in tune_configs"
        except UserError as error:
            return str(error)
        except SystemExit as error:
            return None if error.code == 0 else said.getvalue()
    return None


def commands(script: str) -> Iterator[list[str]]:
    """Yield the command lines in a line of shell that name a program we can ask."""
    words = shlex.shlex(script, posix=True, punctuation_chars="&|;<>")
    words.whitespace_split = True
    command: list[str] = []
    for word in (*words, ";"):
        if set(word) <= set("&|;"):
            if command and command[0] in PROGRAMS:
                yield command
            command = []
        else:
            command.append(word)


def listening(arguments: Sequence[str]) -> set[int]:
    """Return the ports that a command line makes its program listen on, for others to speak to."""
    line = " ".join(arguments).replace("= ", "=")
    named = re.findall(
        r"--?(?:port|dashboard-port|metrics-export-port|s3\.port|web\.listen-address)[= ](?:\S*:)?(\d+)\b", line
    )
    always = {"ray": {52365}}.get(arguments[0] if arguments else "", set())
    return {int(port) for port in named} | always | ({8265} if "--head" in arguments else set())
