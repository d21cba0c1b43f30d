"""Settings of behaviour cloning on the support set alone."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from dmil_core.settings import SMOKE_NETWORK, NetworkConfig


class PerTaskConfig(NetworkConfig):
    """Behaviour cloning from fresh weights on the support set alone."""

    name: Literal["per-task"] = "per-task"
    """The method."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"training": {"iterations": 0}, "evaluation": {"fine_tuning_steps": 1000, "learning_rate": 1e-3}},
        "quick": {
            "method": {"hidden_layers": 3, "hidden_units": 256},
            "training": {"iterations": 0},
            "evaluation": {"fine_tuning_steps": 1000, "learning_rate": 1e-3},
        },
        "smoke": {"method": SMOKE_NETWORK, "training": {"iterations": 0}},
    }
