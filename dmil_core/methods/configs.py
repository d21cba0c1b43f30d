"""Settings of methods by name: our own, and those that installed packages bring; torch is not imported for ours."""

from typing import Any

from dmil_core.errors import UserError, nearest, shorten
from dmil_core.methods.behaviour_cloning.config import BehaviourCloningConfig
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.mil.config import MilConfig
from dmil_core.methods.mlsh.config import MlshConfig
from dmil_core.methods.nearest_neighbour.config import NearestNeighbourConfig
from dmil_core.methods.option_gail.config import OptionGailConfig, OptionGailOfflineConfig
from dmil_core.methods.pemirl.config import PemirlConfig
from dmil_core.methods.per_task.config import PerTaskConfig
from dmil_core.methods.tracking.config import TrackingConfig
from dmil_core.plug_ins import imported, plug_ins
from dmil_core.settings import MethodConfig

ENTRY_POINTS = "dmil.methods"
"""The group of entry points in which a package registers a method, see `Method`."""
OURS: dict[str, type[MethodConfig]] = {
    "dmil": DmilConfig,
    "option-gail": OptionGailConfig,
    "option-gail-offline": OptionGailOfflineConfig,
    "mil": MilConfig,
    "mlsh": MlshConfig,
    "pemirl": PemirlConfig,
    "behaviour-cloning": BehaviourCloningConfig,
    "per-task": PerTaskConfig,
    "nearest-neighbour": NearestNeighbourConfig,
    "tracking": TrackingConfig,
}
GUIDE = "docs/your-own-method.md"


def method_names() -> list[str]:
    """Return the names of all methods.

    Raises:
        UserError: if a package registers a name of ours, or two packages one name.
    """
    return [*OURS, *sorted(registered())]


def config_type(name: object) -> type[MethodConfig]:
    """Return the class of a method's settings.

    Those of ours are found without a look at packages: presets are made of them while modules are imported, where an
    error would have a traceback.

    Raises:
        UserError: as `installed`, if the name is none of ours.
    """
    return OURS[name] if isinstance(name, str) and name in OURS else installed(name).config_type


def registered() -> dict[str, Any]:
    """Return the entry points of installed packages' methods by name.

    Raises:
        UserError: as `method_names`.
    """
    return plug_ins(ENTRY_POINTS, lambda name: "a method of our own" if name in OURS else None)


def installed(name: object) -> type[Any]:
    """Import the class, derived from `Method`, of the method that an installed package brings.

    Raises:
        UserError: for a name that no method has, a package's class that cannot be imported or is none, or, whatever
            is asked for, as `method_names`.
    """
    points = registered()
    if not isinstance(name, str) or name not in points:
        known = method_names()
        raise UserError(f"method.name: got {shorten(name)}; wanted one of {', '.join(known)}{nearest(name, known)}")
    method = imported(points[name], "method.name")
    from dmil_core.methods.base import Method

    if not (isinstance(method, type) and issubclass(method, Method)):
        raise UserError(
            f"method.name: got {name}, {points[name].value}: got {shorten(method)}; wanted a class derived from "
            f"Method; see {GUIDE}"
        )
    return method
