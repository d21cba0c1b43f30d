"""Settings of PEMIRL, each with its place in the papers."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from dmil_core.settings import QUICK_NETWORK, SMOKE_NETWORK, Count, NetworkConfig, NotNegative, Size


class PemirlConfig(NetworkConfig):
    """PEMIRL, behaviour-cloning variant."""

    name: Literal["pemirl"] = "pemirl"
    """The method."""
    reward_layers: Size = 3
    """Hidden layers of ReLU units in reward and potential (F.2)."""
    context_dim: Size = 3
    """Size of the context m, as in the original."""
    initial_deviation: Annotated[float, Field(ge=0.01, le=10, strict=True)] = 0.3
    """Initial standard deviation σ of the policy, in the environment's units."""
    trajectories: Size = 16
    """Trajectories of each task whose actions are predicted (Table 12)."""
    contexts: Size = 4
    """Number C of other trajectories, from each of which one m is inferred for an equal share of the predicted ones."""
    steps_per_trajectory: Count | None = None
    """Largest number of steps of each trajectory, drawn at random; none uses all. All losses are means over steps."""
    discount: NotNegative = 1.0
    """Coefficient γ of h_φ (Table 12)."""
    information_weight: NotNegative = 0.1
    """Weight β of the information term (Table 12)."""
    divergence_weight: NotNegative = 0.1
    """Weight of KL(q ‖ N(0, 1)), relative to the mean log-likelihood of a step, as in the original."""
    policy_weight: NotNegative = 0.1
    """Weight of the policy's surrogate, relative to the mean log-likelihood of a step."""
    negatives: Literal["same", "mismatched"] = "same"
    """Context m of the discriminator's negatives: same as the expert's, as in the original; mismatched: of N(0, 1)."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {"method": {**QUICK_NETWORK, "trajectories": 8, "steps_per_trajectory": 32}},
        "smoke": {
            "method": {
                **SMOKE_NETWORK,
                "reward_layers": 2,
                "trajectories": 4,
                "contexts": 2,
                "steps_per_trajectory": 24,
            }
        },
    }
