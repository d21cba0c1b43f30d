"""Support sets and observations as plain lists and numbers, the form in which the logged model takes them, and back."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Demonstration, DemonstrationError
from dmil_core.errors import UserError, shorten


class Question(NamedTuple):
    """What the model is asked: what to do after having seen a support set."""

    support: tuple[Demonstration, ...]
    """None after the first step, where the id of an earlier answer names it."""
    support_id: str | None
    observation: Float32[np.ndarray, " obs_dim"]
    memory: Int64[np.ndarray, " memory_dim"] | None
    """What the step before returned; none at the first step of an episode."""


def packed(support: Sequence[Demonstration], observation: Float32[np.ndarray, " obs_dim"]) -> dict[str, Any]:
    """Return a model's input as JSON has it."""
    demonstrations = [
        {"observations": demonstration.observations.tolist(), "actions": demonstration.actions.tolist()}
        for demonstration in support
    ]
    return {"support": demonstrations, "observation": observation.tolist()}


def unpacked(request: Mapping[str, Any], obs_dim: int, action_dim: int) -> Question:
    """Return what a model's input asks.

    Args:
        request: ``support``, a list of demonstrations with ``observations`` and ``actions``, one row a step, or the
            ``support_id`` of an earlier answer; ``observation``; and, after the first step, the ``memory``.
        obs_dim: numbers in an observation.
        action_dim: numbers in an action.

    Raises:
        UserError: names the part that is wrong, what it got and what was wanted.
    """
    support, support_id = request.get("support"), request.get("support_id")
    if isinstance(support_id, str):
        support = ()
    elif not isinstance(support, Sequence | np.ndarray) or isinstance(support, str) or len(support) == 0:
        raise UserError(
            f"support: got {shorten(support)}; wanted a list of at least one demonstration, or the support_id of an "
            "earlier answer"
        )
    observation = _numbers(request.get("observation"), "observation", (obs_dim,))
    if not np.isfinite(observation).all():
        raise UserError("observation: got numbers that are not finite; wanted real numbers only")
    memory = request.get("memory")
    return Question(
        tuple(_demonstration(one, number, obs_dim, action_dim) for number, one in enumerate(support)),
        support_id if isinstance(support_id, str) else None,
        observation,
        None if memory is None else _memory(memory),
    )


def _memory(memory: Any) -> Int64[np.ndarray, " memory_dim"]:
    try:
        return np.asarray(memory, np.int64)
    except (TypeError, ValueError) as error:
        raise UserError(f"memory: got {shorten(memory)}; wanted whole numbers, as the step before returned") from error


def _demonstration(fields: Any, number: int, obs_dim: int, action_dim: int) -> Demonstration:
    name = f"support[{number}]"
    if not isinstance(fields, Mapping) or not {"observations", "actions"} <= fields.keys():
        got = ", ".join(map(str, fields)) if isinstance(fields, Mapping) else type(fields).__name__
        raise UserError(f"{name}: got {got or 'nothing'}; wanted a demonstration's observations and actions")
    observations = _numbers(fields["observations"], f"{name}.observations", (-1, obs_dim))
    actions = _numbers(fields["actions"], f"{name}.actions", (-1, action_dim))
    if len(observations) != len(actions):
        raise UserError(
            f"{name}: got {len(observations)} observations for {len(actions)} actions; wanted one action for each"
        )
    try:
        return Demonstration(str(number), "support", observations, actions)
    except DemonstrationError as error:
        raise UserError(f"{name}: {error}") from error


def _numbers(numbers: Any, name: str, wanted: tuple[int, ...]) -> np.ndarray:
    """Return numbers of a shape, in which -1 stands for any length."""
    shape = f"{wanted[-1]} numbers" if len(wanted) == 1 else f"one row of {wanted[-1]} numbers for each step"
    try:
        rows = [np.asarray(row, np.float32) for row in numbers] if len(wanted) == 2 else numbers
        array = np.asarray(rows, np.float32)
    except (TypeError, ValueError) as error:
        raise UserError(f"{name}: got {shorten(numbers)}; wanted {shape}") from error
    if array.ndim != len(wanted) or array.shape[-1] != wanted[-1]:
        raise UserError(f"{name}: got the shape {array.shape}; wanted {shape}")
    return array
