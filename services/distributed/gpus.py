"""The GPUs of a Ray cluster: how many there are, whose they are, and how the actors of a worker share one."""

import sys

from dmil_core.devices import Compute
from dmil_core.errors import UserError

SHARES = {"adaptation": 0.8, "simulation": 0.1, "background": 0.05, "learner": 0.05}
"""Of a worker's GPU, what Ray counts for each kind of actor: together it is no more than the worker's, and no two
adaptation workers with a GPU each are put on one. Ray reserves by these; it limits neither memory nor time."""


def cluster_gpus() -> float:
    """Return how many GPUs the cluster has now."""
    import ray

    return float(ray.cluster_resources().get("GPU", 0.0))


def granted_gpu() -> bool:
    """Tell whether Ray gave this process a GPU."""
    ray = sys.modules.get("ray")
    return ray is not None and ray.is_initialized() and bool(ray.get_gpu_ids())


def gpus_of_each(compute: Compute, asked: float | None, workers: int) -> float:
    """Return the GPUs of each of so many workers in the cluster that was joined.

    If nobody asked for any: none, or an equal part of all where there must be one.

    Raises:
        UserError: if there must be one, and there is none.
    """
    if not compute.wants_gpu:
        return asked or 0.0
    if not (there := cluster_gpus()) or asked == 0:
        raise UserError(
            f"--device: got {compute.device}; wanted cpu or auto: the cluster has {there:g} GPUs, and a worker is to "
            f"have {'an equal part' if asked is None else f'{asked:g}'}; see docs/scaling.md"
        )
    return min(1.0, there / workers) if asked is None else asked
