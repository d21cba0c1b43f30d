"""Settings: frozen, checked, equal to the paper's where they say so."""

import json

import pytest
from pydantic import ValidationError

from dmil_core.configs import (
    PRESETS,
    DemonstrationConfig,
    EvaluationConfig,
    ExperimentConfig,
    SuiteConfig,
    TrainingConfig,
)
from dmil_core.methods.dmil.config import DmilConfig

NAN, INF = float("nan"), float("inf")


def test_the_paper_preset_follows_the_paper() -> None:
    paper = PRESETS["ml10-paper"]
    table_9 = {
        "inner_learning_rate": 5e-4,
        "inner_steps": 3,
        "trajectories": 16,
        "continuity_weight": 0.1,
    }
    networks = {"hidden_layers": 4, "hidden_units": 512, "sub_skills": 3, "order": "second"}
    settings = paper.method.model_dump()
    assert {name: settings[name] for name in table_9 | networks} == table_9 | networks
    assert paper.training.learning_rate == 1e-4
    assert (paper.evaluation.shots, paper.evaluation.episodes) == ((1, 3), 20)


def test_quick_balances_labels_where_points_are_declared() -> None:
    balanced = {name for name, preset in PRESETS.items() if preset.method.model_dump()["balance"] == "sinkhorn"}
    assert balanced == {"ml10-quick", "ml45-quick", "push-around-wall-quick"}


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_presets_survive_json(preset: ExperimentConfig) -> None:
    assert ExperimentConfig.model_validate_json(preset.model_dump_json()) == preset
    assert ExperimentConfig.model_validate(json.loads(preset.model_dump_json())) == preset


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_presets_leave_enough_demonstrations_for_four_disjoint_sets(preset: ExperimentConfig) -> None:
    demonstrations = preset.demonstrations
    assert demonstrations.per_task - demonstrations.held_out >= 4 * preset.method.model_dump()["trajectories"]


@pytest.mark.parametrize(
    ("config", "field", "value"),
    [
        (SuiteConfig, "name", ""),
        (SuiteConfig, "name", "ml10/../x"),
        (SuiteConfig, "protocol", "own"),
        (SuiteConfig, "horizon", 0),
        (DemonstrationConfig, "per_task", 0),
        (DemonstrationConfig, "held_out", 0),
        (DemonstrationConfig, "noise", -0.1),
        (DemonstrationConfig, "trailing_steps", -1),
        (DmilConfig, "sub_skills", 0),
        (DmilConfig, "inner_learning_rate", 0),
        (DmilConfig, "inner_learning_rate", NAN),
        (DmilConfig, "inner_steps", 0),
        (DmilConfig, "inner_steps", 1.5),
        (DmilConfig, "continuity_weight", -1),
        (DmilConfig, "continuity_weight", INF),
        (DmilConfig, "order", "third"),
        (DmilConfig, "window", 0),
        (TrainingConfig, "iterations", -1),
        (TrainingConfig, "slots_per_group", 0),
        (TrainingConfig, "learning_rate", INF),
        (TrainingConfig, "gradient_clip", 0),
        (EvaluationConfig, "shots", (1, 0)),
        (EvaluationConfig, "episodes", 0),
        (EvaluationConfig, "fine_tuning_steps", -1),
        (EvaluationConfig, "every", 0),
        (ExperimentConfig, "method", {"sub_skils": 3}),
        (ExperimentConfig, "seed", 2**63),
        (DmilConfig, "hidden_units", 10**6),
        (DemonstrationConfig, "per_task", 10**9),
        (EvaluationConfig, "shots", (1,) * 101),
        (TrainingConfig, "iterations", 10**10),
    ],
)
def test_impossible_settings_are_refused_by_name(config: type, field: str, value: object) -> None:
    with pytest.raises(ValidationError, match=field):
        config(**{field: value})


@pytest.mark.parametrize(
    "config", [SuiteConfig, DemonstrationConfig, DmilConfig, TrainingConfig, EvaluationConfig, ExperimentConfig]
)
def test_settings_are_frozen_and_know_their_names(config: type) -> None:
    settings, field = config(), next(iter(config.model_fields))
    with pytest.raises(ValidationError, match="frozen"):
        setattr(settings, field, getattr(settings, field))
    with pytest.raises(ValidationError, match="extra_forbidden"):
        config(no_such_setting=1)


@pytest.mark.parametrize(("per_task", "held_out", "allowed"), [(10, 9, True), (10, 10, False), (10, 11, False)])
def test_some_demonstrations_are_left_for_training(per_task: int, held_out: int, allowed: bool) -> None:
    if allowed:
        assert DemonstrationConfig(per_task=per_task, held_out=held_out).held_out == held_out
    else:
        with pytest.raises(ValidationError, match=f"held_out: got {held_out} of per_task {per_task}"):
            DemonstrationConfig(per_task=per_task, held_out=held_out)


@pytest.mark.parametrize(("every", "allowed"), [(None, True), (4, True), (12, True), (6, False), (2, False)])
def test_only_checkpoints_are_evaluated(every: int | None, allowed: bool) -> None:
    settings = {"training": TrainingConfig(checkpoint_every=4), "evaluation": EvaluationConfig(every=every)}
    if allowed:
        assert ExperimentConfig(**settings).evaluation.every == every
    else:
        with pytest.raises(ValidationError, match=f"evaluation.every: got {every}; wanted a multiple of .*every, 4"):
            ExperimentConfig(**settings)


@pytest.mark.parametrize(("held_out", "allowed"), [(20, True), (19, False)])
def test_support_sets_are_disjoint(held_out: int, allowed: bool) -> None:
    settings = {
        "demonstrations": DemonstrationConfig(held_out=held_out),
        "evaluation": EvaluationConfig(shots=(1, 5), support_draws=4),
    }
    if allowed:
        assert ExperimentConfig(**settings).demonstrations.held_out == held_out
    else:
        with pytest.raises(ValidationError, match=r"demonstrations\.held_out: got 19; wanted at least 20"):
            ExperimentConfig(**settings)


@pytest.mark.parametrize(("shots", "allowed"), [(3, True), (4, False)])
def test_mil_is_not_asked_to_adapt_to_more_than_it_has_room_for(shots: int, allowed: bool) -> None:
    def adapting(method: str, room: dict[str, int]) -> ExperimentConfig:
        evaluation = EvaluationConfig(shots=(1, shots))
        return ExperimentConfig.model_validate({"method": {"name": method, **room}, "evaluation": evaluation})

    assert adapting("mil", {"shots": 4}).evaluation.shots == (1, shots)
    assert adapting("dmil", {}).evaluation.shots == (1, shots)
    if allowed:
        assert adapting("mil", {}).evaluation.shots == (1, 3)
    else:
        with pytest.raises(ValidationError, match=r"evaluation\.shots: got 4; wanted at most method\.shots, 3"):
            adapting("mil", {})
