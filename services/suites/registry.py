"""Suites by name: our own, and those that installed packages bring."""

import re
from collections.abc import Callable
from importlib import import_module
from typing import Any

from dmil_core.configs import SuiteConfig
from dmil_core.errors import UserError
from dmil_core.plug_ins import imported, plug_ins, raised
from services.suites.base import TaskSuite

ENTRY_POINTS = "dmil.suites"
"""The group of entry points in which a package registers what makes a suite from a `SuiteConfig`."""
OURS = {"kitchen": "services.suites.kitchen:KitchenSuite", "": "services.suites.metaworld:MetaWorldSuite"}
"""By what names begin with; each simulator is imported only where it is used."""
OUR_NAMES = re.compile(r"ml(10|10-reference|45|1-.*)|push-around-wall|kitchen(-.*)?", re.IGNORECASE)
"""Names that no package's suite may have, known before any simulator is imported."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
"""Of a family and of a task."""
ATTRIBUTES: dict[str, type] = {
    "name": str, "family": str, "protocol": str, "obs_dim": int, "action_dim": int, "horizon": int, "best_score": int,
    "train_tasks": tuple, "test_tasks": tuple,
}  # fmt: skip
METHODS = ("make_env", "expert")
IN_PROTOCOL = ("protocol", "goal_visible", "start_noise", "horizon")
"""Settings that an episode depends on, and so the protocol of a suite that uses them."""
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


def _registered() -> dict[str, Any]:
    """Return the entry points of installed packages' suites by name."""
    return plug_ins(ENTRY_POINTS, lambda name: "a suite of our own" if OUR_NAMES.fullmatch(name) else None)


def _plugged_in(point: Any, config: SuiteConfig) -> TaskSuite:
    make: Callable[[SuiteConfig], TaskSuite] = imported(point, "suite.name")
    where = f"suite.name: got {config.name}, {point.value}"
    suite = _made(make, config, where)
    _check_attributes(suite, where)
    _check_settings(make, suite, config, where)
    return suite


def _made(make: Callable[[SuiteConfig], TaskSuite], config: SuiteConfig, where: str) -> TaskSuite:
    try:
        return make(config)
    except (UserError, KeyboardInterrupt):
        raise
    except BaseException as error:  # a package's code may raise anything, SystemExit too
        raise UserError(
            f"{where}: got {raised(error)}; wanted a suite for {config!r}, or a UserError that says what it cannot do"
        ) from error


def _check_attributes(suite: TaskSuite, where: str) -> None:
    """Compare what a package made with `TaskSuite`."""
    for attribute, kind in ATTRIBUTES.items():
        value = getattr(suite, attribute, None)
        if not isinstance(value, kind) or not value or (isinstance(value, int) and value < 1):
            wanted = "an integer of at least 1" if kind is int else f"{kind.__name__}, not empty"
            raise UserError(f"{where}: {attribute}: got {value!r}; wanted {wanted}; see {GUIDE}")
    for method in METHODS:
        if not callable(value := getattr(suite, method, None)):
            raise UserError(f"{where}: {method}: got {value!r}; wanted a method; see {GUIDE}")
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
    """Refuse a suite that ignores a setting, which would then be recorded as though it were in force."""
    for field in ("train_tasks", "test_tasks", "horizon"):
        if (wanted := getattr(config, field)) is not None and (got := getattr(suite, field)) != wanted:
            raise UserError(f"{where}: {field}: got {got!r}; wanted the {wanted!r} of the settings; see {GUIDE}")
    for field in IN_PROTOCOL:
        usual = SuiteConfig.model_fields[field].default
        if (value := getattr(config, field)) == usual:
            continue
        other = _made(make, config.model_copy(update={field: usual}), where)
        if other.protocol == suite.protocol and (field != "horizon" or other.horizon != suite.horizon):
            raise UserError(
                f"suite.{field}: got {value!r}; without it {suite.name} has the same protocol, {suite.protocol!r}; "
                "leave it out, or, if the suite uses it, name it in its protocol"
            )
