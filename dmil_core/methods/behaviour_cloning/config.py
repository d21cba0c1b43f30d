"""Settings of behaviour cloning."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from dmil_core.settings import NetworkConfig, WindowConfig


class BehaviourCloningConfig(NetworkConfig, WindowConfig):
    """Behaviour cloning on all meta-training tasks, fine-tuned on the support set."""

    name: Literal["behaviour-cloning"] = "behaviour-cloning"
    """The method."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {
            "method": {
                "hidden_layers": 3,
                "hidden_units": 256,
                "output_scale": 0.07,
                "trajectories": 4,
                "window": 24,
            }
        },
        "smoke": {"method": {"hidden_layers": 2, "hidden_units": 32, "trajectories": 2, "window": 24}},
    }
