"""An experiment's settings put together from a preset, a YAML file and the options that decide their defaults."""

from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dmil_core.configs import (
    BASE_PRESETS,
    DEFAULT_METHOD,
    PRESETS,
    EvaluationConfig,
    ExperimentConfig,
    SuiteConfig,
    preset_of,
)
from dmil_core.errors import UserError, describe_errors, nearest, shorten
from services.cli.yaml_files import merged, read_yaml

DEFAULT_SUITE, DEFAULT_PRESET = "ml10", "quick"
EARLY = {"preset": str, "suite": str, "method": str, "config": Path, "demos": str}
"""The options, with their types, that decide the defaults of all other settings."""


def defaults_from(early: Namespace) -> ExperimentConfig:
    """Return the settings that the early options ask for; see `EARLY`.

    Raises:
        UserError: as `config_from`.
    """
    return config_from(early.preset or DEFAULT_PRESET, early.config, early.suite, early.method, early.demos)


def config_from(
    preset: str, file: Path | None, suite: str | None = None, method: str | None = None, demos: str | None = None
) -> ExperimentConfig:
    """Return a preset's settings, with those that a YAML file, and then the other arguments, give in their place.

    A preset is a size, or a suite and a size as ml10-quick; `demos` is the source of demonstrations.

    Raises:
        UserError: names the key, what it got and what is allowed.
    """
    named, _, size = preset.rpartition("-")
    if size not in BASE_PRESETS or (named and preset not in PRESETS):
        raise UserError(
            f"--preset: got {preset!r}; wanted {', '.join(BASE_PRESETS)}, with --suite, or one of "
            f"{', '.join(PRESETS)}{nearest(preset, [*BASE_PRESETS, *PRESETS])}"
        )
    if suite is not None and named and suite.lower() != named.lower():
        raise UserError(
            f"--suite: got {suite} with --preset {preset}, which is {named}'s; wanted one suite; give --preset {size}"
        )
    from_file = {} if file is None else read_yaml(file, "--config")
    try:
        settings = preset_of(suite or named or DEFAULT_SUITE, size, method or method_named(from_file)).model_dump()
    except ValidationError as error:
        raise _no_name(suite) from error
    except UserError as error:
        raise UserError(str(error) if file is None or method is not None else f"{file}: {error}") from error
    settings = merged(settings, from_file, str(file))
    if method is not None:
        settings["method"]["name"] = method
    if demos is not None:
        settings["demonstrations"]["source"] = demos
    return checked(settings, "" if file is None else f"{file}: ")


def method_named(from_file: Mapping[Any, Any]) -> Any:
    """Return the method that some settings, by section, are of."""
    section = from_file.get("method")
    return section.get("name", DEFAULT_METHOD) if isinstance(section, Mapping) else DEFAULT_METHOD


def suite_settings(suite: str, tasks: Sequence[str] | None = None) -> SuiteConfig:
    """Return the settings of a suite, with `tasks` in place of those of both splits if they are given.

    Raises:
        UserError: for what cannot be the name of a suite, or no task at all.
    """
    if tasks is not None and not tasks:
        raise UserError("--tasks: got none; wanted at least one; leave it out for all")
    try:
        return SuiteConfig.model_validate({"name": suite, "train_tasks": tasks, "test_tasks": tasks})
    except ValidationError as error:
        named = all(problem["loc"] == ("name",) for problem in error.errors())
        raise _no_name(suite) if named else UserError(f"--tasks: {describe_errors(error, separator='; ')}") from error


def _no_name(suite: str | None) -> UserError:
    return UserError(f"--suite: got {shorten(suite)}; wanted a name of letters, digits and hyphens, as ml10")


def with_evaluation(config: ExperimentConfig, evaluation: EvaluationConfig) -> ExperimentConfig:
    """Return `config` with another evaluation.

    Raises:
        UserError: if the two do not go together.
    """
    return checked({**config.model_dump(), "evaluation": evaluation.model_dump()})


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return settings, which are by section, under their whole names, as ``training.iterations``."""
    named: dict[str, Any] = {}
    for name, value in settings.items():
        named |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return named


def checked(settings: dict[str, Any], origin: str = "") -> ExperimentConfig:
    """Return the experiment of these settings.

    Raises:
        UserError: names the settings that are wrong, each behind `origin`.
    """
    try:
        return ExperimentConfig.model_validate(settings)
    except ValidationError as error:
        raise UserError("\n".join(f"{origin}{line}" for line in describe_errors(error).splitlines())) from error
