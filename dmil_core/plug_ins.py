"""What installed packages bring under names of their own, suites and methods alike: distinguished, then imported."""

import traceback
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from dmil_core.errors import UserError


def plug_ins(group: str, ours: Callable[[str], str | None]) -> dict[str, Any]:
    """Return the entry points of a group by name; nothing of their packages is imported.

    Their class is this Python's, or that of the backport ``importlib_metadata`` where somebody has imported that.
    `ours` returns what of our own has a name, in words, or None.

    Raises:
        UserError: if a package registers a name of ours, or two packages one name; whatever name is asked for.
    """
    points: dict[str, Any] = {}
    for point in entry_points(group=group):
        if (taken := ours(point.name)) is not None:
            raise UserError(
                f"entry points {group}: got {point.name} twice, {taken} and {_described(point)}; wanted another name "
                "than any of ours; rename the package's, or uninstall it"
            )
        if (other := points.setdefault(point.name, point)).value != point.value:
            raise UserError(
                f"entry points {group}: got {point.name} twice, {_described(other)} and {_described(point)}; wanted "
                "one package for each name; uninstall either"
            )
    return points


def imported(point: Any, field: str) -> Any:
    """Import what an entry point of `plug_ins` names; `field` is the setting that asks for it.

    Raises:
        UserError: if the import raises anything, `SystemExit` too: only Ctrl-C passes through.
    """
    try:
        return point.load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # importing a package runs its code, which may raise anything
        raise UserError(
            f"{field}: got {point.name}, {_described(point)}, which cannot be imported: {raised(error)}; wanted what "
            "the entry point names; mend its package, or install it again"
        ) from error


def raised(error: BaseException) -> str:
    """Return an error in a package's code in words, with the line of it that was called last."""
    called = traceback.extract_tb(error.__traceback__)[1:]  # the first is the caller of that code
    lines = [frame for frame in called if "importlib" not in frame.filename]
    where = f" ({Path(lines[-1].filename).name}, line {lines[-1].lineno})" if lines else ""
    return f"{type(error).__name__}: {error}{where}"


def _described(point: Any) -> str:
    return f"{point.value} of the package {point.dist.name}"
