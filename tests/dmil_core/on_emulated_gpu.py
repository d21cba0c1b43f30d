"""A program: gradients and adaptations on the emulated GPU against those of the CPU, printed as one line of JSON.

It is a process of its own: torch must know the emulated backend before it first goes backward.
"""

import json
from typing import Any

import numpy as np

from dmil_core.devices import adapted_on
from dmil_core.methods.base import FineTuning, MetaLearner
from dmil_core.methods.registry import method_type
from dmil_core.outer_loop import group_gradient
from dmil_core.policy_tensors import tensors_of
from dmil_core.seeding import named_rng
from tests.dmil_core.carrying import POINTS, demonstrate
from tests.dmil_core.emulated_gpu import emulated_gpu, register

DEMONSTRATIONS = {
    task: [demonstrate(3, seed) for seed in seeds] for task, seeds in (("a", range(5)), ("b", range(5, 10)))
}
NETWORK = {"hidden_layers": 2, "hidden_units": 16, "features": "relative"}
WINDOWS = {**NETWORK, "context": "path", "trajectories": 2, "window": 8}
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "second order, soft": ("dmil", {**WINDOWS, "em": "soft"}),
    "first order, balanced": ("dmil", {**WINDOWS, "order": "first", "balance": "sinkhorn"}),
    "behaviour cloning": ("behaviour-cloning", WINDOWS),
    "per task": ("per-task", NETWORK),
}
TUNINGS = (FineTuning(3, 1e-2), FineTuning(3, 1e-3, "adam", 2))


def farthest(name: str, settings: dict[str, Any]) -> dict[str, float]:
    """Return the greatest difference of each computation on the GPU from that on the CPU."""
    kind, every = method_type(name), [one for task in DEMONSTRATIONS.values() for one in task]
    method = kind.prepared(kind.config_type.model_validate({"name": name, **settings}), 4, every, POINTS)
    parameters, found = method.initial_parameters(named_rng(0, "initial")), {}
    if isinstance(method, MetaLearner):
        here = group_gradient(method, DEMONSTRATIONS, parameters, 0, 0, ["a", "b"], [0, 1]).gradient
        for batched in (False, True) if method.batched else (False,):
            with emulated_gpu() as device:
                moved = {key: tensor.to(device) for key, tensor in parameters.items()}
                there = group_gradient(
                    method, DEMONSTRATIONS, moved, 0, 0, ["a", "b"], [0, 1], batched=batched
                ).gradient
            found["batched" if batched else "loop"] = float(np.abs(there - here).max() / np.abs(here).max())
    for tuning in TUNINGS:
        wanted = tensors_of(method.adapt(parameters, support := every[:2], tuning))
        with emulated_gpu() as device:
            policy = adapted_on(device, method, parameters, support, tuning)
        pairs = zip(wanted.values(), tensors_of(policy).values(), strict=True)
        actions = policy.act(support[0].observations[:2], policy.start(2)).actions
        assert np.isfinite(actions).all(), "it acts on the CPU"
        found[tuning.optimiser] = max(float((one - other).abs().max()) for one, other in pairs)
    return found


if __name__ == "__main__":
    register()
    print(json.dumps({label: farthest(*of) for label, of in METHODS.items()}))
