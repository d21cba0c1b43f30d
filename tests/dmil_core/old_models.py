"""Checkpoints of version 0.1, one of each method, and demonstrations for them."""

from pathlib import Path

import numpy as np

from dmil_core.model import Model, load

FOLDER = Path(__file__).parents[1] / "services" / "experiments" / "old_checkpoints"
METHODS = [path.name for path in sorted(FOLDER.iterdir()) if path.name != "nearest-neighbour"]
"""Those whose parameters tell how many numbers an action has."""


def old_model(method: str = "dmil") -> Model:
    """Return a model of observations of 39 and actions of 4 numbers."""
    return load(FOLDER / method)


def recorded(model: Model, count: int = 1, steps: int = 20, seed: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    """Draw demonstrations, as somebody may have recorded them, like those of meta-training."""
    rng, constants = np.random.default_rng(seed), model.checkpoint.constants
    mean, scale = constants["observation_mean"], constants["observation_scale"]
    return [(mean + scale * rng.normal(size=(steps, 39)), rng.uniform(-1, 1, (steps, 4))) for _ in range(count)]
