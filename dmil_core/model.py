"""A meta-trained model as its user has it: loaded by name, adapted to a few demonstrations of a new task."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dmil_core.adapted_policy import AdaptedPolicy, Origin
from dmil_core.checkpoint import FOLDER, MANIFEST, Checkpoint, Manifest, Range, opened
from dmil_core.configs import ExperimentConfig, SuiteConfig, TrainingConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.devices import CPU, adapted_on, device_of
from dmil_core.errors import RunError, UserError, nearest, shorten
from dmil_core.files import at_home
from dmil_core.methods.base import FineTuning, Policy
from dmil_core.methods.tracking.config import TrackingConfig
from dmil_core.methods.tracking.method import Tracking
from dmil_core.plug_ins import imported, plug_ins
from dmil_core.points import Points
from dmil_core.policy_tensors import tensors_of
from dmil_core.recorded import Interface, action_dim_of, as_demonstrations, unlike_training

ENTRY_POINTS = "dmil.models"
"""The group of entry points in which a package registers, by the scheme of an address, what reads a checkpoint:
the services register MLflow's ``models`` and ``runs``."""
SHIPPED = Path(__file__).with_name("shipped").resolve()
"""The models that come with the project, in a checkout the folder ``models``."""


class UnlikeTrainingWarning(UserWarning):
    """Demonstrations in which some numbers are unlike all that meta-training has seen."""


class DivergedError(RunError):
    """Adaptation that left no policy of use."""


class Model:
    """A checkpoint, ready to adapt. It never changes: each `adapt` begins from the same parameters."""

    def __init__(self, checkpoint: Checkpoint, device: str = "cpu") -> None:
        """Take a checkpoint that was read, and where to adapt.

        Raises:
            UserError: for a device that there is not.
        """
        self.checkpoint, self._device = checkpoint, device_of(device)
        self._parameters = checkpoint.tensors()

    @property
    def fine_tuning(self) -> FineTuning:
        """The adaptation that the checkpoint's run used, with the defaults of `adapt`."""
        return self.checkpoint.manifest.config.evaluation.fine_tuning

    def adapt(
        self, demonstrations: Sequence[Any], *, steps: int | None = None, learning_rate: float | None = None
    ) -> AdaptedPolicy:
        """Return a policy for the task that some demonstrations show; the same ones give the same policy.

        Args:
            demonstrations: of one task, one or more: pairs (observations, actions) of arrays (steps, numbers) of any
                real type in the units of meta-training, `Demonstration`, or Minari's episodes; see `as_demonstrations`.
            steps: gradient steps of adaptation, at least 0; `fine_tuning`'s if not given.
            learning_rate: of these steps; `fine_tuning`'s if not given.

        Warns:
            UnlikeTrainingWarning: names the numbers of observations or actions that stand out.

        Raises:
            UserError: for what is no demonstration of such a robot.
            DivergedError: if the policy's actions are not finite, or further from the demonstrated ones, on average,
                than the action space is wide and than before adaptation.
        """
        usual = self.fine_tuning
        fine_tuning = usual._replace(
            steps=usual.steps if steps is None else steps,
            learning_rate=usual.learning_rate if learning_rate is None else learning_rate,
        )
        if fine_tuning.steps < 0 or not 0 < fine_tuning.learning_rate < np.inf:
            raise UserError(f"adapt: got {fine_tuning}; wanted steps of at least 0 and a learning_rate above 0")
        actions = self.checkpoint.actions
        method = self.checkpoint.method(len(actions))
        manifest = self.checkpoint.manifest.model_copy(update={"actions": actions})
        interface = Interface.of(manifest, method)
        support = as_demonstrations(demonstrations, interface)
        _warn(support, interface)
        device = self._device if method.on_gpu else CPU
        policy = adapted_on(device, method, self._parameters, support, fine_tuning)
        if (error := _error(policy, support)) > _width(support, actions):
            without = fine_tuning._replace(steps=0)
            before = _error(adapted_on(device, method, self._parameters, support, without), support)
            if error > before or not np.isfinite(error):
                raise DivergedError(
                    f"adaptation diverged: got a mean squared error of {error:.3g} on what was demonstrated after "
                    f"{fine_tuning.steps} steps at a learning rate of {fine_tuning.learning_rate:g}, {before:.3g} "
                    "before; wanted a smaller one; give fewer steps or a smaller learning_rate, and see that the "
                    "demonstrations are in the units of meta-training"
                )
        return AdaptedPolicy(policy, Origin(manifest, self.checkpoint.constants, support, fine_tuning, interface))


def track(demonstrations: Sequence[Any], points: Points, *, low: float = -1.0, high: float = 1.0) -> AdaptedPolicy:
    """Return the tracker of what some demonstrations show: no checkpoint is needed, and nothing is learned.

    The demonstrated path of the hand is followed, shifted by the object and the goal.

    Args:
        demonstrations: of one task, one or more, as `Model.adapt` takes them.
        points: which numbers of an observation are positions.
        low: the least number of an action.
        high: the greatest.

    Warns:
        UnlikeTrainingWarning: names the numbers of actions outside these bounds, where acting clips them.

    Raises:
        UserError: for what is no demonstration, or points that its observations do not have.
    """
    count = action_dim_of(demonstrations)
    actions = Range.of(np.full(count, float(low)), np.full(count, float(high)))
    interface = Interface(points.size, actions, None, "as points.size says, and as the first demonstration has it")
    support = as_demonstrations(demonstrations, interface)
    _warn(support, interface)
    config = ExperimentConfig(
        suite=SuiteConfig(name="own", points=points), method=TrackingConfig(), training=TrainingConfig(iterations=0)
    )
    method = Tracking.prepared(TrackingConfig(), count, support, points)
    manifest = Manifest(
        iteration=0, loss=None, config=config, shapes={}, data={}, versions={}, mlflow_run_id=None, actions=actions
    )
    fine_tuning = config.evaluation.fine_tuning._replace(steps=0)
    policy = method.adapt({}, support, fine_tuning)
    return AdaptedPolicy(policy, Origin(manifest, method.constants(), support, fine_tuning, interface))


def load(name: str | Path, runs: str | Path = "runs", device: str = "cpu") -> Model:
    """Return a model.

    Args:
        name: the folder of a run, whose newest whole checkpoint is then taken, or of a checkpoint; a run's name in
            `runs`; the name of a model that comes with the project, as ml10; or an address as MLflow's
            ``models:/ml10@champion``. The first of these that there is counts.
        runs: the folder that runs' own folders are in.
        device: where it adapts: cpu, or a GPU as cuda or cuda:N; its policies act on the CPU.

    Raises:
        UserError: if there is none, or it is damaged, or there is no such device.
    """
    scheme, colon, _ = str(name).partition(":/")
    if colon and not Path(name).exists():
        return Model(_fetched(scheme, str(name)), device)
    folder = model_folder(name, runs)
    return Model(opened(folder, lambda damaged: warnings.warn(damaged, stacklevel=4)), device)


def model_folder(name: str | Path, runs: str | Path = "runs", field: str = "name") -> Path:
    """Return the folder of a run or of a checkpoint on this machine, as `load` finds it; messages name `field`.

    Raises:
        UserError: if there is none; names the nearest ones.
    """
    for folder in (at_home(name), Path(runs) / name, SHIPPED / name):
        if (folder / MANIFEST).exists() or (folder / FOLDER).is_dir():
            return folder
    shipped = [path.parent.name for path in sorted(SHIPPED.glob(f"*/{MANIFEST}"))]
    of_runs = [path.parent.name for path in sorted(Path(runs).glob(f"*/{FOLDER}"))]
    raise UserError(
        f"{field}: got {shorten(str(name))}; wanted the folder of a run or of a checkpoint, the name of a run in "
        f"{runs}, or a model that comes with the project ({', '.join(shipped) or 'none here'}), or "
        f"models:/NAME@champion{nearest(name, [*of_runs, *shipped])}"
    )


def _fetched(scheme: str, address: str) -> Checkpoint:
    """Return a checkpoint that lies somewhere else."""
    sources = plug_ins(ENTRY_POINTS, lambda name: None)
    if scheme not in sources:
        raise UserError(
            f"name: got {shorten(address)}; wanted a scheme out of {', '.join(sorted(sources)) or 'none'}: install the "
            "project with its services for MLflow's"
        )
    return imported(sources[scheme], "name")(address)


def _warn(support: Sequence[Demonstration], interface: Interface) -> None:
    """Warn whoever called `Model.adapt` or `track` of what stands out."""
    if odd := unlike_training(support, interface):
        warnings.warn(
            f"unlike meta-training, {interface.trained_on}: {'; '.join(odd)}; see to units, order and sensors before a "
            "robot moves",
            UnlikeTrainingWarning,
            stacklevel=3,
        )


@torch.no_grad()
def _error(policy: Policy, support: Sequence[Demonstration]) -> float:
    """Return the mean squared distance from the demonstrated actions, in their states; infinite where that is none."""
    if not all(bool(tensor.isfinite().all()) for tensor in tensors_of(policy).values()):
        return np.inf
    observations = np.concatenate([one.observations for one in support])
    actions = policy.act(observations, policy.start(len(observations))).actions
    error = float(np.square(actions - np.concatenate([one.actions for one in support])).sum(1).mean())
    return error if np.isfinite(error) else np.inf


def _width(support: Sequence[Demonstration], bounds: Range) -> float:
    """Return the squared distance between the opposite corners of the action space and all that was demonstrated."""
    actions = np.concatenate([one.actions for one in support])
    high, low = np.maximum(actions.max(0), np.array(bounds.high)), np.minimum(actions.min(0), np.array(bounds.low))
    return float(np.square(high - low).sum())
