"""The place that models in MLflow import `Checkpoint` from if they were logged before version 0.2; it goes with 0.4."""

from dmil_core.checkpoint import Checkpoint

__all__ = ["Checkpoint"]
