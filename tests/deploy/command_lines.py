"""What the programs that a command line names say of it, without running it."""

import contextlib
import importlib.util
import io
import re
import shlex
import warnings
from collections.abc import Iterator, Sequence
from importlib import import_module
from typing import Any

import click

from dmil_core.errors import UserError
from services import meta_train, tune_sweep
from services.cli.arguments import parse, peek
from services.cli.composition import EARLY, defaults_from
from tests.deploy.manifests import DEPLOY, ask

PROGRAMS = {"ray", "mlflow", "python", "weed", "prometheus", "pg_isready", "wget"}
CONTAINER_SCRIPTS = "/usr/local/bin/"
"""Where the Dockerfile puts what is in deploy/docker."""
IN_CONTAINERS_ONLY = {"weed", "pg_isready", "wget"}
"""Programs of other projects' images, which nothing here can ask."""


def refused(arguments: Sequence[str]) -> str | None:
    """Return what is wrong with a command line, or None."""
    match arguments:
        case ["ray", "start" | "stop" | "health-check" as name, *flags]:
            scripts = _imported("ray.scripts.scripts")
            return _refused_by_click(getattr(scripts, name.replace("-", "")), flags)
        case ["ray", "job", "submit", *flags]:
            own = flags[: flags.index("--")] if "--" in flags else flags
            submit = _imported("ray.dashboard.modules.job.cli").submit
            return _refused_by_click(submit, [*own, "true"]) or refused(flags[len(own) + 1 :])
        case ["mlflow", "server", *flags]:
            return _refused_by_click(_imported("mlflow.cli").server, flags)
        case ["python", "-m", module, *flags]:
            return _refused_by_module(module, flags)
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


def _refused_by_module(module: str, flags: Sequence[str]) -> str | None:
    if importlib.util.find_spec(module) is None:
        return f"{module}: there is no such module"
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            match module:
                case "services.meta_train":
                    defaults: Any = meta_train.Arguments(defaults_from(peek(flags, **EARLY)))
                    parse(meta_train.Arguments, "", flags, defaults)
                case "services.tune_sweep":
                    given = parse(tune_sweep.Arguments, "", flags, tune_sweep.Arguments())
                    if given.sweep is not None and not (tune_sweep.CONFIGS / f"{given.sweep}.yaml").is_file():
                        return f"{given.sweep}: there is no such sweep in tune_configs"
                case _:
                    return f"{module}: the checks do not know how it reads its arguments; teach them"
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
