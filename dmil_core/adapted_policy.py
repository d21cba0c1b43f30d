"""A policy adapted to one task, as whoever moves a robot uses it: called step by step, saved to a folder, loaded."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float32, Int64
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from dmil_core.checkpoint import CONSTANTS, MOST_TENSORS, Manifest, damaged, packed, read_sealed, read_tensors, sealed
from dmil_core.demonstrations import Demonstration, DemonstrationError
from dmil_core.errors import RunError, UserError, shorten
from dmil_core.files import create_file, making_folder, room_for
from dmil_core.methods.base import Policy
from dmil_core.methods.registry import method_type
from dmil_core.policy_tensors import tensors_of, with_tensors
from dmil_core.recorded import Interface, numbers
from dmil_core.settings import AnyCount, FineTuning, Optimiser, Positive

POLICY, SEAL = "policy.json", "policy.sha256"
TENSORS, DEMONSTRATIONS = "policy.safetensors", "demonstrations.safetensors"
MOST_POLICY = 2**23
"""Bytes of ``policy.json``."""
TRANSPOSED = "^T"
"""Ends the name of a matrix that is stored column by column, as it lies in memory: the last bits depend on it."""


class Source(BaseModel):
    """What a policy came from, ``policy.json``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: Manifest
    """Of the checkpoint that was adapted."""
    fine_tuning_steps: AnyCount
    learning_rate: Positive
    optimiser: Optimiser = "sgd"
    displaced: AnyCount = 0
    demonstrations: Annotated[tuple[tuple[str, str], ...], Field(min_length=1)]
    """Task and id of each demonstration that it was adapted to."""
    files: dict[str, str] = {}
    """The SHA-256 of every file of tensors."""


@dataclass(frozen=True)
class Origin:
    """What a policy came from: all that a folder holds besides the policy's own tensors."""

    model: Manifest
    constants: Mapping[str, np.ndarray]
    support: tuple[Demonstration, ...]
    fine_tuning: FineTuning
    interface: Interface


class AdaptedPolicy:
    """A policy for one task: an observation goes in, an action comes out, clipped to the action space.

    It remembers what it needs from step to step, so `reset` it where an episode begins. Each call is a pure function of
    the observations since then: the same ones give the same actions.
    """

    def __init__(self, policy: Policy, origin: Origin) -> None:
        """Stand before the first step of an episode."""
        self.policy, self.origin = policy, origin
        actions = origin.interface.actions
        self._low, self._high = (np.array(end, np.float32) for end in (actions.low, actions.high))
        self.reset()

    def reset(self) -> None:
        """Begin an episode, or several at once if the next call is with several observations."""
        self._memory: Int64[np.ndarray, "episodes memory_dim"] | None = None
        self._sub_skills: Int64[np.ndarray, " episodes"] | None = None
        self._shape: tuple[int, ...] = ()

    def __call__(self, observation: Any) -> Float32[np.ndarray, "*episodes action_dim"]:
        """Return the next action.

        Args:
            observation: (obs_dim,), of any real type, in the units of the demonstrations; or (episodes, obs_dim), of
                several episodes at once, as many and in the same order at each step since `reset`.

        Raises:
            UserError: for an observation of another shape, or with numbers that are not finite.
            RunError: for an action that is not finite.
        """
        states = numbers(observation, "observation")
        if not self._shape or states.shape != self._shape:
            self._begin(states)
        rows = states[None] if states.ndim == 1 else states
        if not np.isfinite(states).all():
            where = np.flatnonzero(~np.isfinite(rows).all(0)).tolist()
            raise UserError(
                f"observation: got values that are not finite in the numbers {shorten(where)}; wanted real numbers "
                "only; stop the robot and see to its sensors"
            )
        assert self._memory is not None
        decision = self.policy.act(rows, self._memory)
        if not np.isfinite(decision.actions).all():
            raise RunError("policy: got an action that is not finite; wanted none such; adapt with fewer steps")
        self._memory, self._sub_skills = decision.memory, decision.sub_skills
        actions = np.minimum(np.maximum(decision.actions, self._low), self._high)
        return actions[0] if states.ndim == 1 else actions

    def _begin(self, states: Float32[np.ndarray, "..."]) -> None:
        """Take note of how many episodes there are, as many as in the steps before."""
        interface = self.origin.interface
        if states.ndim not in (1, 2) or states.shape[-1] != interface.obs_dim or not states.size:
            raise UserError(
                f"observation: got the shape {states.shape}; wanted ({interface.obs_dim},), or (episodes, "
                f"{interface.obs_dim}), {interface.trained_on}"
            )
        if self._shape:
            raise UserError(
                f"observation: got the shape {states.shape} after {self._shape}; wanted the same episodes at each "
                "step; call reset() where others begin"
            )
        self._shape = states.shape
        self._memory = self.policy.start(1 if states.ndim == 1 else len(states))

    @property
    def sub_skill(self) -> int | Int64[np.ndarray, " episodes"] | None:
        """The sub-skill that chose the last action, of several episodes one each; None before the first step."""
        if self._sub_skills is None or len(self._shape) == 2:
            return self._sub_skills
        return int(self._sub_skills[0])

    @property
    def support(self) -> tuple[Demonstration, ...]:
        """The demonstrations that it was adapted to."""
        return self.origin.support

    @property
    def nbytes(self) -> int:
        """Bytes of its tensors and its demonstrations."""
        arrays = [values for one in self.support for values in (one.observations, one.actions)]
        return sum(tensor.nbytes for tensor in tensors_of(self.policy).values()) + sum(one.nbytes for one in arrays)

    def save(self, folder: str | Path) -> None:
        """Write the policy, and the demonstrations that it was adapted to, to a new folder; see `load_policy`.

        Raises:
            UserError: if there is something of that name, or the policy's class is no value with tensors in it.
            DiskFullError: for want of space; nothing is left then.
        """
        path, origin = Path(folder).absolute(), self.origin
        support = {
            f"{index}.{field}": getattr(one, field)
            for index, one in enumerate(self.support)
            for field in ("observations", "actions")
        }
        contents = {TENSORS: _stored(tensors_of(self.policy)), CONSTANTS: origin.constants, DEMONSTRATIONS: support}
        source = Source(
            model=origin.model,
            fine_tuning_steps=origin.fine_tuning.steps,
            learning_rate=origin.fine_tuning.learning_rate,
            optimiser=origin.fine_tuning.optimiser,
            displaced=origin.fine_tuning.displaced,
            demonstrations=tuple((one.task, one.id) for one in self.support),
        )
        files = sealed({name: packed(tensors) for name, tensors in contents.items()}, source, POLICY, SEAL)
        if path.exists():
            raise UserError(f"folder: got {path}, which is there already; wanted a new name")
        with room_for(path, sum(map(len, files.values()))), making_folder(path.parent, path.name) as made:
            for name, content in files.items():
                create_file(made, name, content)


def _stored(tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Return tensors as they lie in memory, transposed matrices by a name that says so."""
    stored = {}
    for name, tensor in tensors.items():
        transposed = tensor.ndim >= 2 and tensor.stride(-2) < tensor.stride(-1)
        stored[name + TRANSPOSED * transposed] = (tensor.mT if transposed else tensor).detach().numpy()
    return stored


def load_policy(folder: str | Path) -> AdaptedPolicy:
    """Return the policy that `AdaptedPolicy.save` wrote to a folder: it acts to the bit as the one that was saved.

    Raises:
        UserError: names the file that is missing, damaged or not as the others describe it.
    """
    path = Path(folder)
    if not (path / POLICY).is_file():
        raise UserError(f"folder: got {path}, without a {POLICY}; wanted what the save() of a policy wrote")
    source = read_sealed(path, POLICY, SEAL, MOST_POLICY, Source)
    constants, stored, tensors = (
        read_tensors(path, name, source.files.get(name), MOST_TENSORS) for name in (CONSTANTS, DEMONSTRATIONS, TENSORS)
    )
    try:
        support = tuple(
            Demonstration(name, task, stored[f"{index}.observations"], stored[f"{index}.actions"])
            for index, (task, name) in enumerate(source.demonstrations)
        )
    except (KeyError, DemonstrationError) as error:
        raise damaged(path / DEMONSTRATIONS, str(error), f"the demonstrations that {POLICY} names") from error
    settings, points = source.model.config.method, source.model.config.suite.points
    fine_tuning = FineTuning(source.fine_tuning_steps, source.learning_rate, source.optimiser, source.displaced)
    method = method_type(settings.name).restored(settings, support[0].actions.shape[1], constants, points)
    zeros = {name: torch.zeros(shape) for name, shape in source.model.torch_shapes.items()}
    form = method.adapt(zeros, support, fine_tuning._replace(steps=0, displaced=0))  # whose tensors are then put aside
    loaded, wanted = _loaded(tensors), tensors_of(form)
    if {name: (t.shape, t.dtype) for name, t in loaded.items()} != {n: (t.shape, t.dtype) for n, t in wanted.items()}:
        raise damaged(path / TENSORS, f"tensors {shorten(list(loaded))}", f"those of {settings.name}'s policy")
    interface = Interface.of(source.model, method)
    origin = Origin(source.model, constants, support, fine_tuning, interface)
    return AdaptedPolicy(with_tensors(form, loaded), origin)


def _loaded(stored: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """Return tensors that `_stored` made ready, as they lay in memory."""
    tensors = {name: torch.tensor(array) for name, array in stored.items()}
    return {
        name.removesuffix(TRANSPOSED): tensor.mT if name.endswith(TRANSPOSED) else tensor
        for name, tensor in tensors.items()
    }
