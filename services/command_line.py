"""What all programs share: settings from a preset, a YAML file and flags, and errors that teach."""

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import tyro
import yaml
from pydantic import ValidationError

from dmil_core.configs import PRESETS, SIZES, EvaluationConfig, ExperimentConfig, SuiteConfig, preset_of
from dmil_core.errors import RunError, UserError, explain, shown
from services.disk import read_file

__all__ = [
    "ConfigError",
    "config_from",
    "defaults_from",
    "exit_code",
    "main",
    "parse",
    "peek",
    "suite_settings",
    "with_evaluation",
]

T = TypeVar("T")
DEFAULT_SUITE, DEFAULT_PRESET = "ml10", "quick"
MOST_BYTES = 2**16
"""In a file of settings; PyYAML may need a second for so many."""
DEEPEST = 20
MOST_CHARACTERS = 500
"""Of what PyYAML says."""
PROGRAMS = {
    "meta-train": "collect demonstrations, meta-train, evaluate",
    "collect-demos": "let the scripted experts make demonstrations",
    "evaluate": "adapt a checkpoint to each task and measure its success rates",
}


class ConfigError(UserError):
    """A setting that is unknown or has an impossible value."""


def defaults_from(arguments: Sequence[str]) -> ExperimentConfig:
    """Return what ``--preset``, ``--suite``, ``--config`` and ``--demos`` in a program's arguments say all others are.

    Raises:
        ConfigError: as `config_from`.
    """
    early = peek(arguments, preset=str, suite=str, config=Path, demos=str)
    config = config_from(early.preset or DEFAULT_PRESET, early.config, early.suite)
    if early.demos is None:
        return config
    demonstrations = config.demonstrations.model_copy(update={"source": early.demos})
    return config.model_copy(update={"demonstrations": demonstrations})


def config_from(preset: str, file: Path | None, suite: str | None = None) -> ExperimentConfig:
    """Return a preset's settings, with those that a YAML file gives in their place.

    Args:
        preset: a size, or a suite and a size as ml10-quick.
        file: of settings.
        suite: in place of the preset's.

    Raises:
        ConfigError: names the key, what it got and what is allowed.
    """
    named, _, size = preset.rpartition("-")
    if size not in SIZES or (named and preset not in PRESETS):
        raise ConfigError(
            f"--preset: got {preset!r}; wanted {', '.join(SIZES)}, with --suite, or one of {', '.join(PRESETS)}"
        )
    try:
        settings = preset_of(suite or named or DEFAULT_SUITE, size).model_dump()
    except ValidationError as error:
        raise _no_name(suite) from error
    if file is not None:
        given = _read_yaml(file)
        if not isinstance(given, dict):
            raise ConfigError(f"--config: got {file} with {type(given).__name__} in it; wanted keys with values")
        _merge(settings, given, str(file), "")
    return _checked(settings, "" if file is None else f"{file}: ")


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


class _PlainLoader(yaml.SafeLoader):
    """Refuses aliases, a few lines of which stand for more than any memory holds, and deep nesting."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent) or self.depth == DEEPEST:
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(
                problem="found an alias or deep nesting, which no setting needs", problem_mark=mark
            )
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def _read_yaml(file: Path) -> Any:
    try:
        loader = _PlainLoader(read_file(file, MOST_BYTES).decode())
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    # Besides its own errors, PyYAML lets through what comes of dates, numbers and tags that are none.
    except (OSError, yaml.YAMLError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise ConfigError(f"--config: got {file}, {_cut(str(error))}; wanted a readable YAML file") from error


def _cut(text: str) -> str:
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]}..."


def with_evaluation(config: ExperimentConfig, evaluation: EvaluationConfig) -> ExperimentConfig:
    """Return `config` with another evaluation.

    Raises:
        ConfigError: if the two do not go together.
    """
    return _checked({**config.model_dump(), "evaluation": evaluation.model_dump()})


def _merge(settings: dict[str, Any], given: dict[Any, Any], file: str, prefix: str) -> None:
    for key, value in given.items():
        if key not in settings:
            named = key if isinstance(key, str) and len(key) < 50 else shown(key)
            raise ConfigError(f"{file}: got the unknown key {prefix}{named}; wanted one of {', '.join(settings)}")
        if isinstance(settings[key], dict):
            if not isinstance(value, dict):
                raise ConfigError(f"{file}: {prefix}{key}: got {shown(value)}; wanted keys: {', '.join(settings[key])}")
            _merge(settings[key], value, file, f"{prefix}{key}.")
        else:
            settings[key] = value


def _checked(settings: dict[str, Any], origin: str = "") -> ExperimentConfig:
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
        return tyro.cli(program, prog=f"python -m {module}", args=arguments, description=description, default=defaults)
    except ValidationError as error:
        raise ConfigError(explain(error)) from error


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
