"""Suites by name: our own, and those that installed packages bring."""

import re
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points

from dmil_core.configs import SuiteConfig
from dmil_core.errors import UserError
from services.suites.base import TaskSuite

__all__ = ["ENTRY_POINTS", "SuiteError", "open_suite"]

ENTRY_POINTS = "dmil.suites"
"""The group of entry points in which a package registers what makes a suite from a `SuiteConfig`."""
OURS = {"kitchen": "services.suites.kitchen:KitchenSuite", "": "services.suites.metaworld:MetaWorldSuite"}
"""By what names begin with; each simulator is imported only where it is used."""
TASK = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
ATTRIBUTES: dict[str, type] = {
    "name": str, "family": str, "protocol": str, "obs_dim": int, "action_dim": int, "horizon": int, "best_score": int,
    "train_tasks": tuple, "test_tasks": tuple,
}  # fmt: skip


class SuiteError(UserError):
    """A package whose suite cannot be used."""


def open_suite(config: SuiteConfig) -> TaskSuite:
    """Make the suite that the settings name.

    Raises:
        UserError: for a name, a task or a setting that the suite does not have.
        SuiteError: if a package's suite cannot be imported, or lacks something.
    """
    registered = {point.name: point for point in entry_points(group=ENTRY_POINTS)}
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


def _plugged_in(point: EntryPoint, config: SuiteConfig) -> TaskSuite:
    where = f"suite.name: got {config.name}, {point.value}"
    try:
        make: Callable[[SuiteConfig], TaskSuite] = point.load()
    except (ImportError, AttributeError) as error:
        raise SuiteError(
            f"{where}, which cannot be imported: {error}; wanted what the entry point names; install its package again"
        ) from error
    suite = make(config)
    for attribute, kind in ATTRIBUTES.items():
        if not isinstance(found := getattr(suite, attribute, None), kind):
            raise SuiteError(f"{where}: {attribute}: got {found!r}; wanted {kind.__name__}; see docs/your-own-task.md")
    for task in (*suite.train_tasks, *suite.test_tasks):
        if not isinstance(task, str) or not TASK.fullmatch(task):
            raise SuiteError(f"{where}: got the task {task!r}; wanted a name of letters, digits, dots and hyphens")
    return suite
