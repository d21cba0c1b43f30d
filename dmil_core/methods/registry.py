"""Methods by name: our own, and those that installed packages bring."""

from importlib.metadata import entry_points
from typing import Any

from dmil_core.errors import UserError, shown
from dmil_core.methods.base import Method
from dmil_core.methods.behaviour_cloning.method import BehaviourCloning
from dmil_core.methods.dmil.method import Dmil
from dmil_core.methods.mil.method import Mil
from dmil_core.methods.mlsh.method import Mlsh
from dmil_core.methods.nearest_neighbour.method import NearestNeighbour
from dmil_core.methods.option_gail.method import OptionGail, OptionGailOffline
from dmil_core.methods.pemirl.method import Pemirl
from dmil_core.methods.per_task.method import PerTask
from dmil_core.settings import MethodConfig

ENTRY_POINTS = "dmil.methods"
"""The group of entry points in which a package registers a method, see `Method`."""
OURS: dict[str, type[Method[Any]]] = {
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
    """A method that there is not, that there is twice, or a package's that cannot be used."""


def method_names() -> list[str]:
    """Return the names of all methods.

    Raises:
        MethodError: if a package registers a name of ours, or two packages one name.
    """
    return [*OURS, *sorted(_registered())]


def method_type(name: object) -> type[Method[Any]]:
    """Return the class of a method.

    Raises:
        MethodError: for a name that no method has, a package's class that cannot be imported or is none, or, whatever
            is asked for, as `method_names`.
    """
    registered = _registered()
    if isinstance(name, str):
        if name in OURS:
            return OURS[name]
        if name in registered:
            return _loaded(registered[name])
    raise MethodError(f"method.name: got {shown(name)}; wanted one of {', '.join(method_names())}")


def config_type(name: object) -> type[MethodConfig]:
    """Return the class of a method's settings.

    Those of ours are found without a look at packages: presets are made of them while modules are imported, where an
    error would not be told in words.

    Raises:
        MethodError: as `method_type`, if the name is none of ours.
    """
    if isinstance(name, str) and name in OURS:
        return OURS[name].config_type
    return method_type(name).config_type


def _registered() -> dict[str, Any]:
    """Return the entry points of installed packages' methods by name.

    Their class is this Python's, or that of the backport ``importlib_metadata`` where somebody has imported that.
    """
    found: dict[str, Any] = {}
    for point in entry_points(group=ENTRY_POINTS):
        if (ours := OURS.get(point.name)) is not None:
            raise MethodError(
                f"entry points {ENTRY_POINTS}: got {point.name} twice, our own {ours.__module__}:{ours.__name__} and "
                f"{point.value}; wanted another name than any of ours; rename the package's, or uninstall it"
            )
        if (other := found.setdefault(point.name, point)).value != point.value:
            raise MethodError(
                f"entry points {ENTRY_POINTS}: got {point.name} twice, {other.value} and {point.value}; wanted one "
                "package for each name; uninstall either"
            )
    return found


def _loaded(point: Any) -> type[Method[Any]]:
    """Import the class that a package registers."""
    where = f"method.name: got {point.name}, {point.value}"
    try:
        found = point.load()
    except Exception as error:  # importing a package runs its code, which may raise anything
        raise MethodError(
            f"{where}, which cannot be imported: {type(error).__name__}: {error}; wanted what the entry point names; "
            "mend its package, or install it again"
        ) from error
    if not (isinstance(found, type) and issubclass(found, Method)):
        raise MethodError(f"{where}: got {shown(found)}; wanted a class derived from Method; see {GUIDE}")
    return found
