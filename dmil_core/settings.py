"""Bounds of settings, and the bases of a method's own settings; without torch, as all that `--help` shows."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeAlias, TypeVar

from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError

# strict: a number as text and true for a number are refused wherever settings come from, in YAML and in JSON alike.
Count = Annotated[int, Field(ge=1, le=10**9, strict=True)]
AnyCount = Annotated[int, Field(ge=0, le=10**9, strict=True)]
"""A count that may be 0."""
Size = Annotated[int, Field(ge=1, le=10_000, strict=True)]
"""A count of what is held in memory together."""
Flag = Annotated[bool, Field(strict=True)]
Seed = Annotated[int, Field(ge=0, lt=2**63, strict=True)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Probability = Annotated[float, Field(ge=0, lt=1, strict=True)]
Optimiser: TypeAlias = Literal["sgd", "adam"]
GradientPath: TypeAlias = Literal["auto", "loop", "batched"]
"""How a group's gradients are computed, see `dmil_core.devices.Compute`."""
OnNonfinite: TypeAlias = Literal["stop", "skip"]
"""What becomes of an iteration whose loss or gradient is not finite."""


T = TypeVar("T")


def without_doubles(values: tuple[T, ...]) -> tuple[T, ...]:
    """Return values of which none stands twice.

    Raises:
        PydanticCustomError: for any that does: its episodes would be counted twice, and the intervals be too narrow.
    """
    if len(set(values)) < len(values):
        raise PydanticCustomError("doubles", "wanted each once")
    return values


class Settings(BaseModel):
    """Base of all settings: unknown keys are refused, and instances are immutable."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class FineTuning(NamedTuple):
    """Gradient steps of adaptation at test; a method without any ignores it."""

    steps: int
    learning_rate: float
    optimiser: Optimiser = "sgd"
    """sgd: plain steps on the whole support set, as in the inner loop; adam: `dmil_core.fine_tuning.on_batches`."""
    displaced: int = 0
    """Displaced copies of the support set, see `dmil_core.paths.with_copies`."""


class MethodConfig(Settings):
    """Base of a method's own settings."""

    name: Any
    """The method."""
    standardise: Flag = True
    """Normalise observations by mean and standard deviation of the meta-training demonstrations."""
    features: Literal["raw", "relative"] = "raw"
    """What networks see of an observation: its numbers, or differences of the points that the suite declares."""
    absolute_position: Flag = False
    """Whether relative features hold the hand's own position too."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Settings of the method's own, by section, in each of the presets paper, quick and smoke."""
    bound_of_shots: ClassVar[str | None] = None
    """Name of the setting that limits the demonstrations of a support set, if there is a limit."""

    @property
    def uses_points(self) -> bool:
        """Whether it works with the points that a suite declares."""
        return self.features == "relative"


class NetworkConfig(MethodConfig):
    """Base of the settings of a method whose networks are perceptrons."""

    hidden_layers: Size = 4
    """Hidden layers of ReLU units in each network (F.2)."""
    hidden_units: Size = 512
    """Units in each hidden layer (F.2)."""
    output_scale: Positive = 1.0
    """Factor on the initial weights of the output layers, relative to He's initialisation."""

    @property
    def hidden(self) -> list[int]:
        """Units of each hidden layer."""
        return [self.hidden_units] * self.hidden_layers


QUICK_NETWORK = {"hidden_layers": 3, "hidden_units": 256, "output_scale": 0.07}
SMOKE_NETWORK = {"hidden_layers": 2, "hidden_units": 32}
"""Settings of a `NetworkConfig` in the presets quick and smoke."""


class WindowConfig(MethodConfig):
    """Base of the settings of a method that draws {τ1}..{τ4} of Algorithm 1."""

    trajectories: Size = 16
    """Trajectories in each of τ1 to τ4 (Table 9)."""
    window: Count | None = None
    """Cut each trajectory to this many steps from a random step on; none uses it whole."""


class ContextConfig(MethodConfig):
    """Base of the settings of a method whose policy may see its demonstrations while it acts."""

    context: Literal["none", "path"] = "none"
    """path: a second network sees where the demonstrated hand goes next, from the nearest support state; it is
    meta-trained beside the others, and its action is part of the policy's."""
    context_share: Annotated[float, Field(ge=0, le=1, strict=True)] = 0.5
    """Part that the path network has in the action, where there is one."""

    @property
    def uses_points(self) -> bool:
        """Whether it works with the points that a suite declares."""
        return super().uses_points or self.context == "path"


class HierarchicalConfig(MethodConfig):
    """Base of the settings of a method with sub-skills."""

    sub_skills: Size = 3
    """K, the number of sub-skills (Table 4)."""


def sub_skills_of(config: MethodConfig) -> int:
    """Return K, which is 1 for a method without sub-skills."""
    return config.sub_skills if isinstance(config, HierarchicalConfig) else 1
