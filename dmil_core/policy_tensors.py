"""The tensors in a policy, taken out by name and put into another one of the same form.

A policy is a value made of dataclasses, named tuples, tuples and mappings, with tensors and arrays as leaves.
"""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

T = TypeVar("T")
NUMERIC = "fiub"
"""Kinds of arrays that are taken out."""


def tensors_of(value: Any) -> dict[str, Tensor]:
    """Return all tensors and arrays of numbers in a value, by where they lie in it; no copy."""
    return dict(_leaves(value, ""))


def _leaves(value: Any, name: str) -> Iterator[tuple[str, Tensor]]:
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, np.ndarray) and value.dtype.kind in NUMERIC:
        yield name, torch.from_numpy(value)
    else:
        for part, child in _children(value).items():
            yield from _leaves(child, f"{name}.{part}" if name else part)


def with_tensors(value: T, tensors: Mapping[str, Tensor]) -> T:
    """Return a value of the same form with these tensors in place of its own; all else is the value's.

    Raises:
        KeyError: if one is missing.
    """
    return _replaced(value, tensors, "")


def _replaced(value: Any, tensors: Mapping[str, Tensor], name: str) -> Any:
    if isinstance(value, Tensor):
        return tensors[name]
    if isinstance(value, np.ndarray) and value.dtype.kind in NUMERIC:
        return tensors[name].numpy()
    children = {
        part: _replaced(child, tensors, f"{name}.{part}" if name else part) for part, child in _children(value).items()
    }
    if not children:
        return value
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **children)
    if isinstance(value, Mapping):
        return dict(zip(value, children.values(), strict=True))
    return type(value)(**children) if hasattr(value, "_fields") else type(value)(children.values())  # type: ignore[call-arg]


def _children(value: Any) -> dict[str, Any]:
    """Return the parts of a value that may hold tensors, by name."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in fields(value) if field.init}
    if isinstance(value, Mapping):
        return {str(key): child for key, child in value.items()}
    if isinstance(value, tuple | list):
        names = getattr(value, "_fields", map(str, range(len(value))))
        return dict(zip(names, value, strict=True))
    return {}
