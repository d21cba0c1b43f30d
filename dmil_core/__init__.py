"""Dual Meta Imitation Learning: the science, without Ray, MLflow or a simulator.

From somebody's checkpoint and a few demonstrations to a policy::

    import dmil_core as dmil

    model = dmil.load("ml45")
    policy = model.adapt([(observations, actions)] * 3)
    policy.reset()
    action = policy(observation)

What is named here is imported when it is first used: torch takes seconds.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dmil_core.adapted_policy import AdaptedPolicy, load_policy
    from dmil_core.demonstrations import Demonstration, DemonstrationError
    from dmil_core.errors import RunError, UserError
    from dmil_core.model import DivergedError, Model, UnlikeTrainingWarning, load, track
    from dmil_core.points import Points

_PLACES = {
    "AdaptedPolicy": "adapted_policy",
    "Demonstration": "demonstrations",
    "DemonstrationError": "demonstrations",
    "DivergedError": "model",
    "Model": "model",
    "Points": "points",
    "RunError": "errors",
    "UnlikeTrainingWarning": "model",
    "UserError": "errors",
    "load": "model",
    "load_policy": "adapted_policy",
    "track": "model",
}
__all__ = [
    "AdaptedPolicy",
    "Demonstration",
    "DemonstrationError",
    "DivergedError",
    "Model",
    "Points",
    "RunError",
    "UnlikeTrainingWarning",
    "UserError",
    "load",
    "load_policy",
    "track",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return __all__
