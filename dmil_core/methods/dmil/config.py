"""The settings of Dual Meta Imitation Learning, each with the place in the paper that it comes from."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from dmil_core.settings import Count, HierarchicalConfig, NotNegative, Positive, Size


class DmilConfig(HierarchicalConfig):
    """Dual Meta Imitation Learning."""

    name: Literal["dmil"] = "dmil"
    """The method."""
    hidden_layers: Size = 4
    """Layers of ReLU units in each network (F.2)."""
    hidden_units: Size = 512
    """Units in each hidden layer (F.2)."""
    output_scale: Positive = 1.0
    """Scale of the output layers' first weights, against He's; the paper names no initialisation."""
    inner_learning_rate: Positive = 5e-4
    """α (Table 9)."""
    inner_steps: Size = 3
    """Steps of the inner loop, Table 9's fine-tune iterations."""
    continuity_weight: NotNegative = 0.1
    """λ (Table 9; Appendix C says 1)."""
    adapted: Literal["both", "high", "low"] = "both"
    """Levels with an inner loop, which are also the ones adapted at test: both; high is DMIL-High and low is DMIL-Low,
    where the outer loop trains the other level as it is (F.3)."""
    em: Literal["hard", "soft", "reference_soft"] = "hard"
    """What the high level learns to predict: the best-fitting sub-skill (equation 3); soft is DMIL_soft (E.6), the
    posterior softmax(-|a - pi_k(s)|^2 / 2 sigma^2); reference_soft: that of the authors' released code."""
    posterior_deviation: Positive = 0.5**0.5
    """σ of the posterior; the paper names none: this one makes it the softmax of the negative squared errors."""
    continuity: Literal["expected", "reference"] = "expected"
    """The continuity loss: the expected switches, which have a gradient; or, as in the authors' released code, the
    count of equation 15, which has none and so only adds to the loss that is shown."""
    order: Literal["first", "second"] = "second"
    """Of the meta-gradient: exact, or taken at the adapted parameters."""
    trajectories: Size = 16
    """Trajectories in each of τ1 to τ4 (Table 9)."""
    window: Count | None = None
    """Cut each trajectory to so many steps at a random place; none takes it whole."""

    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {
            "method": {
                "hidden_layers": 3,
                "hidden_units": 256,
                "output_scale": 0.07,
                "inner_learning_rate": 5e-3,
                "continuity_weight": 0.0,
                "order": "first",
                "trajectories": 4,
                "window": 24,
            },
        },
        "smoke": {
            "method": {
                "hidden_units": 32,
                "hidden_layers": 2,
                "inner_learning_rate": 1e-2,
                "trajectories": 2,
                "window": 24,
            },
        },
    }
