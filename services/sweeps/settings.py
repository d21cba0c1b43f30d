"""What a sweep is: its grid, its seeds and suites, its budgets, as ``tune_configs/*.yaml`` have it."""

import itertools
import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AliasChoices, Field, model_validator

from dmil_core.configs import EvaluationConfig, ExperimentConfig, SuiteConfig, SuiteName, preset_of
from dmil_core.errors import UserError
from dmil_core.seeding import named_rng
from dmil_core.settings import Count, Flag, GradientPath, Seed, Settings
from services.cli.composition import checked, method_named
from services.cli.yaml_files import merged
from services.evaluation.results import Metric
from services.suites.base import Split
from services.suites.registry import open_suite

if TYPE_CHECKING:
    from dmil_core.devices import Compute

Name = Annotated[str, Field(min_length=1, max_length=60)]
Overrides = dict[str, Any]
"""Settings of an experiment by section, as in a file of ``--config``."""
Preset = Literal["smoke", "quick", "paper"]


class Resources(Settings):
    """What one trial takes of the cluster, all at once or not at all."""

    workers: Annotated[int, Field(ge=1, le=1000, strict=True)] = 1
    """CPUs, with an adaptation worker and then a simulation worker on each."""
    gpus: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False, strict=True)] = 0.0
    """GPUs of each worker, up to 1: as many workers share one."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """What computes: auto takes the GPU that a worker has, else the CPU."""
    path: GradientPath = "auto"
    """How a group's gradients are computed: loop, batched, or auto, which is batched on a GPU."""

    @property
    def compute(self) -> "Compute":
        """What computes."""
        from dmil_core.devices import Compute

        return Compute(self.device, self.path)

    @model_validator(mode="after")
    def _has_what_it_computes_on(self) -> "Resources":
        if self.device == "cuda" and not self.gpus:
            raise ValueError(f"resources.gpus: got {self.gpus} with device cuda; wanted above 0, for each worker")
        return self


class Budget(Settings):
    """What a sweep changes at one preset."""

    suites: tuple[SuiteName, ...] | None = None
    """In place of the sweep's."""
    seeds: tuple[Seed, ...] | None = None
    """In place of the sweep's."""
    samples: Count | None = None
    """In place of the search's."""
    settings: Overrides = Field(default_factory=dict)
    """Beside the sweep's."""
    variants: dict[Name, Overrides] = Field(default_factory=dict)
    """Settings of some variants, beside their own."""


class Range(Settings):
    """Numbers to draw from, evenly, or evenly by their logarithms."""

    low: Annotated[float, Field(strict=True)]
    high: Annotated[float, Field(strict=True)]
    log: Flag = False

    @model_validator(mode="after")
    def _in_order(self) -> "Range":
        if not (self.low < self.high and math.isfinite(self.high)) or (self.log and self.low <= 0):
            raise ValueError(f"got low {self.low}, high {self.high}; wanted low < high, and above 0 if log")
        return self

    def draw(self, draw: np.random.Generator) -> float:
        """Draw a number, to four digits."""
        if self.log:
            return float(f"{math.exp(draw.uniform(math.log(self.low), math.log(self.high))):.4g}")
        return float(f"{draw.uniform(self.low, self.high):.4g}")


class Search(Settings):
    """A free search: samples of a space, the worse ones stopped early (ASHA; Li et al. 2020)."""

    space: Annotated[dict[str, Range | Annotated[tuple[Any, ...], Field(min_length=1)]], Field(min_length=1)]
    """By setting, as ``method.sub_skills``: a range, or values to choose from."""
    samples: Count
    seed: Seed = 0
    """Of the samples."""
    reduction: Annotated[int, Field(ge=2, strict=True)] = 3
    """Of so many trials that come as far as an evaluation on the way, one goes on."""

    def variants(self) -> dict[str, Overrides]:
        """Draw the samples."""
        variants = {}
        for number in range(self.samples):
            settings: Overrides = {}
            for path, values in self.space.items():
                draw = named_rng(self.seed, "search", number, path)
                value = values.draw(draw) if isinstance(values, Range) else values[int(draw.integers(len(values)))]
                section, _, setting = path.partition(".")
                settings.setdefault(section, {})[setting] = value
            variants[f"sample {number}"] = settings
        return variants


class Sweep(Settings):
    """A sweep, one file in ``tune_configs``."""

    what: Annotated[str, Field(min_length=1, max_length=100)]
    """In one line."""
    paper: Literal["table4", "table5", "table6", "table7", "table8"] | None = None
    """The paper's table with the same rows."""
    suites: Annotated[tuple[SuiteName, ...], Field(min_length=1)]
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1)]
    variants: dict[Name, Overrides] = Field(default_factory=dict)
    """The grid: what each is called in the table, and its settings."""
    evaluations: Annotated[dict[Name, Overrides], Field(min_length=1)] | None = None
    """Settings of evaluations that each trained checkpoint is adapted by, in place of the one."""
    search: Search | None = None
    """In place of variants."""
    settings: Overrides = Field(default_factory=dict)
    """Of all trials."""
    shots: Annotated[tuple[Count, ...], Field(min_length=1)] = (1, 3)
    episodes: Count = 20
    """Of each task for each number of shots."""
    metric: Metric = "success_rate"
    """What the table shows, and what a search goes by."""
    baseline: Name | None = None
    """The row that the others are compared with; the first if none is named."""
    rows: Literal["variants", "suites"] = "variants"
    """What the table has in its rows; the others are in its columns."""
    splits: tuple[Split, ...] = ("meta-training", "meta-testing")
    """What the trials are evaluated on, and the table shows."""
    resources: Resources = Resources()
    presets: dict[Preset, Budget] = Field(default_factory=dict, validation_alias=AliasChoices("presets", "scales"))
    """The budget at each preset that has one of its own; older files call them scales."""

    @model_validator(mode="after")
    def _one_kind(self) -> "Sweep":
        if bool(self.variants) == bool(self.search):
            raise ValueError("variants, search: got both or neither; wanted one of them")
        for preset, budget in self.presets.items():
            if unknown := sorted(set(budget.variants) - set(self.variants)):
                raise ValueError(f"presets.{preset}.variants: got {unknown[0]!r}; wanted of {', '.join(self.variants)}")
        if self.baseline is not None and self.baseline not in self.row_names:
            raise ValueError(f"baseline: got {self.baseline!r}; wanted one of {', '.join(self.row_names)}")
        return self

    def at(self, preset: Preset, suites: Sequence[str] = (), seeds: Sequence[int] = ()) -> "Sweep":
        """Return the sweep as it is at one preset, with other suites and seeds if they are given.

        Raises:
            ValidationError: for a name that no suite can have, or a seed that is none.
        """
        budget = self.presets.get(preset, Budget())
        changes: dict[str, Any] = {
            "variants": {name: _laid_over(of, budget.variants.get(name, {})) for name, of in self.variants.items()},
            "suites": tuple(suites) or budget.suites or self.suites,
            "seeds": tuple(seeds) or budget.seeds or self.seeds,
            "settings": _laid_over(self.settings, budget.settings),
            "presets": {},
        }
        if self.search is not None:
            changes["search"] = {**self.search.model_dump(), "samples": budget.samples or self.search.samples}
        return Sweep.model_validate({**self.model_dump(), **changes})

    @property
    def row_names(self) -> list[str]:
        """What is compared: variants, evaluations, or each with each."""
        variants = list(self.variants or (self.search.variants() if self.search else {}))
        if self.evaluations is None:
            return variants
        return [row_name(variants, variant, evaluation) for variant in variants for evaluation in self.evaluations]


def _laid_over(settings: Overrides, others: Overrides) -> Overrides:
    """Return some settings with others over them, section by section."""
    return {section: {**settings.get(section, {}), **others.get(section, {})} for section in (*settings, *others)}


def row_name(variants: list[str], variant: str, evaluation: str | None) -> str:
    """Name a row of the table: where there is but one variant, by the evaluation alone."""
    if evaluation is None:
        return variant
    return evaluation if len(variants) == 1 else f"{variant}, {evaluation}"


class PlannedTrial(Settings):
    """One configuration to train, and how to adapt and judge it."""

    name: str
    """Of its folder."""
    variant: str
    suite: str
    seed: int
    config: ExperimentConfig
    evaluations: dict[str, EvaluationConfig]
    """By the table's row."""


def planned(sweep: Sweep, preset: Preset) -> list[PlannedTrial]:
    """Return the trials of a sweep, which is as it is at this preset.

    Raises:
        UserError: for a suite or for settings that there are not; names where these come from.
    """
    variants = sweep.search.variants() if sweep.search else sweep.variants
    evaluation: Overrides = {"shots": list(sweep.shots)} | ({} if preset == "smoke" else {"episodes": sweep.episodes})
    layers = {"shots, episodes": {"evaluation": evaluation}, "settings": sweep.settings}
    trials = []
    for suite, (variant, of_variant), seed in itertools.product(sweep.suites, variants.items(), sweep.seeds):
        method = method_named(of_variant if "name" in of_variant.get("method", {}) else sweep.settings)
        settings = preset_of(suite, preset, method).model_dump()
        for origin, overrides in {**layers, f"variants.{variant}": of_variant, "seeds": {"seed": seed}}.items():
            settings = merged(settings, overrides, origin)
        config = checked(settings, f"{variant} on {suite}: ")
        evaluations = {
            row_name(list(variants), variant, name): checked(
                merged(settings, {"evaluation": changes}, f"evaluations.{name}"), f"evaluations.{name}: "
            ).evaluation
            for name, changes in (sweep.evaluations or {None: {}}).items()
        }
        name = re.sub(r"[^\w.=-]+", "-", f"{suite}-{variant}-seed-{seed}")
        trials.append(
            PlannedTrial(name=name, variant=variant, suite=suite, seed=seed, config=config, evaluations=evaluations)
        )
    if len({trial.name for trial in trials}) < len(trials):
        raise UserError(f"variants: got {', '.join(variants)}; wanted names that differ in letters or digits")
    if sweep.search:
        for suite in {trial.config.suite for trial in trials}:
            _only_training_tasks(suite)
        if any(trial.config.evaluation.every is None for trial in trials):
            raise UserError("settings.evaluation.every: got none; wanted iterations between what a search goes by")
    return trials


def _only_training_tasks(suite: SuiteConfig) -> None:
    """Refuse a search that would choose by tasks of meta-testing."""
    whole = open_suite(suite.model_copy(update={"train_tasks": None, "test_tasks": None}))
    held_out = suite.test_tasks or whole.test_tasks
    if wrong := set(held_out) - set(whole.train_tasks):
        raise UserError(
            f"settings.suite.test_tasks: got {', '.join(sorted(wrong))}; wanted some of {suite.name}'s own "
            "meta-training tasks, held out: a search must not look at meta-testing tasks"
        )
    if both := set(held_out) & set(suite.train_tasks or whole.train_tasks):
        raise UserError(f"settings.suite.train_tasks: got {', '.join(sorted(both))}; wanted those not in test_tasks")
