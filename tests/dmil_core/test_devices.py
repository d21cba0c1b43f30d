"""Where is computed: names, what is refused, both paths of gradients, and that no tensor stays behind."""

import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch

from dmil_core.devices import CPU, Compute, computing_on, describe, device_of
from dmil_core.errors import RunError, UserError
from dmil_core.methods.behaviour_cloning.method import BehaviourCloning
from dmil_core.methods.configs import method_names
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.method import Dmil
from dmil_core.methods.mil.method import Mil
from dmil_core.methods.registry import method_type
from dmil_core.outer_loop import group_gradient
from dmil_core.seeding import named_rng
from tests.dmil_core.carrying import POINTS, demonstrate

WITHOUT_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
DEMONSTRATIONS = {"a": [demonstrate(3, seed) for seed in range(5)], "b": [demonstrate(2, seed) for seed in range(6)]}


@WITHOUT_GPU
@pytest.mark.parametrize("name", ["cuda", "cuda:1"])
def test_a_gpu_that_there_is_not_is_refused(name: str) -> None:
    with pytest.raises(UserError, match=rf"device: got {name}; wanted cpu or auto: torch .* sees no CUDA devices here"):
        device_of(name)


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:-1", "mps", ""])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(UserError, match=r"wanted auto, cpu, cuda or cuda:N"):
        device_of(name)


def test_auto_is_the_cpu_unless_a_gpu_was_granted() -> None:
    assert device_of("auto") == device_of("cpu") == CPU
    assert device_of("auto", granted=True).type == ("cuda" if torch.cuda.is_available() else "cpu")
    assert describe(CPU) == "cpu"


def test_what_a_method_does_not_have_is_refused() -> None:
    with pytest.raises(UserError, match=r"--device: got cuda for mil, which computes on the CPU"):
        Compute("cuda").check(Mil)
    with pytest.raises(UserError, match=r"--path: got batched for behaviour-cloning, which has no batched gradient"):
        Compute(path="batched").check(BehaviourCloning)
    for name in method_names():
        Compute().check(method_type(name))
    Compute("cuda", "batched").check(Dmil)


@pytest.mark.parametrize(
    ("settings", "tolerance"),
    [
        ({"order": "second"}, 1e-5),
        ({"order": "first", "labels_until": 1}, 1e-5),
        ({"context": "none", "window": None}, 1e-5),
    ],
)
def test_the_batched_path_gives_the_same_group_gradient(settings: dict[str, Any], tolerance: float) -> None:
    small = {"hidden_layers": 2, "hidden_units": 16, "features": "relative", "trajectories": 2, "window": 8}
    config = DmilConfig.model_validate({**small, "context": "path", **settings})
    every = [one for task in DEMONSTRATIONS.values() for one in task]
    method = Dmil.prepared(config, 4, every, POINTS)
    parameters = method.initial_parameters(named_rng(0, "initial"))
    slots = ["a", "b", "a"]
    loop, batched = (
        group_gradient(method, DEMONSTRATIONS, parameters, 0, 0, slots, [0, 1, 2], batched=batched)
        for batched in (False, True)
    )
    assert np.linalg.norm(loop.gradient - batched.gradient) <= tolerance * np.linalg.norm(loop.gradient)
    for one, other in zip(loop.metrics, batched.metrics, strict=True):
        assert one == pytest.approx(other, rel=1e-4, abs=1e-6)


def test_the_path_that_runs_is_chosen_by_the_device_and_can_be_forced() -> None:
    method = Dmil.prepared(DmilConfig(), 4, DEMONSTRATIONS["a"], None)
    gpu = torch.device("cuda")
    chosen = [Compute(path=path).is_batched(method, on) for path in ("auto", "loop", "batched") for on in (CPU, gpu)]
    assert chosen == [False, True, False, False, True, True]


def test_out_of_memory_says_what_to_lower(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "a card")
    before = torch.are_deterministic_algorithms_enabled()

    @computing_on(torch.device("cuda"))
    def fill() -> None:
        assert torch.are_deterministic_algorithms_enabled()
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.")

    with pytest.raises(RunError, match=r"cuda: a card: got out of memory .*--training.slots-per-group"):
        fill()
    assert torch.are_deterministic_algorithms_enabled() == before
    assert torch.get_default_device() == CPU


def test_nothing_is_left_behind_on_the_way_to_a_gpu_or_back() -> None:
    command = [sys.executable, "-m", "tests.dmil_core.on_emulated_gpu"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr[-3000:]
    for label, found in json.loads(ended.stdout).items():
        assert all(value <= (1e-5 if name == "batched" else 0.0) for name, value in found.items()), (label, found)
