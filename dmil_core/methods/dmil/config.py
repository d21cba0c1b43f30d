"""The settings of Dual Meta Imitation Learning, each with the place in the paper that it comes from."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from dmil_core.settings import (
    QUICK_NETWORK,
    SMOKE_NETWORK,
    AnyCount,
    ContextConfig,
    HierarchicalConfig,
    NetworkConfig,
    NotNegative,
    Positive,
    Size,
    WindowConfig,
)


class DmilConfig(HierarchicalConfig, NetworkConfig, WindowConfig, ContextConfig):
    """Dual Meta Imitation Learning."""

    name: Literal["dmil"] = "dmil"
    """The method."""
    inner_learning_rate: Positive = 5e-4
    """Learning rate α of the inner loop (Table 9)."""
    inner_steps: Size = 3
    """Steps of the inner loop, Table 9's fine-tune iterations."""
    continuity_weight: NotNegative = 0.1
    """Weight λ of the continuity loss (Table 9; Appendix C has 1)."""
    adapted: Literal["both", "high", "low"] = "both"
    """Levels that the inner loop adapts, in meta-training and at test: high is DMIL-High and low is DMIL-Low, where the
    other level learns in the outer loop alone (F.3)."""
    em: Literal["hard", "soft", "reference_soft"] = "hard"
    """Targets of the high level: hard is the best-fitting sub-skill (equation 3); soft is DMIL_soft (E.6), the
    posterior softmax(-|a - pi_k(s)|^2 / 2 sigma^2); reference_soft is that of the authors' released code."""
    posterior_deviation: Positive = 0.5**0.5
    """Standard deviation σ of the posterior; the default makes it the softmax of the negative squared errors."""
    continuity: Literal["expected", "reference"] = "expected"
    """Continuity loss: expected is the expected number of switches; reference is the count of equation 15, as in the
    authors' released code, which has no gradient."""
    balance: Literal["none", "sinkhorn"] = "none"
    """Labels in meta-training: none gives each state to the sub-skill that fits best (equation 3); sinkhorn also gives
    each sub-skill about as many of a set's states, so that none is left without any."""
    labels_until: AnyCount = 0
    """In so many first iterations of meta-training a sub-skill learns where the labels say, not where the high level
    has chosen it: one that is never chosen learns too."""
    order: Literal["first", "second"] = "second"
    """Order of the meta-gradient: second is exact, first is taken at the adapted parameters."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {
            "method": {
                **QUICK_NETWORK,
                "inner_learning_rate": 5e-3,
                "continuity_weight": 0.0,
                "order": "first",
                "trajectories": 4,
                "window": 24,
            }
        },
        "smoke": {"method": {**SMOKE_NETWORK, "inner_learning_rate": 1e-2, "trajectories": 2, "window": 24}},
    }
