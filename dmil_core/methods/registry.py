"""Methods by name: our own, and those that installed packages bring; their settings are in `configs`."""

from typing import Any

from dmil_core.methods.base import Method
from dmil_core.methods.behaviour_cloning.method import BehaviourCloning
from dmil_core.methods.configs import installed, registered
from dmil_core.methods.dmil.method import Dmil
from dmil_core.methods.mil.method import Mil
from dmil_core.methods.mlsh.method import Mlsh
from dmil_core.methods.nearest_neighbour.method import NearestNeighbour
from dmil_core.methods.option_gail.method import OptionGail, OptionGailOffline
from dmil_core.methods.pemirl.method import Pemirl
from dmil_core.methods.per_task.method import PerTask
from dmil_core.methods.tracking.method import Tracking

OURS: dict[str, type[Method[Any]]] = {
    method.config_type.model_fields["name"].default: method
    for method in (
        Dmil, OptionGail, OptionGailOffline, Mil, Mlsh, Pemirl, BehaviourCloning, PerTask, NearestNeighbour, Tracking,
    )
}  # fmt: skip


def method_type(name: object) -> type[Method[Any]]:
    """Return the class of a method.

    Raises:
        UserError: as `installed` of `dmil_core.methods.configs`.
    """
    if isinstance(name, str) and name in OURS:
        registered()  # refuses a package that takes a name of ours
        return OURS[name]
    return installed(name)
