"""Settings from YAML files: read with care, and put in the place of others."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from dmil_core.errors import UserError, nearest, shorten
from dmil_core.files import ForeignFileError, named, read_file

MOST_BYTES = 2**16
"""In a file of settings; PyYAML may need a second for so many."""
DEEPEST = 20
MOST_CHARACTERS = 500
"""Of what PyYAML says."""
INTEGER = r"[-+]?(?:0|[1-9][0-9]*)|0o[0-7]+|0x[0-9a-fA-F]+"
REAL = r"[-+]?(?:\.[0-9]+|(?:0|[1-9][0-9]*)(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
"""What is a number, in files and on the command line alike."""


def merged(settings: Mapping[str, Any], values: Mapping[Any, Any], origin: str, prefix: str = "") -> dict[str, Any]:
    """Return `settings`, by section, with those that are given in their place; messages begin with `origin`.

    Raises:
        UserError: for one that there is not.
    """
    result = dict(settings)
    for key, value in values.items():
        if key not in result:
            named = key if isinstance(key, str) and len(key) < 50 else shorten(key)
            raise UserError(
                f"{origin}: got the unknown key {prefix}{named}; wanted one of {', '.join(result)}"
                f"{nearest(key, result)}"
            )
        if isinstance(result[key], dict):
            if not isinstance(value, dict):
                got = "nothing" if value is None else shorten(value)
                raise UserError(f"{origin}: {prefix}{key}: got {got}; wanted keys: {', '.join(result[key])}")
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
        loader.name = str(file)
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
        got = "nothing" if values is None else f"no keys but {shorten(values)}"
        raise UserError(f"{flag}: got {file} with {got} in it; wanted keys with values")
    return values


class _PlainLoader(yaml.SafeLoader):
    """Reads plain values by the rules of YAML 1.2, where yes, 1:30 and 2024-01-01 are text, and 010 is no number.

    It refuses keys that stand twice, aliases, a few lines of which stand for more than any memory holds, and deep
    nesting.
    """

    depth = 0
    yaml_implicit_resolvers = {}  # noqa: RUF012  none of YAML 1.1's

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Leave the key ``<<`` what it is."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        values = super().construct_mapping(node, deep)
        if len(values) < len(node.value):
            keys = [self.construct_object(key, True) for key, _ in node.value]
            second = next(index for index, key in enumerate(keys) if key in keys[:index])
            raise yaml.MarkedYAMLError(
                problem=f"found the key {keys[second]} twice", problem_mark=node.value[second][0].start_mark
            )
        return values

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


for _tag, _form, _first in (
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", INTEGER, "-+0123456789"),
    ("float", rf"{REAL}|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", "-+.0123456789"),
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
):  # fmt: skip
    _PlainLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"^(?:{_form})$"), list(_first))


def _cut(text: str) -> str:
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]}..."
