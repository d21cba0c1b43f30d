"""A GPU that there is not: tensors that say they are on it lie in main memory, and none may meet one of the CPU's.

It shows that nothing is left behind on the way to a GPU or back; rounding, speed and memory only a card can show.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

NAME = "emulated"
COPIES = ("_to_copy", "copy_", "to")


class OnGpu(Tensor):
    """A tensor that says that it is on a GPU."""

    kept: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> "OnGpu":
        made = Tensor._make_wrapper_subclass(  # pyright: ignore[reportAttributeAccessIssue]
            cls,
            values.shape,
            values.stride(),
            values.storage_offset(),
            dtype=values.dtype,
            device=torch.device(NAME, 0),
        )
        made.kept = values
        return made

    def tolist(self) -> Any:
        return self.kept.tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{func} outside the emulated GPU")


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        there = [tensor for tensor in tensors if isinstance(tensor, OnGpu)]
        name = func.overloadpacket.__name__
        if there and name not in COPIES:
            left = [tensor for tensor in tensors if not isinstance(tensor, OnGpu) and tensor.ndim]
            assert not left, f"{func}: got tensors of the GPU and of the CPU, {[tuple(one.shape) for one in left]}"
        wrappers = {id(tensor.kept): tensor for tensor in there}
        wanted = kwargs.get("device")
        if wanted is not None:
            kwargs["device"] = torch.device("cpu")
        on_gpu = torch.device(wanted).type == NAME if wanted is not None else bool(there)
        if name == "copy_":
            on_gpu = isinstance(args[0], OnGpu)
        plain_args, plain = tree_map(lambda leaf: leaf.kept if isinstance(leaf, OnGpu) else leaf, (args, kwargs))
        result = func(*plain_args, **plain)

        def wrapped(leaf: Any) -> Any:
            if not isinstance(leaf, Tensor) or not on_gpu:
                return leaf
            return wrappers[id(leaf)] if id(leaf) in wrappers else OnGpu(leaf)

        return tree_map(wrapped, result)


@cache
def register() -> None:
    """Make torch know the device; it must before this process first goes backward through a graph."""
    _setup_privateuseone_for_python_backend(NAME)


@contextmanager
def emulated_gpu() -> Iterator[torch.device]:
    """Yield the device; inside, tensors can be made on it and copied there."""
    register()
    torch._C._set_only_lift_cpu_tensors(True)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        with _Mode():
            yield torch.device(NAME, 0)
    finally:
        torch._C._set_only_lift_cpu_tensors(False)  # pyright: ignore[reportAttributeAccessIssue]
