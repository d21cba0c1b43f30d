"""Settings of OptionGAIL and of its half without play, see `option_gail`."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from dmil_core.settings import (
    QUICK_NETWORK,
    SMOKE_NETWORK,
    AnyCount,
    Count,
    HierarchicalConfig,
    NetworkConfig,
    NotNegative,
    Positive,
    Probability,
    Size,
)


class OptionConfig(HierarchicalConfig, NetworkConfig):
    """Base of both: the option model and its maximum likelihood."""

    least_log_deviation: Annotated[float, Field(le=0, allow_inf_nan=False, strict=True)] = -20.0
    """Lower bound of log σ of an option's actions; the upper bound is 0."""
    trajectories: Size = 16
    """Whole demonstrations that a slot draws from its task (Table 9)."""
    likelihood_iterations: AnyCount = 250
    """Iterations of maximum likelihood, before those of hard EM."""


class OptionGailOfflineConfig(OptionConfig):
    """An option model by maximum likelihood, then hard EM; not adversarial."""

    name: Literal["option-gail-offline"] = "option-gail-offline"
    """The method."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"evaluation": {"learning_rate": 3e-4}},
        "quick": {
            "method": {**QUICK_NETWORK, "trajectories": 4, "likelihood_iterations": 500},
            "evaluation": {"learning_rate": 1e-3},
        },
        "smoke": {
            "method": {**SMOKE_NETWORK, "trajectories": 2, "likelihood_iterations": 10},
            "evaluation": {"learning_rate": 1e-3},
        },
    }


class OptionGailConfig(OptionConfig):
    """OptionGAIL: an option model by maximum likelihood and hard EM, then against a discriminator."""

    name: Literal["option-gail"] = "option-gail"
    """The method."""
    likelihood_iterations: AnyCount = 60
    """Offline iterations of maximum likelihood; the remaining ones are of hard EM."""
    offline_iterations: AnyCount = 400
    """Offline iterations, before the adversarial ones."""
    offline_steps: Count = 10
    """Steps of Adam that a slot takes in an offline iteration, each on its whole batch."""
    offline_learning_rate: Positive = 1e-3
    """Learning rate of a slot's Adam in an offline iteration, and so the largest change of log σ in a step."""
    environment_steps: Count = 410
    """Environment steps of a slot in an adversarial iteration: 10 slots have the original's 4,096."""
    learning_rate: Positive = 3e-4
    """Learning rate of a slot's Adam in an adversarial iteration."""
    weight_decay: NotNegative = 1e-3
    """Weight decay of a slot's Adam in an adversarial iteration."""
    minibatch: Size = 64
    """Minibatch size of PPO, and of the policy's and the expert's side of the discriminator."""
    discriminator_passes: Count = 10
    """Epochs of the discriminator over the policy's steps in an adversarial iteration."""
    policy_epochs: Count = 10
    """Epochs of PPO over the policy's steps in an adversarial iteration."""
    discount: Probability = 0.99
    """Discount γ."""
    smoothing: Annotated[float, Field(ge=0, le=1, strict=True)] = 0.95
    """λ of generalised advantage estimation."""
    clip: Positive = 0.2
    """Clip range ε of PPO's probability ratio at both levels."""
    option_entropy: NotNegative = 1e-2
    """Weight of the entropy of π_H."""
    discriminator_units: Size = 256
    """Units in either hidden layer of the discriminator."""
    critic_units: Size = 64
    """Units in either hidden layer of the critic."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {
            "training": {"iterations": 4400, "outer_step": "average", "learning_rate": 1.0},
            "evaluation": {"learning_rate": 3e-4},
        },
        "quick": {
            "method": {
                **QUICK_NETWORK,
                "least_log_deviation": -2.0,
                "trajectories": 4,
                "likelihood_iterations": 30,
                "offline_iterations": 250,
                "environment_steps": 500,
                "learning_rate": 3e-5,
                "policy_epochs": 3,
            },
            "training": {
                "iterations": 350,
                "outer_step": "average",
                "learning_rate": 1.0,
                "gradient_clip": None,
                "checkpoint_every": 50,
            },
            "evaluation": {"learning_rate": 1e-3},
        },
        "smoke": {
            "method": {
                **SMOKE_NETWORK,
                "trajectories": 2,
                "likelihood_iterations": 1,
                "offline_iterations": 2,
                "offline_steps": 2,
                "environment_steps": 50,
                "discriminator_passes": 2,
                "policy_epochs": 2,
                "discriminator_units": 32,
            },
            "training": {"outer_step": "average", "learning_rate": 1.0},
            "evaluation": {"learning_rate": 1e-3},
        },
    }
