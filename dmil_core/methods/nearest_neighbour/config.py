"""Settings of the nearest neighbour."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from dmil_core.settings import MethodConfig


class NearestNeighbourConfig(MethodConfig):
    """The action of the support set's nearest state."""

    name: Literal["nearest-neighbour"] = "nearest-neighbour"
    """The method."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        size: {"training": {"iterations": 0}} for size in ("paper", "quick", "smoke")
    }
