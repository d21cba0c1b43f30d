"""A run's settings: those that differ from the nearest preset first, and as the flags that give them again."""

import shlex
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from pydantic import BaseModel

from dmil_core.configs import BASE_PRESETS, ExperimentConfig, preset_of
from dmil_core.errors import UserError
from services.cli.composition import flat
from services.experiments.finished_run import FinishedRun
from services.reporting.page import DataTable, Part, Prose, Section
from services.suites.registry import open_suite


class Nearest(NamedTuple):
    """The preset that the fewest settings differ from."""

    size: str
    settings: dict[str, Any]
    """Of it, by their full names, as training.iterations."""
    differing: dict[str, Any]
    """The settings that are not the preset's."""


def nearest_preset(config: ExperimentConfig) -> Nearest:
    """Return the preset of a run's own suite and method that is nearest to its settings."""
    settings = flat(_as_given(config).model_dump())
    presets = []
    for size in BASE_PRESETS:
        preset = flat(preset_of(config.suite.name, size, config.method.name).model_dump())
        differing = {name: value for name, value in settings.items() if name not in preset or preset[name] != value}
        presets.append(Nearest(size, preset, differing))
    return min(presets, key=lambda nearest: len(nearest.differing))


def _as_given(config: ExperimentConfig) -> ExperimentConfig:
    """Return settings without points that the suite itself declares, as a run adds them."""
    try:
        declared = getattr(open_suite(config.suite), "points", None)
    except UserError:  # its package is not here
        declared = None
    if declared is None or config.suite.points != declared:
        return config
    return config.model_copy(update={"suite": config.suite.model_copy(update={"points": None})})


def flags(settings: Mapping[str, Any]) -> str:
    """Return settings as programs take them on their command lines."""
    return " ".join(shlex.join(_flag(name, value)) for name, value in settings.items())


def _flag(name: str, value: Any) -> list[str]:
    section, dot, field = name.replace("_", "-").rpartition(".")
    if isinstance(value, bool):
        return [f"--{section}{dot}{field if value else f'no-{field}'}"]
    values = value if isinstance(value, list | tuple) else [value]
    return [f"--{section}{dot}{field}", *map(str, values)]


def settings_of_run(finished: FinishedRun) -> Section:
    """Return the section with all settings, those that differ from the nearest preset's apart."""
    config = finished.config
    size, preset, differing = nearest_preset(config)
    meanings = dict(_meanings(config))
    name = f"{size} of {config.method.name} on {config.suite.name}"
    text = (
        f"The preset {name} is the nearest; {len(differing)} of {len(preset)} settings differ from it."
        if differing
        else f"All settings are those of the preset {name}."
    )
    others = {name: value for name, value in flat(config.model_dump()).items() if name not in differing}
    changed = [[n, _text(v), _text(preset.get(n)), meanings.get(n, "")] for n, v in differing.items()]
    same = [[n, _text(v), meanings.get(n, "")] for n, v in others.items()]
    parts: list[Part] = [Prose(text)]
    if changed:
        parts.append(DataTable("Settings that differ", ["setting", "here", f"in {size}", "what it is"], changed))
    return Section(
        "Settings", [*parts, DataTable("Settings as in the preset", ["setting", "value", "what it is"], same)]
    )


def _meanings(settings: BaseModel, prefix: str = "") -> Iterator[tuple[str, str]]:
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if isinstance(value, BaseModel):
            yield from _meanings(value, f"{prefix}{name}.")
        elif field.description:
            yield f"{prefix}{name}", " ".join(field.description.split())


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    return "none" if value is None else str(value)
