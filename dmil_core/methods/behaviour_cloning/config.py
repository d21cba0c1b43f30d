"""Settings of behaviour cloning."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from dmil_core.settings import QUICK_NETWORK, SMOKE_NETWORK, ContextConfig, NetworkConfig, WindowConfig


class BehaviourCloningConfig(NetworkConfig, WindowConfig, ContextConfig):
    """Behaviour cloning on all meta-training tasks, fine-tuned on the support set."""

    name: Literal["behaviour-cloning"] = "behaviour-cloning"
    """The method."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {"method": {**QUICK_NETWORK, "trajectories": 4, "window": 24}},
        "smoke": {"method": {**SMOKE_NETWORK, "trajectories": 2, "window": 24}},
    }
