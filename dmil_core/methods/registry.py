"""Methods by name: our own, and those that installed packages bring."""

from importlib.metadata import entry_points
from typing import Any

from dmil_core.errors import UserError, shown
from dmil_core.methods.base import Standardised
from dmil_core.methods.behaviour_cloning import BehaviourCloning, PerTask
from dmil_core.methods.dmil import Dmil
from dmil_core.methods.mil import Mil
from dmil_core.methods.mlsh import Mlsh
from dmil_core.methods.nearest_neighbour import NearestNeighbour
from dmil_core.methods.option_gail import OptionGail, OptionGailOffline
from dmil_core.methods.pemirl import Pemirl
from dmil_core.settings import MethodConfig

__all__ = ["ENTRY_POINTS", "MethodError", "config_type", "method_names", "method_type"]

ENTRY_POINTS = "dmil.methods"
"""The group of entry points in which a package registers a method, see `Standardised`."""
OURS: dict[str, type[Standardised[Any]]] = {
    "dmil": Dmil,
    "option-gail": OptionGail,
    "option-gail-offline": OptionGailOffline,
    "mil": Mil,
    "mlsh": Mlsh,
    "pemirl": Pemirl,
    "behaviour-cloning": BehaviourCloning,
    "per-task": PerTask,
    "nearest-neighbour": NearestNeighbour,
}
GUIDE = "docs/your-own-method.md"


class MethodError(UserError):
    """A method that there is not, or a package's that cannot be used."""


def method_names() -> list[str]:
    """Return the names of all methods."""
    return [*OURS, *sorted(point.name for point in entry_points(group=ENTRY_POINTS))]


def method_type(name: object) -> type[Standardised[Any]]:
    """Return the class of a method.

    Raises:
        MethodError: for a name that no method has, or a package's class that cannot be imported or is none.
    """
    if isinstance(name, str) and name in OURS:
        return OURS[name]
    for point in entry_points(group=ENTRY_POINTS):
        if point.name == name:
            where = f"method.name: got {name}, {point.value}"
            try:
                found = point.load()
            except Exception as error:  # importing a package runs its code, which may raise anything
                raise MethodError(
                    f"{where}, which cannot be imported: {type(error).__name__}: {error}; wanted what the entry point "
                    "names; mend its package, or install it again"
                ) from error
            if not (isinstance(found, type) and issubclass(found, Standardised)):
                raise MethodError(f"{where}: got {shown(found)}; wanted a class derived from Standardised; see {GUIDE}")
            return found
    raise MethodError(f"method.name: got {shown(name)}; wanted one of {', '.join(method_names())}")


def config_type(name: object) -> type[MethodConfig]:
    """Return the class of a method's settings.

    Raises:
        MethodError: as `method_type`.
    """
    return method_type(name).config_type
