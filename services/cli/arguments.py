"""What all programs share: settings from a preset, a YAML file and flags, and errors that teach."""

import argparse
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import tyro
from pydantic import ValidationError

from dmil_core.configs import (
    DEFAULT_METHOD,
    PRESETS,
    SIZES,
    EvaluationConfig,
    ExperimentConfig,
    SuiteConfig,
    preset_of,
)
from dmil_core.errors import RunError, UserError, explain, shown
from dmil_core.methods.registry import MethodError
from services.cli.progress import console
from services.cli.yaml_files import ConfigError, merged, read_yaml

__all__ = [
    "ConfigError",
    "Quiet",
    "checked",
    "config_from",
    "defaults_from",
    "exit_code",
    "main",
    "method_named",
    "parse",
    "peek",
    "suite_settings",
    "with_evaluation",
]

T = TypeVar("T")
Quiet = Annotated[
    bool,
    tyro.conf.arg(
        help="In place of the live screen a plain line every few seconds, as where the output is no terminal; and of "
        "messages only warnings, results and errors."
    ),
]
"""The flag ``--quiet`` of programs that take long; `parse` sees to it."""
DEFAULT_SUITE, DEFAULT_PRESET = "ml10", "quick"
PROGRAMS = {
    "meta-train": "collect demonstrations, meta-train, evaluate",
    "collect-demos": "let the scripted experts make demonstrations",
    "evaluate": "adapt a checkpoint to each task and measure its success rates",
    "tune-sweep": "run an ablation or a search on Ray Tune",
    "doctor": "check a machine or a cluster before a long run",
    "report": "draw what there is to look at, and lay tables out",
}


def defaults_from(arguments: Sequence[str]) -> ExperimentConfig:
    """Return what ``--preset``, ``--suite``, ``--method``, ``--config`` and ``--demos`` say all other settings are.

    Raises:
        ConfigError: as `config_from`.
    """
    early = peek(arguments, preset=str, suite=str, method=str, config=Path, demos=str)
    config = config_from(early.preset or DEFAULT_PRESET, early.config, early.suite, early.method)
    if early.demos is None:
        return config
    demonstrations = config.demonstrations.model_copy(update={"source": early.demos})
    return config.model_copy(update={"demonstrations": demonstrations})


def config_from(
    preset: str, file: Path | None, suite: str | None = None, method: str | None = None
) -> ExperimentConfig:
    """Return a preset's settings, with those that a YAML file gives in their place.

    Args:
        preset: a size, or a suite and a size as ml10-quick.
        file: of settings.
        suite: in place of the preset's.
        method: in place of the file's, or of DMIL.

    Raises:
        ConfigError: names the key, what it got and what is allowed.
    """
    named, _, size = preset.rpartition("-")
    if size not in SIZES or (named and preset not in PRESETS):
        raise ConfigError(
            f"--preset: got {preset!r}; wanted {', '.join(SIZES)}, with --suite, or one of {', '.join(PRESETS)}"
        )
    given = {} if file is None else read_yaml(file, "--config")
    try:
        settings = preset_of(suite or named or DEFAULT_SUITE, size, method or method_named(given)).model_dump()
    except ValidationError as error:
        raise _no_name(suite) from error
    except MethodError as error:
        raise ConfigError(str(error) if file is None or method is not None else f"{file}: {error}") from error
    settings = merged(settings, given, str(file))
    if method is not None:
        settings["method"]["name"] = method
    return checked(settings, "" if file is None else f"{file}: ")


def method_named(given: Mapping[Any, Any]) -> Any:
    """Return the method that some settings, by section, are of."""
    section = given.get("method")
    return section.get("name", DEFAULT_METHOD) if isinstance(section, Mapping) else DEFAULT_METHOD


def suite_settings(suite: str, tasks: Sequence[str] | None = None) -> SuiteConfig:
    """Return the settings of a suite, with `tasks` in place of those of both splits if they are given.

    Raises:
        ConfigError: for what cannot be the name of a suite, or no task at all.
    """
    if tasks is not None and not tasks:
        raise ConfigError("--tasks: got none; wanted at least one; leave it out for all")
    try:
        return SuiteConfig.model_validate({"name": suite, "train_tasks": tasks, "test_tasks": tasks})
    except ValidationError as error:
        raise _no_name(suite) from error


def _no_name(suite: str | None) -> ConfigError:
    return ConfigError(f"--suite: got {shown(suite)}; wanted a name of letters, digits and hyphens, as ml10")


def with_evaluation(config: ExperimentConfig, evaluation: EvaluationConfig) -> ExperimentConfig:
    """Return `config` with another evaluation.

    Raises:
        ConfigError: if the two do not go together.
    """
    return checked({**config.model_dump(), "evaluation": evaluation.model_dump()})


def checked(settings: dict[str, Any], origin: str = "") -> ExperimentConfig:
    """Return the experiment of these settings.

    Raises:
        ConfigError: names the settings that are wrong, each behind `origin`.
    """
    try:
        return ExperimentConfig.model_validate(settings)
    except ValidationError as error:
        raise ConfigError("\n".join(f"{origin}{line}" for line in explain(error).splitlines())) from error


def peek(arguments: Sequence[str], **options: Any) -> argparse.Namespace:
    """Return the few options that decide the defaults of all others: each of `options` is its type."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name, kind in options.items():
        parser.add_argument(f"--{name}", type=kind)
    return parser.parse_known_args(arguments)[0]


def parse(program: type[T], description: str, arguments: Sequence[str], defaults: T) -> T:
    """Read a program's arguments into its dataclass.

    Args:
        program: the dataclass.
        description: the first lines of ``--help``.
        arguments: of the command line.
        defaults: the value of every argument that is not given.

    Raises:
        ConfigError: for a value that a setting does not allow; what is no flag at all ends with exit code 2.
    """
    module = program.__module__ if program.__module__ != "__main__" else f"services.{Path(sys.argv[0]).stem}"
    try:
        given = tyro.cli(program, prog=f"python -m {module}", args=arguments, description=description, default=defaults)
    except ValidationError as error:
        raise ConfigError(explain(error)) from error
    console.terse = getattr(given, "quiet", False)
    return given


def exit_code(program: Callable[[Sequence[str]], None], arguments: Sequence[str]) -> int:
    """Run a program and return its exit code.

    2 for the user's mistake, 1 for what stops a run otherwise, 130 and 143 for Ctrl-C and SIGTERM.
    """
    received: list[int] = []

    def terminate(number: int, frame: object) -> NoReturn:
        received.append(number)
        raise KeyboardInterrupt  # as Ctrl-C; of a class of our own nothing would be left where Ray waits

    signal.signal(signal.SIGTERM, terminate)
    try:
        program(arguments)
    except (UserError, RunError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2 if isinstance(error, UserError) else 1
    except KeyboardInterrupt:
        return 143 if received else 130
    return 0


def main() -> None:
    """Run one of the programs as a subcommand of ``dmil``."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in PROGRAMS:
        sys.exit(exit_code(import_module(f"services.{name.replace('-', '_')}").run, sys.argv[2:]))
    print("usage: dmil PROGRAM [--help]\n")
    for program, purpose in PROGRAMS.items():
        print(f"  {program:15}{purpose}")
    if name not in ("--help", "-h"):
        print(f"\nerror: got the program {name!r}; wanted one of {', '.join(PROGRAMS)}", file=sys.stderr)
        sys.exit(2)
