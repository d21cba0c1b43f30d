"""Methods by name: our own, and those that installed packages bring."""

from typing import Any

from dmil_core.errors import UserError, nearest, shorten
from dmil_core.methods.base import Method
from dmil_core.methods.behaviour_cloning.method import BehaviourCloning
from dmil_core.methods.dmil.method import Dmil
from dmil_core.methods.mil.method import Mil
from dmil_core.methods.mlsh.method import Mlsh
from dmil_core.methods.nearest_neighbour.method import NearestNeighbour
from dmil_core.methods.option_gail.method import OptionGail, OptionGailOffline
from dmil_core.methods.pemirl.method import Pemirl
from dmil_core.methods.per_task.method import PerTask
from dmil_core.methods.tracking.method import Tracking
from dmil_core.plug_ins import imported, plug_ins
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
    "tracking": Tracking,
}
GUIDE = "docs/your-own-method.md"


def method_names() -> list[str]:
    """Return the names of all methods.

    Raises:
        UserError: if a package registers a name of ours, or two packages one name.
    """
    return [*OURS, *sorted(_registered())]


def method_type(name: object) -> type[Method[Any]]:
    """Return the class of a method.

    Raises:
        UserError: for a name that no method has, a package's class that cannot be imported or is none, or, whatever
            is asked for, as `method_names`.
    """
    registered = _registered()
    if isinstance(name, str):
        if name in OURS:
            return OURS[name]
        if name in registered:
            return _loaded(registered[name])
    known = method_names()
    raise UserError(f"method.name: got {shorten(name)}; wanted one of {', '.join(known)}{nearest(name, known)}")


def config_type(name: object) -> type[MethodConfig]:
    """Return the class of a method's settings.

    Those of ours are found without a look at packages: presets are made of them while modules are imported, where an
    error would have a traceback.

    Raises:
        UserError: as `method_type`, if the name is none of ours.
    """
    if isinstance(name, str) and name in OURS:
        return OURS[name].config_type
    return method_type(name).config_type


def _registered() -> dict[str, Any]:
    """Return the entry points of installed packages' methods by name."""
    return plug_ins(ENTRY_POINTS, _ours)


def _ours(name: str) -> str | None:
    return f"our own {OURS[name].__module__}:{OURS[name].__name__}" if name in OURS else None


def _loaded(point: Any) -> type[Method[Any]]:
    """Import the class that a package registers."""
    method = imported(point, "method.name")
    if not (isinstance(method, type) and issubclass(method, Method)):
        raise UserError(
            f"method.name: got {point.name}, {point.value}: got {shorten(method)}; wanted a class derived from "
            f"Method; see {GUIDE}"
        )
    return method
