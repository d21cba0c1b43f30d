"""Where gradients and adaptations are computed: on the CPU, or on a GPU, whose algorithms are then deterministic.

On a GPU the parameters lie there, and so does all that is made inside `computing_on`; what travels and what acts is on
the CPU. No GPU was there to try this on: see docs/scaling.md.
"""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field

from dmil_core.demonstrations import Demonstration
from dmil_core.errors import RunError, UserError, shorten
from dmil_core.methods.base import FineTuning, MetaLearner, Method, Policy
from dmil_core.networks import Parameters
from dmil_core.policy_tensors import tensors_of, with_tensors
from dmil_core.settings import GradientPath

NAMES = r"auto|cpu|cuda(:[0-9]{1,4})?"
DeviceName = Annotated[str, Field(pattern=f"^({NAMES})$")]
CPU = torch.device("cpu")
WORKSPACE = "CUBLAS_WORKSPACE_CONFIG"
"""Without it cuBLAS may add in another order each time; it counts from a process's first product on a GPU on."""


class Compute(NamedTuple):
    """What computes, as it was asked for."""

    device: DeviceName = "auto"
    """auto: the GPU that Ray gave a worker, else the CPU; cpu; cuda or cuda:N."""
    path: GradientPath = "auto"
    """Of the gradients of a group of slots: loop, one task after the other; batched, all at once; auto: batched on a
    GPU, if the method has it."""

    @property
    def wants_gpu(self) -> bool:
        """Whether there must be a GPU."""
        return self.device.startswith("cuda")

    def check(self, method: type[Method[Any]]) -> None:
        """Refuse what a method does not have.

        Raises:
            UserError: names the setting and the method.
        """
        name = method.config_type.model_fields["name"].default
        if self.wants_gpu and not method.on_gpu:
            raise UserError(f"--device: got {self.device} for {name}, which computes on the CPU; wanted cpu or auto")
        if self.path == "batched" and not (issubclass(method, MetaLearner) and method.batched):
            raise UserError(f"--path: got batched for {name}, which has no batched gradient; wanted loop or auto")

    def device_for(self, method: Method[Any], *, granted: bool) -> torch.device:
        """Return where a method computes in this process; `granted` tells whether Ray gave it a GPU."""
        return device_of(self.device, granted=granted) if method.on_gpu else CPU

    def is_batched(self, method: Method[Any], device: torch.device) -> bool:
        """Tell whether a group's gradients are one computation."""
        has = isinstance(method, MetaLearner) and method.batched
        return has and (self.path == "batched" or (self.path == "auto" and device.type == "cuda"))


USUAL = Compute()
"""What computes if nothing else is asked for."""


def device_of(name: str, *, granted: bool = False) -> torch.device:
    """Return the device that auto, cpu, cuda or cuda:N means in this process; a GPU is made ready to be deterministic.

    auto takes a GPU if it is `granted`: if Ray gave this process one.

    Raises:
        UserError: for another name, or a GPU that there is not.
    """
    if not re.fullmatch(NAMES, name):
        raise UserError(f"device: got {shorten(name)}; wanted auto, cpu, cuda or cuda:N")
    if name == "auto":
        name = "cuda" if granted and torch.cuda.is_available() else "cpu"
    device = torch.device(name)
    if device.type == "cuda":
        if (device.index or 0) >= (count := torch.cuda.device_count()):
            raise UserError(
                f"device: got {name}; wanted cpu or auto: torch {torch.__version__} sees {count or 'no'} CUDA devices "
                "here; look at nvidia-smi, and at docs/scaling.md for the image with CUDA"
            )
        os.environ.setdefault(WORKSPACE, ":4096:8")
    return device


def describe(device: torch.device) -> str:
    """Return what stands in rows and provenance: ``cpu``, or ``cuda: `` and the card's name."""
    return "cpu" if device.type == "cpu" else f"{device.type}: {torch.cuda.get_device_name(device)}"


@contextmanager
def computing_on(device: torch.device) -> Iterator[None]:
    """Make new tensors on a device, by deterministic algorithms if it is a GPU; on the CPU nothing is changed.

    Raises:
        RunError: for want of the GPU's memory, with what to lower.
    """
    if device.type == "cpu":
        yield
        return
    before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        with device:
            yield
    except torch.OutOfMemoryError as error:
        raise RunError(
            f"{describe(device)}: got out of memory ({str(error).partition('.')[0]}); wanted less at once: lower "
            "--training.slots-per-group or --method.trajectories, let fewer workers share the GPU (--gpus), or give "
            "--device cpu"
        ) from error
    finally:
        torch.use_deterministic_algorithms(before[0], warn_only=before[1])


def adapted_on(
    device: torch.device,
    method: Method[Any],
    parameters: Parameters,
    support: Sequence[Demonstration],
    fine_tuning: FineTuning,
) -> Policy:
    """Return the policy that a method adapts on a device; it acts on the CPU."""
    if device.type == "cpu":
        return method.adapt(parameters, support, fine_tuning)
    with computing_on(device):
        policy = method.adapt({name: tensor.to(device) for name, tensor in parameters.items()}, support, fine_tuning)
    return with_tensors(policy, {name: tensor.cpu() for name, tensor in tensors_of(policy).items()})
