"""The settings of MLSH, each with the place in the paper that it comes from."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from dmil_core.settings import (
    QUICK_NETWORK,
    SMOKE_NETWORK,
    Count,
    HierarchicalConfig,
    NetworkConfig,
    NotNegative,
    Positive,
    Probability,
    Size,
)


class MlshConfig(HierarchicalConfig, NetworkConfig):
    """Meta Learning Shared Hierarchies, behaviour-cloning variant."""

    name: Literal["mlsh"] = "mlsh"
    """The method."""
    macro_step: Size = 3
    """Steps that a sub-skill acts before the high level chooses again (F.2)."""
    high_learning_rate: Positive = 1e-3
    """Learning rate of the high level's Adam (Table 11)."""
    sub_skill_learning_rate: Positive = 1e-4
    """Learning rate of the sub-skills' Adam (Table 11)."""
    clip: Positive = 0.02
    """Clip range ε of PPO's probability ratio (Table 11)."""
    warm_up_updates: Count = 500
    """Updates of the fresh high level alone (Table 11)."""
    joint_updates: Count = 1000
    """Updates of both levels after the warm-up (Table 11)."""
    batch_size: Size = 900
    """State-action pairs in a batch (Table 11)."""
    passes: Size = 3
    """Updates from one batch."""
    deviation: Positive = 0.3
    """Standard deviation σ of the sub-skills' actions in training."""
    discount: Probability = 0.0
    """Discount γ."""
    trace: Probability = 0.98
    """λ of generalised advantage estimation; without effect where γ = 0."""
    value_weight: NotNegative = 0.5
    """Weight c of the values' squared error."""
    trajectories: Size = 64
    """Demonstrations of a sampled task, as many as DMIL's four sets; all of them where there are fewer."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {
            "training": {"outer_step": "average", "learning_rate": 1.0},
            "evaluation": {"fine_tuning_steps": 500, "learning_rate": 1e-3},
        },
        "quick": {
            "method": {
                **QUICK_NETWORK,
                "high_learning_rate": 1e-2,
                "sub_skill_learning_rate": 3e-3,
                "warm_up_updates": 60,
                "joint_updates": 30,
                "batch_size": 300,
                "deviation": 0.6,
                "trajectories": 16,
            },
            "training": {
                "iterations": 250,
                "outer_step": "average",
                "learning_rate": 1.0,
                "gradient_clip": None,
                "checkpoint_every": 25,
            },
            "evaluation": {"fine_tuning_steps": 100, "learning_rate": 1e-2},
        },
        "smoke": {
            "method": {
                **SMOKE_NETWORK,
                "high_learning_rate": 1e-2,
                "sub_skill_learning_rate": 1e-3,
                "warm_up_updates": 10,
                "joint_updates": 20,
                "batch_size": 90,
                "trajectories": 4,
            },
            "training": {"outer_step": "average", "learning_rate": 1.0},
            "evaluation": {"learning_rate": 1e-2},
        },
    }
