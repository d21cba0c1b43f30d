"""The model that a run logs, in MLflow's form of models from code: MLflow keeps a copy of this file and runs it.

So nothing is pickled, and a model needs this project, and the package of its method if that is another's, installed
where it is loaded.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mlflow.models import set_model
from mlflow.pyfunc.model import PythonModel, PythonModelContext

from dmil_core.checkpoint import Checkpoint
from dmil_core.demonstrations import Demonstration, digest
from dmil_core.errors import RunError, UserError, shorten
from dmil_core.methods.base import FineTuning, Policy
from services.tracking.packing import unpacked

POLICIES_KEPT = 16
"""Adapted to as many support sets, so that an episode adapts once."""


class Imitator(PythonModel):
    """Turns a support set and an observation into an action."""

    def load_context(self, context: PythonModelContext) -> None:
        """Read the checkpoint."""
        checkpoint = Checkpoint(Path(context.artifacts["checkpoint"]))
        self._action_dim: int = context.model_config["action_dim"]
        self._method = checkpoint.method(self._action_dim)
        self._parameters = checkpoint.tensors()
        self._evaluation = checkpoint.manifest.config.evaluation
        self.policies: dict[tuple[str, FineTuning], Policy] = {}

    def predict(  # pyright: ignore[reportIncompatibleMethodOverride]  MLflow's own is said to return nothing
        self, context: PythonModelContext, model_input: pd.DataFrame, params: dict[str, Any] | None = None
    ) -> list[dict[str, Any]]:
        """Return for each row the ``action``, the ``sub_skill`` that chose it, and the ``memory`` for the next step.

        Also the ``support_id``, which the next step may send in place of the support.

        Args:
            context: of the model.
            model_input: each row as `unpacked` takes it.
            params: ``fine_tuning_steps`` and ``learning_rate``; those of the run's evaluation if not given.

        Raises:
            UserError: for a row that is not such.
            RunError: where adaptation has diverged.
        """
        settings = params or {}
        usual = self._evaluation.fine_tuning
        fine_tuning = usual._replace(
            steps=int(settings.get("fine_tuning_steps", usual.steps)),
            learning_rate=float(settings.get("learning_rate", usual.learning_rate)),
        )
        return [self.answer(row, fine_tuning) for row in model_input.to_dict("records")]

    def answer(self, row: Mapping[Any, Any], fine_tuning: FineTuning) -> dict[str, Any]:
        """Return what `predict` does for one row."""
        question = unpacked(row, self._method.obs_dim, self._action_dim)
        support_id = question.support_id or digest(question.support)
        policy = self._policy(support_id, question.support, fine_tuning)
        memory = policy.start(1) if question.memory is None else question.memory[None]
        decision = policy.act(question.observation[None], memory)
        if not np.isfinite(decision.actions).all():
            raise RunError(
                f"got an action that is not finite after {fine_tuning.steps} steps of adaptation at "
                f"{fine_tuning.learning_rate}; wanted a policy that has not diverged: give fewer steps or a smaller "
                "learning_rate"
            )
        return {
            "action": decision.actions[0].tolist(),
            "sub_skill": int(decision.sub_skills[0]),
            "memory": decision.memory[0].tolist(),
            "support_id": support_id,
        }

    def _policy(self, support_id: str, support: tuple[Demonstration, ...], fine_tuning: FineTuning) -> Policy:
        key = support_id, fine_tuning
        if key not in self.policies:
            if not support:
                raise UserError(
                    f"support_id: got {shorten(support_id)}; wanted one of the last {POLICIES_KEPT} support sets, with "
                    "the same params; send the support again"
                )
            if len(self.policies) >= POLICIES_KEPT:
                del self.policies[next(iter(self.policies))]
            self.policies[key] = self._method.adapt(self._parameters, support, fine_tuning)
        return self.policies[key]


set_model(Imitator())
