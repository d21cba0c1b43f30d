"""Suites by name: our own, and those that installed packages bring."""

import re
import traceback
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from dmil_core.configs import SuiteConfig
from dmil_core.errors import UserError
from services.suites.base import TaskSuite

ENTRY_POINTS = "dmil.suites"
"""The group of entry points in which a package registers what makes a suite from a `SuiteConfig`."""
OURS = {"kitchen": "services.suites.kitchen:KitchenSuite", "": "services.suites.metaworld:MetaWorldSuite"}
"""By what names begin with; each simulator is imported only where it is used."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
"""Of a family and of a task."""
ATTRIBUTES: dict[str, type] = {
    "name": str, "family": str, "protocol": str, "obs_dim": int, "action_dim": int, "horizon": int, "best_score": int,
    "train_tasks": tuple, "test_tasks": tuple,
}  # fmt: skip
METHODS = ("make_env", "expert")
IN_PROTOCOL = ("protocol", "goal_visible", "start_noise", "horizon")
"""Settings that an episode depends on, and so the protocol of a suite that heeds them."""
GUIDE = "docs/your-own-task.md"


def open_suite(config: SuiteConfig) -> TaskSuite:
    """Make the suite that the settings name.

    Raises:
        UserError: for a name, a task or a setting that the suite does not have, or if a package's suite cannot be
            imported, lacks something or ignores a setting.
    """
    registered = _registered()
    if config.name in registered:
        return _plugged_in(registered[config.name], config)
    path = next(path for prefix, path in OURS.items() if config.name.lower().startswith(prefix))
    module, _, name = path.partition(":")
    try:
        return getattr(import_module(module), name)(config)
    except UserError as error:
        if registered and str(error).startswith("suite.name"):
            raise type(error)(f"{error}; or, from installed packages, {', '.join(sorted(registered))}") from error
        raise


def _registered() -> dict[str, EntryPoint]:
    """Return the suites of installed packages by name.

    Raises:
        UserError: if two packages register one name.
    """
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=ENTRY_POINTS):
        if (other := found.setdefault(point.name, point)).value != point.value:
            raise UserError(
                f"entry points {ENTRY_POINTS}: got {point.name} twice, {other.value} and {point.value}; wanted one "
                "package for each name; uninstall either"
            )
    return found


def _plugged_in(point: EntryPoint, config: SuiteConfig) -> TaskSuite:
    where = f"suite.name: got {config.name}, {point.value}"
    try:
        make: Callable[[SuiteConfig], TaskSuite] = point.load()
    except Exception as error:  # importing a package runs its code, which may raise anything
        raise UserError(
            f"{where}, which cannot be imported: {_told(error)}; wanted what the entry point names; mend its package, "
            "or install it again"
        ) from error
    suite = _made(make, config, where)
    _check_attributes(suite, where)
    _check_settings(make, suite, config, where)
    return suite


def _made(make: Callable[[SuiteConfig], TaskSuite], config: SuiteConfig, where: str) -> TaskSuite:
    try:
        return make(config)
    except UserError:
        raise
    except Exception as error:
        raise UserError(
            f"{where}: got {_told(error)}; wanted a suite for {config!r}, or a UserError that says what it cannot do"
        ) from error


def _check_attributes(suite: TaskSuite, where: str) -> None:
    """Compare what a package made with `TaskSuite`.

    Raises:
        UserError: names what is missing, or of another kind.
    """
    for attribute, kind in ATTRIBUTES.items():
        found = getattr(suite, attribute, None)
        if not isinstance(found, kind) or not found or (isinstance(found, int) and found < 1):
            wanted = "an integer of at least 1" if kind is int else f"{kind.__name__}, not empty"
            raise UserError(f"{where}: {attribute}: got {found!r}; wanted {wanted}; see {GUIDE}")
    for method in METHODS:
        if not callable(found := getattr(suite, method, None)):
            raise UserError(f"{where}: {method}: got {found!r}; wanted a method; see {GUIDE}")
    named = [("family", suite.family), *(("tasks", task) for task in (*suite.train_tasks, *suite.test_tasks))]
    for attribute, name in named:
        if not isinstance(name, str) or not NAME.fullmatch(name):
            raise UserError(
                f"{where}: {attribute}: got {name!r}; wanted letters, digits, dots and hyphens: data sets "
                "are named by it"
            )


def _check_settings(
    make: Callable[[SuiteConfig], TaskSuite], suite: TaskSuite, config: SuiteConfig, where: str
) -> None:
    """Compare a suite with what the settings ask for.

    Raises:
        UserError: if it ignores a setting, which would then be recorded as though it were in force.
    """
    for field in ("train_tasks", "test_tasks", "horizon"):
        if (wanted := getattr(config, field)) is not None and (got := getattr(suite, field)) != wanted:
            raise UserError(f"{where}: {field}: got {got!r}; wanted the {wanted!r} of the settings; see {GUIDE}")
    for field in IN_PROTOCOL:
        usual = SuiteConfig.model_fields[field].default
        if (given := getattr(config, field)) == usual:
            continue
        other = _made(make, config.model_copy(update={field: usual}), where)
        if other.protocol == suite.protocol and (field != "horizon" or other.horizon != suite.horizon):
            raise UserError(
                f"suite.{field}: got {given!r}; without it {suite.name} has the same protocol, {suite.protocol!r}; "
                "leave it out, or, if the suite heeds it, name it in its protocol"
            )


def _told(error: Exception) -> str:
    """Return an error in a package's code in words, with the line it comes from."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "importlib" not in frame.filename]
    told, last = f"{type(error).__name__}: {error}", frames[-1]
    return told if last.filename == __file__ else f"{told} ({Path(last.filename).name}, line {last.lineno})"
