"""An iteration in numbers and words: the metrics that are tracked, and the status on the screen."""

from collections.abc import Mapping, Sequence

import numpy as np

from dmil_core.statistics import share_entropy
from services.cli.live_view import Status
from services.distributed.runner import Iteration


def iteration_metrics(iteration: Iteration) -> dict[str, float]:
    """Return an iteration's metrics: the means over its slots, their entropy, and its speed."""
    metrics = {name: float(np.mean([slot[name] for slot in iteration.slots])) for name in iteration.slots[0]}
    if "environment_steps" in metrics:
        metrics["environment_steps"] *= len(iteration.slots)
    if len(shares := shares_of(metrics)) > 1:
        metrics["sub_skill_entropy"] = share_entropy(shares)
    return metrics | {
        "gradient_norm": iteration.gradient_norm,
        "iterations_per_second": 1 / iteration.timing.iteration,
        "overhead_share": iteration.timing.overhead_share,
    }


def shares_of(metrics: Mapping[str, float]) -> np.ndarray:
    """Return the part of the states that each sub-skill takes, if there are sub-skills."""
    return np.array([share for name, share in metrics.items() if name.startswith("sub_skill_share/")])


def status_of(recent: Sequence[Mapping[str, float]]) -> Status:
    """Return the losses and the use of sub-skills as means over some iterations' metrics."""
    if not recent:
        return Status()
    names = [name for name in recent[-1] if "loss" in name or name.startswith("sub_skill_share/")]
    # A method that learns in phases has other metrics in each.
    means = {name: float(np.mean([metrics[name] for metrics in recent if name in metrics])) for name in names}
    losses = {name: value for name, value in means.items() if "loss" in name}
    return Status(losses=losses, shares=shares_of(means).tolist())


def nonfinite_message(iteration: Iteration) -> str:
    """Return which slots of an iteration have a loss or a gradient that is not finite."""
    slots = "; ".join(
        f"slot {slot.slot}, task {slot.task}, demonstrations {', '.join(dict.fromkeys(slot.demonstrations))}"
        for slot in iteration.nonfinite
    )
    return f"iteration {iteration.number}: a loss or a gradient is not finite in {slots or 'the sum over all slots'}"
