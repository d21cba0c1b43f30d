"""Settings from YAML files: read with care, and put in the place of others."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from dmil_core.errors import UserError, shorten
from dmil_core.files import ForeignFileError, named, read_file

MOST_BYTES = 2**16
"""In a file of settings; PyYAML may need a second for so many."""
DEEPEST = 20
MOST_CHARACTERS = 500
"""Of what PyYAML says."""


def merged(settings: Mapping[str, Any], values: Mapping[Any, Any], origin: str, prefix: str = "") -> dict[str, Any]:
    """Return `settings`, by section, with those that are given in their place; messages begin with `origin`.

    Raises:
        UserError: for one that there is not.
    """
    result = dict(settings)
    for key, value in values.items():
        if key not in result:
            named = key if isinstance(key, str) and len(key) < 50 else shorten(key)
            raise UserError(f"{origin}: got the unknown key {prefix}{named}; wanted one of {', '.join(result)}")
        if isinstance(result[key], dict):
            if not isinstance(value, dict):
                raise UserError(f"{origin}: {prefix}{key}: got {shorten(value)}; wanted keys: {', '.join(result[key])}")
            value = merged(result[key], value, origin, f"{prefix}{key}.")
        result[key] = value
    return result


def read_yaml(file: Path, flag: str) -> dict[Any, Any]:
    """Return the keys and values of a file.

    Raises:
        UserError: names `flag` and the file that is none, or is too large, nested or damaged to be read.
    """
    try:
        loader = _PlainLoader(read_file(*named(file), MOST_BYTES).decode())
        try:
            values = loader.get_single_data()
        finally:
            loader.dispose()
    except ForeignFileError as error:
        raise UserError(f"{flag}: got {file}, {error.strerror}; wanted a readable YAML file") from error
    # Besides its own errors, PyYAML lets through what comes of dates, numbers and tags that are none.
    except (OSError, yaml.YAMLError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise UserError(f"{flag}: got {file}, {_cut(str(error))}; wanted a readable YAML file") from error
    if not isinstance(values, dict):
        raise UserError(f"{flag}: got {file} with {type(values).__name__} in it; wanted keys with values")
    return values


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


def _cut(text: str) -> str:
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]}..."
