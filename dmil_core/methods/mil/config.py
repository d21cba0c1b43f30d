"""The settings of MIL, each with the place in the papers that it comes from."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from dmil_core.settings import MethodConfig, Positive, Probability, Size


class MilConfig(MethodConfig):
    """Meta imitation learning with a transformer."""

    name: Literal["mil"] = "mil"
    """The method."""
    layers: Size = 3
    """Layers of the encoder, and as many of the decoder (Table 10)."""
    heads: Size = 8
    """Heads of each attention (Table 10)."""
    units: Size = 512
    """Units of each token, d_model (Table 10)."""
    key_units: Size = 64
    """Units of each head's keys and queries, d_k (Table 10)."""
    value_units: Size = 64
    """Units of each head's values, d_v (Table 10)."""
    feed_forward_units: Size = 2048
    """Hidden units of each layer's feed-forward part; the paper gives no number."""
    output_scale: Positive = 0.1
    """Factor on the initial weights of the output layer: at 1 the first inner steps overshoot."""
    positions: Size = 250
    """Positions in a demonstration (Table 10); a longer one is thinned out to this many steps."""
    dropout: Probability = 0.1
    """Dropout rate in the outer loss (Table 10)."""
    batch_pairs: Size = 512
    """Largest number of state-action pairs in each of the two losses (Table 10)."""
    shots: Size = 3
    """Largest number of demonstrations in a support set: meta-training draws from one to this many."""
    inner_learning_rate: Positive = 1e-3
    """Learning rate α of the inner loop; Finn et al. 2017 have 0.001 to 0.01."""
    inner_steps: Size = 1
    """Steps of the inner loop (Finn et al. 2017)."""
    inner_clip: Positive | None = 10.0
    """Clip each element of the inner gradients to ± this value (Finn et al. 2017: 10 or 20)."""
    order: Literal["first", "second"] = "second"
    """Order of the meta-gradient: second is exact, first is taken at the adapted parameters."""

    bound_of_shots: ClassVar[str | None] = "shots"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"evaluation": {"fine_tuning_steps": 1, "learning_rate": 1e-3}},
        "quick": {
            "method": {
                "layers": 2,
                "heads": 4,
                "units": 128,
                "key_units": 32,
                "value_units": 32,
                "feed_forward_units": 256,
                "positions": 64,
                "batch_pairs": 256,
                "inner_learning_rate": 3e-3,
                "order": "first",
            },
            "training": {"iterations": 2500},
            "evaluation": {"fine_tuning_steps": 1, "learning_rate": 3e-3},
        },
        "smoke": {
            "method": {
                "layers": 1,
                "heads": 2,
                "units": 16,
                "key_units": 8,
                "value_units": 8,
                "feed_forward_units": 32,
                "positions": 50,
                "batch_pairs": 64,
                "inner_learning_rate": 1e-2,
            },
            "evaluation": {"fine_tuning_steps": 1, "learning_rate": 1e-2},
        },
    }
