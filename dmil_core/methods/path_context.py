"""The path network: it acts by where the demonstrated hand goes next, from the nearest state of each demonstration.

Its input is one row for each observation and each support demonstration, whose nearest state is matched first, by
differences of positions. A row holds the demonstrated path of the hand `HORIZONS` steps ahead of the match, relative to
the hand and in the frames of hand, object and goal; the demonstrated actions there; the distance of the match; and the
part of the state that does not depend on place: gripper, heights, last moves. The network turns each row into an action
and a weight, and the softmax of the weights combines the actions. It is meta-trained to imitate some demonstrations of
a task given others, and adapts by its input alone, not by gradients: in-context imitation (DARP, ICLR 2026).
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor
from torch.nn import functional

from dmil_core.demonstrations import Demonstration, Normalisation, PathBatch, TaskBatch
from dmil_core.errors import UserError
from dmil_core.loss_gradients import LossGradient, loss_gradient
from dmil_core.losses import differentiated, squared_errors
from dmil_core.methods.base import Method, TaskGradient
from dmil_core.networks import (
    Network,
    Parameters,
    each_tensor,
    initialise,
    mlp,
    network,
    on_default_device,
    unflatten,
    without_graph,
)
from dmil_core.points import Points, moved, position, present
from dmil_core.settings import ContextConfig

HORIZONS = (0, 1, 3, 6, 10, 16)
"""Steps ahead on the demonstrated path."""
SHOTS = (1, 3)
"""Demonstrations that are seen in meta-training, drawn anew each time."""
QUERIES, QUERY_STATES = 3, 64
"""Other demonstrations of a task that are imitated in one slot, and states of them in all."""
DOUBT, JITTER = 0.3, 2
"""Noise on the matches of meta-training, as matches are worse at test: with probability 1/2 each, Gumbel noise of this
scale on the distances, and a shift by up to so many steps."""


def _scaled(difference: np.ndarray, reach: float) -> list[np.ndarray]:
    return [difference / (10 * reach), np.tanh(difference / (2 * reach))]


@dataclass(frozen=True)
class PathView:
    """The features by which states are matched, and those of the state itself in a row."""

    points: Points
    normalise: Normalisation
    """Of the observations that are compared where no object is declared."""

    def match(self, observations: Float32[np.ndarray, "steps obs_dim"]) -> Float32[np.ndarray, "steps compared"]:
        """Return the features whose squared distance is least between matching states."""
        points = self.points
        if points.object is None:
            return self.normalise(observations)
        hand, object_, goal, second = (
            position(observations, axes, points)
            for axes in (points.hand, points.object, points.goal, points.second_object)
        )
        goal_there, second_there = (present(observations, axes, points) for axes in (points.goal, points.second_object))
        away = np.concatenate(
            [object_ - hand, (goal - hand) * goal_there, (goal - object_) * goal_there, (second - hand) * second_there],
            axis=1,
        )
        gripper = () if points.gripper is None else (points.gripper,)
        return np.concatenate(
            [
                *_scaled(away, points.reach),
                hand[:, -1:] / (10 * points.reach),
                2 * observations[:, list(gripper)] - 1,
                10 * moved(observations, gripper, points),
                (moved(observations, points.hand, points) / (2 * points.reach)).clip(-1, 1),
                (moved(observations, points.object, points) / points.reach).clip(-1, 1),
            ],
            axis=1,
            dtype=np.float32,
        )

    def anywhere(self, observations: Float32[np.ndarray, "steps obs_dim"]) -> Float32[np.ndarray, "steps _"]:
        """Return the features of a state that do not depend on place: gripper, heights and last moves."""
        points = self.points
        if points.object is None:
            return np.zeros((len(observations), 0), np.float32)
        gripper = () if points.gripper is None else (points.gripper,)
        heights = [position(observations, axes, points)[:, -1:] for axes in (points.hand, points.object, points.goal)]
        return np.concatenate(
            [
                2 * observations[:, list(gripper)] - 1,
                10 * moved(observations, gripper, points),
                np.concatenate(heights, 1) / (10 * points.reach),
                (moved(observations, points.hand, points) / points.reach).clip(-3, 3),
                (moved(observations, points.object, points) / points.reach).clip(-3, 3),
            ],
            axis=1,
            dtype=np.float32,
        )


@dataclass(frozen=True)
class _Seen:
    """The features of a demonstration at each step."""

    compared: Float32[np.ndarray, "steps compared"]
    anywhere: Float32[np.ndarray, "steps _"]
    frames: Sequence[tuple[Float32[np.ndarray, "steps axes"], tuple[int, ...] | None]]
    """Origins of the frames, and which numbers of an observation they are; None for a frame that does not move. In that
    of the hand, the path is where the demonstrated hand goes from the match."""
    ahead: Float32[np.ndarray, "steps horizons axes"]
    """The hand's positions `HORIZONS` steps ahead."""
    actions: Float32[np.ndarray, "steps action_dim"]
    others: Float32[np.ndarray, "steps _"]
    """At the same horizons, the numbers of the actions that do not move the hand."""


@dataclass(frozen=True)
class PathContext:
    """The demonstrations in a path network's input."""

    view: PathView
    seen: tuple[_Seen, ...]

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration], view: PathView) -> "PathContext":
        """Compute the features of some demonstrations of one task."""
        points = view.points
        axes = (points.hand, points.object, points.goal) if points.object is not None else (points.hand, None)

        def seen(one: Demonstration) -> _Seen:
            steps = np.arange(len(one))
            later = np.minimum(steps[:, None] + HORIZONS, len(one) - 1)
            hand = position(one.observations, points.hand, points)
            return _Seen(
                view.match(one.observations),
                view.anywhere(one.observations),
                [(position(one.observations, of, points), of) for of in axes],
                hand[later],
                one.actions,
                one.actions[later, len(points.hand) :].reshape(len(one), -1),
            )

        return cls(view, tuple(map(seen, demonstrations)))

    def rows(
        self, observations: Float32[np.ndarray, "steps obs_dim"], rng: np.random.Generator | None = None
    ) -> Float[Tensor, "rows features"]:
        """Return the network's input: the rows of all demonstrations for the first observation, then for the next.

        Args:
            observations: those to act on.
            rng: source of the noise on the matches in meta-training; without it, the nearest states are matched.
        """
        compared, anywhere = self.view.match(observations), self.view.anywhere(observations)
        rows = [self._row(observations, compared, anywhere, seen, rng) for seen in self.seen]
        return on_default_device(np.stack(rows, 1).reshape(len(observations) * len(rows), rows[0].shape[1]))

    def _row(
        self,
        observations: np.ndarray,
        compared: np.ndarray,
        anywhere: np.ndarray,
        seen: _Seen,
        rng: np.random.Generator | None,
    ) -> Float32[np.ndarray, "steps features"]:
        points = self.view.points
        far = np.square(compared[:, None] - seen.compared).sum(-1)
        if rng is not None and rng.random() < 0.5:
            far = far + DOUBT * rng.gumbel(size=far.shape)
        nearest = far.argmin(1)
        if rng is not None and rng.random() < 0.5:
            nearest = np.clip(nearest + rng.integers(-JITTER, JITTER + 1, len(nearest)), 0, len(seen.actions) - 1)
        hand = position(observations, points.hand, points)
        parts = []
        for places, axes in seen.frames:
            shift = position(observations, axes, points) - places[nearest]
            error = seen.ahead[nearest] + shift[:, None] - hand[:, None]
            numbers = len(HORIZONS) * len(points.hand)
            parts += [part.reshape(len(observations), numbers) for part in _scaled(error, points.reach)]
        parts += [seen.actions[nearest], seen.others[nearest]]
        parts += [np.abs(seen.compared[nearest] - compared).mean(1, keepdims=True)]
        parts += [anywhere, anywhere - seen.anywhere[nearest]]
        return np.concatenate(parts, 1, dtype=np.float32)


def combined(outputs: Float[Tensor, "rows outputs"], demonstrations: int) -> Float[Tensor, "steps action_dim"]:
    """Return the action at each step: the mean over demonstrations, weighted by the softmax of the last outputs."""
    of_each = outputs.unflatten(0, (-1, demonstrations))
    return (of_each[..., :-1] * of_each[..., -1:].softmax(1)).sum(1)


def sample_path_batch(demonstrations: Sequence[Demonstration], rng: np.random.Generator) -> PathBatch:
    """Draw one or three demonstrations of a task as context and up to three others to imitate; a single one is both."""
    order, shots = rng.permutation(len(demonstrations)), int(rng.choice(SHOTS))
    shots = min(shots, max(1, len(order) - 1))
    drawn = [demonstrations[index] for index in order]
    return PathBatch(tuple(drawn[:shots]), tuple(drawn[shots : shots + QUERIES] or drawn), int(rng.integers(2**31)))


def _drawn(
    batch: PathBatch, view: PathView
) -> tuple[Float[Tensor, "rows features"], Float[Tensor, "states action_dim"]]:
    """Return the network's input at states of the batch's queries, and the demonstrated actions there."""
    rng = np.random.default_rng(batch.seed)
    observations = np.concatenate([one.observations for one in batch.query])
    chosen: Int[np.ndarray, " states"] = rng.integers(0, len(observations), QUERY_STATES)
    actions = on_default_device(np.concatenate([one.actions for one in batch.query])[chosen])
    return PathContext.of(batch.context, view).rows(observations[chosen], rng), actions


def path_gradient(network: Network, batch: PathBatch, view: PathView) -> LossGradient:
    """Return the network's squared error at states of the batch's queries, and its gradient."""
    rows, actions = _drawn(batch, view)

    def loss(outputs: Tensor) -> Tensor:
        return squared_errors(combined(outputs, len(batch.context)), actions).mean()

    return loss_gradient(network, rows, lambda outputs: differentiated(loss, outputs))


def path_gradients(network: Network, batches: Sequence[PathBatch], view: PathView) -> LossGradient:
    """Return `path_gradient` of several batches as one computation; a batch with fewer demonstrations is padded."""
    drawn, shots = [_drawn(batch, view) for batch in batches], [len(batch.context) for batch in batches]
    most, actions = max(shots), torch.stack([actions for _, actions in drawn])
    each = [rows.unflatten(0, (-1, count)) for (rows, _), count in zip(drawn, shots, strict=True)]
    rows = torch.stack([functional.pad(of, (0, 0, 0, most - of.shape[1])).flatten(0, 1) for of in each])
    absent = torch.arange(most) >= torch.tensor(shots)[:, None]

    def loss(outputs: Float[Tensor, "batches rows outputs"]) -> Float[Tensor, " batches"]:
        of_each = outputs.unflatten(1, (-1, most))
        shares = of_each[..., -1:].masked_fill(absent[:, None, :, None], -torch.inf).softmax(2)
        return ((of_each[..., :-1] * shares).sum(2) - actions).square().sum(-1).mean(-1)

    copies = each_tensor(network, lambda tensor: tensor.expand(len(batches), *tensor.shape))
    return loss_gradient(copies, rows, lambda outputs: differentiated(loss, outputs))


@dataclass(frozen=True)
class PathGuide:
    """A path network with its demonstrations, whose action is part of a policy's."""

    network: Network
    context: PathContext
    share: float

    def blend(
        self, actions: Float[Tensor, "episodes action_dim"], observations: Float32[np.ndarray, "episodes obs_dim"]
    ) -> Float[Tensor, "episodes action_dim"]:
        """Return the weighted mean of a policy's own actions and the path network's, both clipped to [-1, 1]."""
        outputs = mlp(self.network, self.context.rows(observations))
        guided = combined(outputs, len(self.context.seen)).clamp(-1, 1)
        return (1 - self.share) * actions.clamp(-1, 1) + self.share * guided


def view_of(method: Method[Any]) -> PathView | None:
    """Return the features of a method's path network, if it has one.

    Raises:
        UserError: if it has one, and no points are declared.
    """
    if not isinstance(method.config, ContextConfig) or method.config.context == "none":
        return None
    if method.points is None:
        raise UserError("method.context: got path for a suite without points; wanted suite.points, at least hand")
    return PathView(method.points, method.normalise)


def initial_path_network(method: Method[Any], rng: np.random.Generator) -> Parameters:
    """Draw the parameters ``path.*``, if a method has a path network."""
    if (view := view_of(method)) is None:
        return {}
    size, config = view.points.size, method.config
    blank = Demonstration("", "", np.zeros((1, size), np.float32), np.zeros((1, method.action_dim), np.float32))
    seen = PathContext.of([blank], view).rows(blank.observations).shape[1]
    return initialise("path", [seen, *config.hidden, method.action_dim + 1], rng, output_scale=config.output_scale)


def with_path(
    method: Method[Any], batch: TaskBatch, demonstrations: Sequence[Demonstration], rng: np.random.Generator
) -> TaskBatch:
    """Return the batch with what a path network learns from, if a method has one."""
    if view_of(method) is None:
        return batch
    return dataclasses.replace(batch, path=sample_path_batch(demonstrations, rng))


def with_path_gradient(
    method: Method[Any], result: TaskGradient, parameters: Parameters, batch: TaskBatch
) -> TaskGradient:
    """Return the gradient with the path network's added, whose entries are zero so far, if a method has one."""
    if (view := view_of(method)) is None:
        return result
    assert batch.path is not None
    of_path = path_gradient(network(parameters, "path"), batch.path, view)
    views = unflatten(result.gradient, {name: tensor.shape for name, tensor in parameters.items()})
    of_path.add_to(network(views, "path"))
    return result._replace(metrics={**result.metrics, "path_loss": of_path.loss.value.item()})


def with_path_gradients(
    method: Method[Any], results: Sequence[TaskGradient], parameters: Parameters, batches: Sequence[TaskBatch]
) -> list[TaskGradient]:
    """Return `with_path_gradient` of several tasks, computed at once."""
    if (view := view_of(method)) is None:
        return list(results)
    layers, paths = network(without_graph(parameters), "path"), [batch.path for batch in batches if batch.path]
    of_path = path_gradients(layers, paths, view)
    vector = each_tensor(layers, lambda tensor: tensor.new_zeros(len(paths), *tensor.shape))
    of_path.add_to(vector)
    shapes = {name: tensor.shape for name, tensor in parameters.items()}
    for index, result in enumerate(results):
        for view_of_layer, layer in zip(network(unflatten(result.gradient, shapes), "path"), vector, strict=True):
            for part, values in zip(view_of_layer, layer, strict=True):
                part.copy_(values[index])
    losses = of_path.loss.value.tolist()
    return [
        result._replace(metrics={**result.metrics, "path_loss": loss})
        for result, loss in zip(results, losses, strict=True)
    ]


def guide_of(method: Method[Any], parameters: Parameters, support: Sequence[Demonstration]) -> PathGuide | None:
    """Return the path network with a support set as its context, if a method has one."""
    if (view := view_of(method)) is None:
        return None
    layers = network(without_graph(parameters), "path")
    return PathGuide(layers, PathContext.of(support, view), method.config.context_share)
