"""What needs no service around it: an adaptation and an action, pure functions of their arguments."""

import warnings
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
import torch

from dmil_core.adapted_policy import AdaptedPolicy
from dmil_core.errors import UserError
from dmil_core.methods.base import Decision
from dmil_core.model import Model, UnlikeTrainingWarning
from dmil_core.settings import sub_skills_of
from services.rollouts.adaptations import imitation_error
from services.serving.bodies import Detailed
from services.serving.packing import packed

Arrays = tuple[np.ndarray, np.ndarray]
"""Observations and actions of a demonstration."""


class FieldError(UserError):
    """Something in a request that cannot be used, with where it is."""

    def __init__(self, message: str, *where: str | int) -> None:
        super().__init__(message)
        self.where = where


@torch.no_grad()
def act(policy: AdaptedPolicy, rows: np.ndarray, memory: np.ndarray | None) -> Decision:
    """Return actions, clipped to the action space, for as many episodes as there are rows.

    Raises:
        FieldError: names what is wrong with the rows, or with their memory.
    """
    interface, start = policy.origin.interface, policy.policy.start(len(rows))
    if rows.shape[1] != interface.obs_dim:
        raise FieldError(
            f"observations: got {rows.shape[1]} numbers; wanted {interface.obs_dim}, {interface.trained_on}",
            "body", "observations",
        )  # fmt: skip
    if not np.isfinite(rows).all():
        raise FieldError("observations: got numbers beyond float32; wanted real ones", "body", "observations")
    if memory is not None and memory.shape != start.shape:
        raise FieldError(
            f"memory: got the shape {memory.shape}; wanted {start.shape}, as the last answer gave it", "body", "memory"
        )
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            decision = policy.policy.act(rows, start if memory is None else memory)
    except (IndexError, ValueError, OverflowError, RuntimeError) as error:
        if memory is None:
            raise
        raise FieldError(
            "memory: got none that this policy gave; wanted the last answer's", "body", "memory"
        ) from error
    if not np.isfinite(decision.actions).all():
        raise FieldError(
            "observations: got an action for them that is not finite; wanted observations in the units of the "
            "demonstrations",
            "body", "observations",
        )  # fmt: skip
    low, high = (np.array(end, np.float32) for end in (interface.actions.low, interface.actions.high))
    return decision._replace(actions=np.minimum(np.maximum(decision.actions, low), high))


def adapted(
    model: Model, digest: str, recorded: Sequence[Arrays], steps: int, rate: float
) -> tuple[AdaptedPolicy, bytes, dict[str, Any]]:
    """Adapt on one thread; return the policy, the same as bytes, and what is known of it.

    Raises:
        UserError: for what is no demonstration of such a robot.
        DivergedError: if adaptation diverges.
    """
    torch.set_num_threads(1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UnlikeTrainingWarning)
        policy, before = (model.adapt(recorded, steps=count, learning_rate=rate) for count in (steps, 0))
    unlike = [str(one.message) for one in caught if issubclass(one.category, UnlikeTrainingWarning)]
    content, now = packed(policy), datetime.now(UTC)
    info = Detailed(
        id="",
        model=digest,
        steps=steps,
        learning_rate=rate,
        demonstrations=[len(one) for one in policy.support],
        error_before=imitation_error(before.policy, policy.support),
        error_after=imitation_error(policy.policy, policy.support),
        bytes=len(content),
        created_at=now,
        expires_at=now,
        warnings=list(dict.fromkeys(unlike)),
        sub_skills=sub_skills_of(policy.origin.model.config.method),
        timelines=[policy.policy.sub_skill_use(one).chosen.tolist() for one in policy.support],
    )
    return policy, content, info.model_dump(mode="json", exclude={"id", "expires_at"})
