"""What programs say of themselves and of their flags: `--help` in paragraphs, and in one line what a flag may be."""

import dataclasses
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructTypeInfo,
)

from dmil_core.errors import describe_errors
from services.cli.yaml_files import INTEGER, REAL

NUMBERS = {int: (INTEGER, "an integer, as 10"), float: (rf"{REAL}|[-+]?inf|nan", "a number, as 0.1 or 1e-3")}
"""How numbers are written on the command line, and the words for it."""
REPORTS = {
    kind: f"services.report_{kind.replace('-', '_')}"
    for kind in ("run", "compare", "sub-skills", "video", "gallery", "tables")
}
"""What the program ``report`` draws, and the module that does."""
COMMANDS = {
    "services.inspect_demos": "services.collect_demos inspect",
    "services.record_demos": "services.collect_demos record",
    "services.verify_experts": "services.collect_demos verify",
    "services.tracking.__main__": "services.tracking",
    **{module: f"services.report {kind}" for kind, module in REPORTS.items()},
}
"""How modules are called that are no program of their own name."""


def command_of(module: str) -> str:
    """Return how a program is called, as ``dmil report run`` or ``python -m services.report run``."""
    if module == "__main__":
        spec = sys.modules["__main__"].__spec__
        module = spec.name if spec is not None else f"services.{Path(sys.argv[0]).stem}"
    words = COMMANDS.get(module, module)
    if Path(sys.argv[0]).name != "dmil":
        return f"python -m {words}"
    program, _, rest = words.removeprefix("services.").partition(" ")
    return f"dmil {program.replace('_', '-')} {rest}".rstrip()


def flowing(text: str) -> str:
    """Return a text with each paragraph on a line of its own; lines that are set in keep theirs."""
    paragraphs = [part if part.startswith(" ") else " ".join(part.split()) for part in text.strip("\n").split("\n\n")]
    return "\n\n".join(paragraphs)


def flowing_registry() -> ConstructorRegistry:
    """Return what has tyro show the texts of settings as paragraphs, and take as a number what is one in a file."""
    registry, asked = ConstructorRegistry(), list[StructTypeInfo]()

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        if any(info is one for one in asked):  # by the line below: tyro's own rule is meant
            return None
        asked.append(info)
        spec = ConstructorRegistry.get_struct_spec(info)
        asked.pop()
        if not isinstance(spec, StructConstructorSpec):
            return None
        fields = tuple(dataclasses.replace(field, helptext=_flown(field.helptext)) for field in spec.fields)
        return dataclasses.replace(spec, fields=fields, instantiate=_told(spec.instantiate))

    @registry.primitive_rule
    def number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[float] | None:
        if info.type not in NUMBERS:
            return None
        kind, (form, wanted) = info.type, NUMBERS[info.type]

        def read(texts: list[str]) -> float:
            if not re.fullmatch(form, texts[0]):
                raise ValueError(f"got {texts[0]!r}; wanted {wanted}")
            return int(texts[0], 0) if kind is int else float(texts[0])

        numeric = (int, float) if kind is float else int
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=kind.__name__.upper(),
            instance_from_str=read,
            is_instance=lambda value: isinstance(value, numeric) and not isinstance(value, bool),
            str_from_instance=lambda value: [str(value)],
        )

    return registry


class InvalidSettingsError(Exception):
    """Settings that pydantic refuses; tyro would draw a box around its words."""

    def __init__(self, error: ValidationError) -> None:
        super().__init__(str(error))
        self.error = error


def _told(make: Callable[..., Any]) -> Callable[..., Any]:
    def told(*values: Any, **named: Any) -> Any:
        try:
            return make(*values, **named)
        except ValidationError as error:
            raise InvalidSettingsError(error) from error

    return told


def describe_flags(error: ValidationError, defaults: Any) -> str:
    """Return what is wrong with settings, a line for each of the flags.

    The error is of one of the models in `defaults`, a program's arguments, in which the sections are found by their
    classes.
    """
    section = dict(_sections(defaults, "")).get(error.title, "")
    lines = []
    for line in describe_errors(error).splitlines():
        field, colon, rest = line.partition(":")
        lines.append(f"--{section}{field.replace('_', '-')}:{rest}" if colon and " " not in field else line)
    return "\n".join(lines)


def _sections(value: Any, prefix: str) -> Iterator[tuple[str, str]]:
    """Yield the class of each section of settings, and what its flags begin with."""
    if isinstance(value, BaseModel):
        yield type(value).__name__, prefix
    names = type(value).model_fields if isinstance(value, BaseModel) else getattr(value, "__dataclass_fields__", ())
    for name in names:
        if isinstance(inner := getattr(value, name), BaseModel):
            yield from _sections(inner, "" if name == "experiment" else f"{prefix}{name}.")


def _flown(text: str | Callable[[], str | None] | None) -> Callable[[], str | None]:
    def flown() -> str | None:
        words = text() if callable(text) else text
        return None if words is None else " ".join(words.split())

    return flown
