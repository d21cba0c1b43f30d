"""What all settings are made of: counts, rates and seeds within their bounds, and the base of a method's own."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

Count = Annotated[int, Field(ge=1, le=10**9)]
Size = Annotated[int, Field(ge=1, le=10_000)]
"""A count of what is held in memory together."""
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, lt=1)]


class Settings(BaseModel):
    """Base of all settings: unknown keys are refused, nothing changes once made."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class MethodConfig(Settings):
    """Base of a method's own settings."""

    name: Any
    """The method."""
    standardise: bool = True
    """Standardise observations by the statistics of the meta-training demonstrations."""

    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """By size, paper, quick or smoke: what the method wants in place of the size's settings, by section."""
    bound_of_shots: ClassVar[str | None] = None
    """The setting that says to how many demonstrations the method can adapt, if there is such a bound."""


class HierarchicalConfig(MethodConfig):
    """Base of the settings of a method with sub-skills."""

    sub_skills: Size = 3
    """K, the number of sub-skills (Table 4)."""


def sub_skills_of(config: MethodConfig) -> int:
    """Return K, which is 1 for a method without sub-skills."""
    return config.sub_skills if isinstance(config, HierarchicalConfig) else 1
