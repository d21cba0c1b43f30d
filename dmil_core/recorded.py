"""Demonstrations as somebody else has recorded them: arrays of their own types, made into what a model adapts to."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dmil_core.checkpoint import Manifest, Range
from dmil_core.demonstrations import Demonstration, DemonstrationError
from dmil_core.errors import shorten
from dmil_core.methods.base import Method

LEAST_RANGE = 0.02
"""Of a number that hardly moves in meta-training, in the observation's units; see `Normalisation.of`."""


@dataclass(frozen=True)
class Interface:
    """What goes into a policy, and what comes out."""

    obs_dim: int
    """Numbers in an observation."""
    actions: Range
    """Bounds of the action space."""
    observed: Range | None
    """What the observations of meta-training lie between, where that is known."""
    trained_on: str
    """In words, for messages: what observations and actions are to be like."""

    @classmethod
    def of(cls, manifest: Manifest, method: Method[Any]) -> "Interface":
        """Return what a checkpoint's policies take and give; its manifest names the bounds of actions."""
        assert manifest.actions is not None
        suite, observed = manifest.config.suite, manifest.observed
        tasks = f" ({', '.join(suite.train_tasks)})" if suite.train_tasks else ""
        obs_dim = method.obs_dim if observed is None else len(observed)
        return cls(obs_dim, manifest.actions, observed, f"as {suite.name} has it{tasks}")

    @property
    def action_dim(self) -> int:
        """Numbers in an action."""
        return len(self.actions)


def numbers(values: Any, name: str) -> np.ndarray:
    """Return an array of float32 of whatever real numbers.

    Raises:
        DemonstrationError: for anything else, by `name`.
    """
    try:
        array = np.asarray(values)
    except (ValueError, TypeError, RuntimeError) as error:
        raise DemonstrationError(f"{name}: got {shorten(values)}; wanted an array of numbers: {error}") from error
    if array.dtype.kind not in "fiu":
        raise DemonstrationError(
            f"{name}: got an array of {array.dtype} with the shape {array.shape}; wanted real numbers, all rows of one "
            "length"
        )
    with np.errstate(over="ignore"):  # what does not fit becomes infinite, and is refused as that
        return np.ascontiguousarray(array, np.float32)


def as_demonstrations(recorded: Any, interface: Interface) -> tuple[Demonstration, ...]:
    """Return what somebody has recorded as demonstrations of one task.

    Args:
        recorded: a sequence of pairs (observations, actions), or of objects that have both, as `Demonstration` or
            Minari's episodes: (steps, numbers) each, of any real type. Observations may have one row more, the one
            after the last action, which is left out; parts of dictionaries are laid one after the other, by their names
            in alphabetical order.
        interface: what the numbers have to fit.

    Raises:
        DemonstrationError: names the demonstration, what it got, and what it wanted.
    """
    if not isinstance(recorded, Sequence | Iterator) or isinstance(recorded, str) or _is_pair(recorded):
        raise DemonstrationError(
            f"demonstrations: got {_kind(recorded)}; wanted a list of them, each a pair of arrays: "
            "[(observations, actions)]"
        )
    demonstrations = tuple(_demonstration(one, index, interface) for index, one in enumerate(recorded))
    if not demonstrations:
        raise DemonstrationError("demonstrations: got none; wanted at least one: [(observations, actions)]")
    return demonstrations


def _is_pair(recorded: Any) -> bool:
    """Tell whether one pair was given where a list of pairs belongs."""
    return len(recorded) == 2 and all(getattr(part, "ndim", 0) == 2 for part in recorded)


def _kind(recorded: Any) -> str:
    return "one pair of arrays" if isinstance(recorded, tuple) else f"one {type(recorded).__name__}"


def action_dim_of(recorded: Any) -> int:
    """Return how many numbers the actions of the first recorded demonstration have; 1 if that is no demonstration."""
    one = next(iter(recorded), None)
    actions = getattr(one, "actions", one[1] if isinstance(one, Sequence) and len(one) == 2 else 0)
    shape: tuple[int, ...] = np.shape(actions)
    return shape[1] if len(shape) == 2 else 1


def _demonstration(one: Any, index: int, interface: Interface) -> Demonstration:
    name = f"demonstration {index}"
    if hasattr(one, "observations") and hasattr(one, "actions"):
        parts = one.observations, one.actions
    elif isinstance(one, Mapping) and {"observations", "actions"} <= one.keys():
        parts = one["observations"], one["actions"]
    elif isinstance(one, Sequence) and len(one) == 2:
        parts = tuple(one)
    else:
        raise DemonstrationError(f"{name}: got {shorten(one)}; wanted a pair of arrays, (observations, actions)")
    observations, actions = numbers(_flat(parts[0]), f"{name}: observations"), numbers(parts[1], f"{name}: actions")
    _check_shape(f"{name}: observations", observations, interface.obs_dim, interface)
    _check_shape(f"{name}: actions", actions, interface.action_dim, interface)
    if isinstance(one, Demonstration):
        return one
    paired = observations[:-1] if len(observations) == len(actions) + 1 else observations
    return Demonstration(f"{index:03d}", "demonstrated", paired, actions)


def _flat(observations: Any) -> Any:
    """Lay the parts of dictionaries one after the other."""
    if not isinstance(observations, Mapping):
        return observations
    parts = [np.asarray(_flat(observations[key])) for key in sorted(observations)]
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


def _check_shape(name: str, values: np.ndarray, wanted: int, interface: Interface) -> None:
    if values.ndim == 2 and values.shape[1] == wanted:
        return
    advice = ""
    if values.ndim == 2 and values.shape[0] == wanted:
        advice = "; it looks transposed: give its .T"
    elif values.ndim == 3:
        advice = "; of several demonstrations give a list of pairs"
    raise DemonstrationError(
        f"{name}: got the shape {values.shape}; wanted (steps, {wanted}), {interface.trained_on}{advice}"
    )


def unlike_training(demonstrations: Sequence[Demonstration], interface: Interface) -> list[str]:
    """Return in words which numbers stand out from all that meta-training has seen; none if nothing does.

    A number of the observation stands out if it leaves what it lay between in meta-training by more than the width of
    that; a number of the action, if it leaves the action space, where acting clips it.
    """
    found = []
    observed, actions = interface.observed, interface.actions
    if observed is not None:
        width = np.maximum(np.subtract(observed.high, observed.low), LEAST_RANGE)
        found += _outside([d.observations for d in demonstrations], observed, width, "observation", "meta-training saw")
    found += _outside([d.actions for d in demonstrations], actions, np.full(len(actions), 1e-3), "action", "wanted")
    return found


def _outside(arrays: Sequence[np.ndarray], seen: Range, margin: np.ndarray, field: str, words: str) -> list[str]:
    values = np.concatenate(arrays)
    low, high = values.min(0), values.max(0)
    odd = np.flatnonzero((low < np.subtract(seen.low, margin)) | (high > np.add(seen.high, margin)))
    if not len(odd):
        return []
    shown = ", ".join(
        f"number {i} from {low[i]:.3g} to {high[i]:.3g}, {words} {seen.low[i]:.3g} to {seen.high[i]:.3g}"
        for i in odd[:5].tolist()
    )
    more = f", and {len(odd) - 5} more" if len(odd) > 5 else ""
    return [f"{field}: {shown}{more}"]
