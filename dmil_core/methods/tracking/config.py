"""Settings of tracking."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from dmil_core.settings import MethodConfig


class TrackingConfig(MethodConfig):
    """The demonstrated path of the hand, shifted by object and goal."""

    name: Literal["tracking"] = "tracking"
    """The method."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        size: {"training": {"iterations": 0}} for size in ("paper", "quick", "smoke")
    }

    @property
    def uses_points(self) -> bool:
        """Whether it works with the points that a suite declares: always."""
        return True
