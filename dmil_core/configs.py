"""Settings of an experiment: frozen, checked, and each with the place in the paper that it comes from."""

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, SerializeAsAny, model_validator

from dmil_core.methods.configs import config_type
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.points import Points
from dmil_core.settings import (
    AnyCount,
    ContextConfig,
    Count,
    FineTuning,
    Flag,
    MethodConfig,
    NotNegative,
    Optimiser,
    Positive,
    Seed,
    Settings,
    Size,
    without_doubles,
)

SuiteName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9-]*$")]
DEFAULT_METHOD = "dmil"


class SuiteConfig(Settings):
    """Which tasks there are, and when an episode counts as a success."""

    name: SuiteName = "ml10"
    """ml10 and ml45: Meta-World's own splits; ml10-reference: the one of the authors' released code; ML1-reach and the
    like: one task; push-around-wall: the paper's new task after ml10's meta-training tasks (Figure 8);
    kitchen-topburner, -microwave, -kettle and -slide: the Franka kitchen without that sub-task in meta-training
    (Table 5); or what an installed package brings."""
    protocol: Literal["paper", "benchmark"] = "paper"
    """Steps in an episode of Meta-World: 300, or 500 as in its own evaluation. In both it is a success if the task is
    solved at any of them."""
    goal_visible: Flag = True
    """Whether a policy sees where the goal is; Meta-World's own meta-learning benchmarks hide it."""
    start_noise: NotNegative = 1.0
    """Spread of the initial states of a kitchen's episodes: 1 is that of its real demonstrations."""
    horizon: Size | None = None
    """Steps in an episode, in place of the suite's."""
    points: Points | None = None
    """Which numbers of an observation are positions, in place of what the suite declares; of use for methods that work
    with differences of them."""
    train_tasks: Annotated[tuple[str, ...], Field(min_length=1), AfterValidator(without_doubles)] | None = None
    """Use these meta-training tasks instead of all of the suite's."""
    test_tasks: Annotated[tuple[str, ...], Field(min_length=1), AfterValidator(without_doubles)] | None = None
    """Use these meta-testing tasks instead of all of the suite's."""


REFERENCE_LIMIT = 100
REFERENCE_LIMITS = {"peg-unplug-side": 140, "bin-picking": 160}
"""Most steps of a demonstration in the authors' released code, and the tasks that have more."""


class DemonstrationConfig(Settings):
    """Where demonstrations come from, and how the scripted experts make them."""

    source: str = "expert"
    """Source of the demonstrations: expert (the suite's scripted experts), or minari:ID,ID, npz:PATH,PATH or
    hdf5:PATH,PATH, each the data set of one task, which is named as TASK=ID or else by the ID's last part."""
    per_task: Size = 100
    """Demonstrations of each task, training and held-out ones together; another source may have fewer."""
    held_out: Size = 20
    """Demonstrations of each task that are held out from meta-training, as support sets for evaluation."""
    noise: NotNegative = 0.1
    """Standard deviation of the noise added to the action that the expert's environment executes."""
    labels: Literal["clean", "noisy"] = "clean"
    """Action that is stored: clean is the expert's own, noisy the executed one."""
    trailing_steps: AnyCount = 10
    """Steps recorded after the task is solved."""
    longest: Size | Literal["reference"] | None = None
    """Steps after which an attempt fails; reference: the limits of the authors' released code, 100 for most tasks;
    none: the suite's horizon."""
    seed: Seed = 0
    """Seed of the demonstrations, which do not depend on the experiment's seed."""

    def steps(self, task: str, horizon: int) -> int:
        """Return after how many steps an attempt at `task` is given up."""
        limit = REFERENCE_LIMITS.get(task, REFERENCE_LIMIT) if self.longest == "reference" else self.longest
        return min(horizon, limit or horizon)

    @model_validator(mode="after")
    def _leave_some_for_training(self) -> "DemonstrationConfig":
        if self.held_out >= self.per_task:
            raise ValueError(
                f"held_out: got {self.held_out} of per_task {self.per_task}; wanted fewer, to train on the rest"
            )
        return self


class TrainingConfig(Settings):
    """The outer loop."""

    iterations: AnyCount = 2000
    """Outer steps."""
    tasks_per_iteration: Size = 10
    """Tasks in a batch, sampled without replacement where there are enough."""
    slots_per_group: Size = 1
    """Tasks whose gradients one worker adds; it affects the result, unlike the number of workers."""
    outer_step: Literal["adam", "average"] = "adam"
    """adam takes a step of Adam by the sum of the slots' gradients; average moves to the mean of the slots' parameters,
    for a method whose slots take steps of their own."""
    learning_rate: Positive = 1e-4
    """Outer learning rate β of Adam (Table 9). With outer_step=average: the fraction of the way to the mean of the
    slots' parameters."""
    schedule: Literal["constant", "cosine"] = "constant"
    """cosine lets the learning rate fall to a hundredth over the iterations that are set."""
    gradient_clip: Positive | None = None
    """Clip the outer gradient to this norm."""
    checkpoint_every: Count = 200
    """Iterations between checkpoints."""
    checkpoints_kept: Count = 3
    """Newest checkpoints that are kept, besides the best one."""


Control = Literal["no-adaptation", "other-support", "shuffled-actions", "nearest-neighbour", "tracking"]


class EvaluationConfig(Settings):
    """Few-shot adaptation and its test episodes."""

    shots: Annotated[tuple[Size, ...], Field(min_length=1, max_length=100), AfterValidator(without_doubles)] = (1, 3)
    """Sizes of the support set."""
    episodes: Size = 20
    """Episodes of each task for each size (Table 4)."""
    support_draws: Size = 4
    """Disjoint support sets of each task, over which its episodes are spread."""
    fine_tuning_steps: AnyCount = 50
    """Steps of adaptation to the support set (E.4)."""
    learning_rate: Positive = 1e-2
    """Learning rate of adaptation (E.4)."""
    optimiser: Optimiser = "sgd"
    """sgd takes plain steps on the whole support set, as the inner loop does; adam takes Adam's on batches of 128
    states, at a rate that falls along a cosine, for methods that fine-tune networks."""
    displaced: Annotated[int, Field(ge=0, le=10_000, strict=True)] = 0
    """Copies of the support set with object and goal displaced, to fine-tune on besides; only where a suite declares
    points."""
    controls: tuple[Control, ...] = ()
    """What to lay beside the run on meta-testing tasks, with the same support sets and episodes: no-adaptation (no
    fine-tuning), other-support (another task's demonstrations), shuffled-actions, and nearest-neighbour and tracking,
    which learn nothing."""
    every: Count | None = None
    """Iterations between evaluations, a multiple of checkpoint_every; none evaluates at the end alone."""

    @property
    def fine_tuning(self) -> FineTuning:
        """How to adapt."""
        return FineTuning(self.fine_tuning_steps, self.learning_rate, self.optimiser, self.displaced)


def _method_settings(settings: object) -> object:
    """Return settings of a method as those of the method that they name."""
    if not isinstance(settings, Mapping):
        return settings
    return config_type(settings.get("name", DEFAULT_METHOD)).model_validate(settings)


class ExperimentConfig(Settings):
    """One experiment; with its data it determines every number that comes out."""

    seed: Seed = 0
    """Seed of the initial parameters, the task batches and the episodes."""
    suite: SuiteConfig = SuiteConfig()
    demonstrations: DemonstrationConfig = DemonstrationConfig()
    method: Annotated[SerializeAsAny[MethodConfig], BeforeValidator(_method_settings)] = DmilConfig()
    training: TrainingConfig = TrainingConfig()
    evaluation: EvaluationConfig = EvaluationConfig()

    @model_validator(mode="after")
    def _enough_support(self) -> "ExperimentConfig":
        wanted = max(self.evaluation.shots) * self.evaluation.support_draws
        if self.demonstrations.held_out < wanted:
            raise ValueError(
                f"demonstrations.held_out: got {self.demonstrations.held_out}; wanted at least {wanted}, for "
                f"{self.evaluation.support_draws} disjoint support sets of {max(self.evaluation.shots)}"
            )
        return self

    @model_validator(mode="after")
    def _no_more_shots_than_the_method_takes(self) -> "ExperimentConfig":
        field, shots = self.method.bound_of_shots, max(self.evaluation.shots)
        if field is not None and shots > (most := getattr(self.method, field)):
            raise ValueError(
                f"evaluation.shots: got {shots}; wanted at most method.{field}, {most}, which is what "
                f"{self.method.name} has room for; give fewer, or train with a larger method.{field}"
            )
        return self

    @model_validator(mode="after")
    def _evaluate_checkpoints(self) -> "ExperimentConfig":
        every, checkpoint_every = self.evaluation.every, self.training.checkpoint_every
        if every is not None and every % checkpoint_every:
            raise ValueError(
                f"evaluation.every: got {every}; wanted a multiple of training.checkpoint_every, {checkpoint_every}: "
                "checkpoints are what is evaluated"
            )
        return self


BASE_PRESETS: dict[str, ExperimentConfig] = {
    "paper": ExperimentConfig(),
    "quick": ExperimentConfig(
        training=TrainingConfig(
            iterations=4000, slots_per_group=5, learning_rate=1e-3, gradient_clip=10.0, checkpoint_every=500
        ),
        evaluation=EvaluationConfig(learning_rate=3e-3),
    ),
    "smoke": ExperimentConfig(
        demonstrations=DemonstrationConfig(per_task=12, held_out=4),
        training=TrainingConfig(
            iterations=20, tasks_per_iteration=3, slots_per_group=1, learning_rate=1e-3, checkpoint_every=10
        ),
        evaluation=EvaluationConfig(episodes=2, support_draws=1, fine_tuning_steps=5),
    ),
}
"""Settings of each preset before those of `MethodConfig.presets`.

paper is Table 9 to the letter, quick trains in minutes on two cores, smoke runs everything in a minute."""

SMOKE_TASKS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "ml10": (("reach", "push", "drawer-close"), ("door-close",)),
    "ml45": (("reach", "push", "drawer-close"), ("door-lock",)),
    "push-around-wall": (("reach", "push"), ("push-around-wall",)),
    "kitchen": (("microwave", "light"), ("topburner",)),
    "kitchen-topburner": (("microwave", "light"), ("topburner",)),
    "kitchen-microwave": (("light", "slide"), ("microwave",)),
    "kitchen-kettle": (("microwave", "slide"), ("kettle",)),
    "kitchen-slide": (("microwave", "light"), ("slide",)),
}
"""A few meta-training and meta-testing tasks of each suite, for the preset smoke."""


WITH_POINTS = re.compile(r"ml(10|10-reference|45|1-.*)|push-around-wall", re.IGNORECASE)
"""Suites whose points are declared, object and goal among them."""
WITH_POINTS_QUICK: dict[str, dict[str, Any]] = {
    "demonstrations": {"held_out": 30},
    "evaluation": {"support_draws": 10, "controls": ("no-adaptation", "nearest-neighbour", "tracking")},
    "method": {"features": "relative"},
}
"""What the preset quick has besides for these: which support sets are drawn matters more than most settings."""
CONTEXT_QUICK: dict[str, dict[str, Any]] = {
    "training": {"iterations": 2500, "schedule": "cosine"},
    "evaluation": {"optimiser": "adam", "learning_rate": 1e-3, "fine_tuning_steps": 200, "displaced": 40},
    "method": {"context": "path"},
}
"""And what it has besides for them and for methods with a path network."""


def preset_of(suite: str, preset: str, method: str = DEFAULT_METHOD) -> ExperimentConfig:
    """Return the settings of a preset for a suite and a method.

    Raises:
        KeyError: for an unknown preset.
        UserError: for an unknown method.
    """
    config, method_config = BASE_PRESETS[preset], config_type(method)
    changes: dict[str, dict[str, Any]] = {"method": {"name": method}, "suite": {"name": suite}}
    if preset == "smoke" and suite in SMOKE_TASKS:
        changes["suite"] |= dict(zip(("train_tasks", "test_tasks"), SMOKE_TASKS[suite], strict=True))
    if suite.startswith("kitchen"):
        if "sub_skills" in method_config.model_fields:
            changes["method"]["sub_skills"] = 4  # Table 5's middle column
        if preset == "quick":
            changes["demonstrations"] = {"per_task": 50, "held_out": 12}  # a demonstration takes 1 s
    seeing: list[dict[str, dict[str, Any]]] = []
    if preset == "quick" and WITH_POINTS.fullmatch(suite):
        seeing = [WITH_POINTS_QUICK, *([CONTEXT_QUICK] if issubclass(method_config, ContextConfig) else [])]
        if "balance" in method_config.model_fields:
            changes["method"]["balance"] = "sinkhorn"  # no sub-skill without states, at no loss of success
    settings = config.model_dump(exclude={"method"}) | {"method": {}}
    for changed in (method_config.presets.get(preset, {}), *seeing, changes):
        settings |= {section: settings[section] | values for section, values in changed.items()}
    return ExperimentConfig.model_validate(settings)


PRESETS: dict[str, ExperimentConfig] = {
    f"{suite}-{preset}": preset_of(suite, preset) for suite in SMOKE_TASKS for preset in BASE_PRESETS
}
"""Settings of each preset for each suite of the paper."""
