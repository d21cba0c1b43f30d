"""Settings of OptionGAIL and of its half without play, see `option_gail`."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from dmil_core.settings import Count, HierarchicalConfig, NotNegative, Positive, Probability, Size

Iterations = Annotated[int, Field(ge=0, le=10**9)]


class OptionConfig(HierarchicalConfig):
    """Base of both: the option model and its maximum likelihood."""

    hidden_layers: Size = 4
    """Layers of ReLU units of π_H and of each option, as in DMIL (F.2); the original has 2."""
    hidden_units: Size = 512
    """Units in each hidden layer, as in DMIL (F.2); the original has 64."""
    output_scale: Positive = 1.0
    """Scale of the output layers' first weights, against He's."""
    least_log_deviation: Annotated[float, Field(le=0, allow_inf_nan=False)] = -20.0
    """Lower bound of log σ of an option's actions; the upper one is 0."""
    trajectories: Size = 16
    """Whole demonstrations of a slot's task that it learns from (Table 9)."""
    likelihood_iterations: Iterations = 250
    """So many iterations go up the likelihood, before those of hard EM."""


class OptionGailOfflineConfig(OptionConfig):
    """An option model by maximum likelihood, then hard EM; not adversarial."""

    name: Literal["option-gail-offline"] = "option-gail-offline"
    """The method."""

    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"evaluation": {"learning_rate": 3e-4}},
        "quick": {
            "method": {
                "hidden_layers": 3,
                "hidden_units": 256,
                "output_scale": 0.07,
                "trajectories": 4,
                "likelihood_iterations": 500,
            },
            "evaluation": {"learning_rate": 1e-3},
        },
        "smoke": {
            "method": {"hidden_layers": 2, "hidden_units": 32, "trajectories": 2, "likelihood_iterations": 10},
            "evaluation": {"learning_rate": 1e-3},
        },
    }


class OptionGailConfig(OptionConfig):
    """OptionGAIL: an option model by maximum likelihood and hard EM, then against a discriminator."""

    name: Literal["option-gail"] = "option-gail"
    """The method."""
    likelihood_iterations: Iterations = 60
    """So many iterations go up the likelihood, before the other offline ones, which are of hard EM."""
    offline_iterations: Iterations = 400
    """Iterations before the adversarial ones."""
    offline_steps: Count = 10
    """A slot's own steps of Adam in an offline iteration, each on all that it drew."""
    offline_learning_rate: Positive = 1e-3
    """Of a slot's own Adam in an offline iteration: log σ goes down by no more than this in a step."""
    environment_steps: Count = 410
    """A slot's steps in its task's environments in an adversarial iteration: 10 slots have the original's 4,096."""
    learning_rate: Positive = 3e-4
    """Of a slot's own Adam in an adversarial iteration."""
    weight_decay: NotNegative = 1e-3
    """Of the same."""
    minibatch: Size = 64
    """Steps in one step of the discriminator, from either side, and of PPO."""
    discriminator_passes: Count = 10
    """Passes of the discriminator over the policy's steps in a round."""
    policy_epochs: Count = 10
    """Passes of PPO over the same."""
    discount: Probability = 0.99
    """γ."""
    smoothing: Annotated[float, Field(ge=0, le=1)] = 0.95
    """λ of generalised advantages."""
    clip: Positive = 0.2
    """ε of PPO's clipped surrogate, of both levels."""
    option_entropy: NotNegative = 1e-2
    """Weight of π_H's entropy."""
    discriminator_units: Size = 256
    """Units in either hidden layer of the discriminator."""
    critic_units: Size = 64
    """Units in either hidden layer of the critic."""

    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {
            "training": {"iterations": 4400, "outer_step": "average", "learning_rate": 1.0},
            "evaluation": {"learning_rate": 3e-4},
        },
        "quick": {
            "method": {
                "hidden_layers": 3,
                "hidden_units": 256,
                "output_scale": 0.07,
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
                "hidden_layers": 2,
                "hidden_units": 32,
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
