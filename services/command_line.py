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

from dmil_core.configs import PRESETS, EvaluationConfig, ExperimentConfig
from dmil_core.errors import RunError, UserError

__all__ = [
    "ConfigError",
    "config_from",
    "exit_code",
    "explain",
    "main",
    "parse",
    "peek",
    "with_evaluation",
]

T = TypeVar("T")
DEFAULT_PRESET = "ml10-quick"
PROGRAMS = {
    "meta-train": "collect demonstrations, meta-train, evaluate",
    "collect-demos": "let the scripted experts make demonstrations",
    "evaluate": "adapt a checkpoint to each task and measure its success rates",
}


class ConfigError(UserError):
    """A setting that is unknown or has an impossible value."""


def config_from(preset: str, file: Path | None) -> ExperimentConfig:
    """Return a preset's settings, with those that a YAML file gives in their place.

    Raises:
        ConfigError: names the key, what it got and what is allowed.
    """
    if preset not in PRESETS:
        raise ConfigError(f"--preset: got {preset!r}; wanted one of {', '.join(PRESETS)}")
    settings = PRESETS[preset].model_dump()
    if file is not None:
        try:
            given = yaml.safe_load(file.read_text())
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise ConfigError(f"--config: got {file}, {error}; wanted a readable YAML file") from error
        if not isinstance(given, dict):
            raise ConfigError(f"--config: got {file} with {type(given).__name__} in it; wanted keys with values")
        _merge(settings, given, str(file), "")
    return _checked(settings)


def with_evaluation(config: ExperimentConfig, evaluation: EvaluationConfig) -> ExperimentConfig:
    """Return `config` with another evaluation.

    Raises:
        ConfigError: if the two do not go together.
    """
    return _checked({**config.model_dump(), "evaluation": evaluation.model_dump()})


def _merge(settings: dict[str, Any], given: dict[Any, Any], file: str, prefix: str) -> None:
    for key, value in given.items():
        if key not in settings:
            raise ConfigError(f"{file}: got the unknown key {prefix}{key}; wanted one of {', '.join(settings)}")
        if isinstance(settings[key], dict):
            if not isinstance(value, dict):
                raise ConfigError(f"{file}: {prefix}{key}: got {value!r}; wanted keys: {', '.join(settings[key])}")
            _merge(settings[key], value, file, f"{prefix}{key}.")
        else:
            settings[key] = value


def _checked(settings: dict[str, Any]) -> ExperimentConfig:
    try:
        return ExperimentConfig.model_validate(settings)
    except ValidationError as error:
        raise ConfigError(explain(error)) from error


def explain(error: ValidationError) -> str:
    """Return one line for each wrong setting: the key, what it got, and what was wanted."""
    lines = []
    for problem in error.errors():
        where = ".".join(map(str, problem["loc"])) or "settings"
        message = problem["msg"].removeprefix("Value error, ")
        # A validator of our own names the key, the value and what was wanted by itself.
        own = problem["type"] == "value_error"
        lines.append(message if own else f"{where}: got {problem['input']!r}; {message[0].lower()}{message[1:]}")
    return "\n".join(lines)


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
    try:
        return tyro.cli(program, args=arguments, description=description, default=defaults)
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
