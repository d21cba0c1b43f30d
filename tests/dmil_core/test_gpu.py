"""What only a card can show: `pytest -m gpu`. None of it has run yet on one."""

import numpy as np
import pytest
import torch

from dmil_core.devices import adapted_on, device_of
from dmil_core.errors import WorkError
from dmil_core.methods.base import FineTuning
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.method import Dmil
from dmil_core.networks import Parameters
from dmil_core.outer_loop import GroupGradient, group_gradient
from dmil_core.policy_tensors import tensors_of
from dmil_core.seeding import named_rng
from tests.dmil_core.carrying import POINTS, demonstrate

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")]
DEMONSTRATIONS = {"a": [demonstrate(3, seed) for seed in range(5)], "b": [demonstrate(2, seed) for seed in range(6)]}
EVERY = [one for task in DEMONSTRATIONS.values() for one in task]


def method(**settings: str | int) -> Dmil:
    config = {"features": "relative", "context": "path", "trajectories": 2, "window": 8, "hidden_units": 64, **settings}
    return Dmil.prepared(DmilConfig.model_validate(config), 4, EVERY, POINTS)


def on(device: torch.device, method: Dmil) -> Parameters:
    return {name: tensor.to(device) for name, tensor in method.initial_parameters(named_rng(0, "initial")).items()}


def gradient(method: Dmil, device: str, *, batched: bool) -> GroupGradient:
    moved = on(device_of(device), method)
    return group_gradient(method, DEMONSTRATIONS, moved, 0, 0, ["a", "b", "a"], [0, 1, 2], batched=batched)


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("order", ["first", "second"])
def test_a_gradient_equals_the_cpu_s_and_itself(order: str, batched: bool) -> None:
    wanted = gradient(method(order=order), "cpu", batched=False).gradient
    once, twice = (gradient(method(order=order), "cuda", batched=batched).gradient for _ in range(2))
    assert np.linalg.norm(once - wanted) <= 1e-4 * np.linalg.norm(wanted)
    assert once.tobytes() == twice.tobytes()


@pytest.mark.parametrize("tuning", [FineTuning(20, 1e-2), FineTuning(20, 1e-3, "adam", 2)], ids=["sgd", "adam"])
def test_an_adapted_policy_equals_the_cpu_s_and_itself(tuning: FineTuning) -> None:
    dmil = method()
    parameters = dmil.initial_parameters(named_rng(0, "initial"))
    cpu, once, twice = (
        tensors_of(adapted_on(device_of(name), dmil, parameters, EVERY[:2], tuning)) for name in ("cpu", "cuda", "cuda")
    )
    for name, tensor in once.items():
        assert torch.equal(tensor, twice[name]), name
        torch.testing.assert_close(tensor, cpu[name], rtol=1e-4, atol=1e-4)


def test_out_of_memory_names_what_to_lower() -> None:
    moved = on(device_of("cuda"), dmil := method(hidden_units=2048))
    torch.cuda.empty_cache()
    torch.cuda.set_per_process_memory_fraction(1e-5)
    try:
        with pytest.raises(WorkError, match=r"got out of memory .* lower --training.slots-per-group"):
            group_gradient(dmil, DEMONSTRATIONS, moved, 0, 0, ["a", "b"], [0, 1], batched=True)
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)
