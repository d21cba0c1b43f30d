"""What a sweep's file says: those of the project at every preset, and mistakes in one of a user's own."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from dmil_core.configs import EvaluationConfig, preset_of
from dmil_core.errors import UserError
from services.sweeps.folders import SweepFolder, evaluated, trained
from services.sweeps.settings import Range, Sweep, planned
from services.tune_sweep import CONFIGS
from tests.services.sweeps.made_up import better, make

NAMES = [
    "bilevel",
    "continuity",
    "em",
    "finetune_steps",
    "hierarchy",
    "kitchen_k",
    "methods",
    "negatives",
    "search",
    "sub_skills",
]
SMALL = {"what": "a test", "suites": ["ml10"], "seeds": [0], "variants": {"one": {}}}


def sweep_of(name: str) -> Sweep:
    return Sweep.model_validate(yaml.safe_load((CONFIGS / f"{name}.yaml").read_text()))


def small(**changes: object) -> Sweep:
    return Sweep.model_validate({**SMALL, **changes})


def test_the_project_has_its_sweeps() -> None:
    assert sorted(file.stem for file in CONFIGS.glob("*.yaml")) == NAMES


@pytest.mark.parametrize("preset", ["smoke", "quick", "paper"])
@pytest.mark.parametrize("name", NAMES)
def test_each_sweep_has_trials_at_every_preset(name: str, preset) -> None:
    sweep = sweep_of(name).at(preset)
    trials = planned(sweep, preset)
    assert len(trials) == len(sweep.suites) * len(sweep.seeds) * len(
        sweep.search.variants() if sweep.search else sweep.variants
    )
    assert len({trial.name for trial in trials}) == len(trials)
    assert [row for trial in trials[: len(sweep.row_names)] for row in trial.evaluations]
    assert {row for trial in trials for row in trial.evaluations} == set(sweep.row_names)


def test_rows_are_what_the_paper_varies() -> None:
    trials = {name: planned(sweep_of(name).at("paper"), "paper") for name in NAMES}
    methods = {name: {trial.variant: trial.config.method.model_dump() for trial in trials[name]} for name in NAMES}
    assert {row: method.get("adapted") for row, method in methods["bilevel"].items()} == {
        "DMIL": "both", "DMIL-High": "high", "DMIL-Low": "low", "OptionGAIL": None,
    }  # fmt: skip
    assert {method["sub_skills"] for method in methods["bilevel"].values()} == {3}
    assert {row: method["em"] for row, method in methods["em"].items()} == {"DMIL": "hard", "DMIL_soft": "soft"}
    weights = {row: method["continuity_weight"] for row, method in methods["continuity"].items()}
    assert weights == {"DMIL_nc": 0.0, "λ = 0.01": 0.01, "DMIL": 0.1, "λ = 1": 1.0}
    assert {method["sub_skills"] for method in methods["continuity"].values()} == {10}
    assert [method["sub_skills"] for method in methods["sub_skills"].values()] == [2, 3, 5, 8, 10]
    assert [method["sub_skills"] for method in methods["kitchen_k"].values()] == [2, 4, 8]
    steps = {row: own.fine_tuning_steps for row, own in trials["finetune_steps"][0].evaluations.items()}
    assert steps == {row: int(row) for row in ("10", "30", "50", "100", "300", "500")}
    assert {own.learning_rate for own in trials["finetune_steps"][0].evaluations.values()} == {0.01}
    assert trials["bilevel"][0].config.model_copy(update={"seed": 0}) == preset_of("ml10", "paper")


def test_what_two_sweeps_train_is_one_folder(tmp_path: Path) -> None:
    def folders(name: str, row: str) -> set[Path]:
        trials = planned(sweep_of(name).at("quick"), "quick")
        return {trained(tmp_path, trial.config, {"reach": "a"}) for trial in trials if trial.variant == row}

    assert folders("bilevel", "DMIL") == folders("sub_skills", "K=3")
    assert folders("em", "DMIL") == folders("sub_skills", "K=5") == folders("finetune_steps", "DMIL")
    assert folders("continuity", "DMIL_nc") == folders("sub_skills", "K=10")
    assert len(folders("em", "DMIL")) == 3
    assert not folders("em", "DMIL") & folders("em", "DMIL_soft")


def test_a_trained_configuration_is_known_by_all_that_trained_it(tmp_path: Path) -> None:
    config = preset_of("ml10", "quick")
    home = trained(tmp_path, config, {"reach": "a", "push": "b"})
    assert home == trained(tmp_path, config, {"push": "b", "reach": "a"})
    evaluated_otherwise = config.model_copy(update={"evaluation": EvaluationConfig()})
    assert home == trained(tmp_path, evaluated_otherwise, {"push": "b", "reach": "a"})
    changes = [
        config.model_copy(update={"seed": 1}),
        config.model_copy(update={"method": config.method.model_copy(update={"em": "soft"})}),
        config.model_copy(update={"training": config.training.model_copy(update={"iterations": 1})}),
    ]
    others = {trained(tmp_path, other, {"reach": "a", "push": "b"}) for other in changes}
    others |= {trained(tmp_path, config, {"reach": "a", "push": "c"}), trained(tmp_path, config, {"reach": "a"})}
    assert len(others | {home}) == 6
    evaluation = config.evaluation
    once = evaluated(home, evaluation, ["reach", "push"])
    assert once == evaluated(home, evaluation.model_copy(update={"every": 500}), ["reach", "push"])
    assert once != evaluated(home, evaluation.model_copy(update={"fine_tuning_steps": 51}), ["reach", "push"])
    assert once != evaluated(home, evaluation, ["push"])


def test_records_of_sweeps_that_called_a_preset_a_size_open(tmp_path: Path) -> None:
    sweep = make(tmp_path, better)
    text = (sweep.path / "sweep.json").read_text()
    assert text.count('"preset": ') == text.count('"presets": ') == 1
    (sweep.path / "sweep.json").write_text(text.replace('"preset": ', '"size": ').replace('"presets": ', '"scales": '))
    assert SweepFolder(sweep.path).record == sweep.record


def test_a_preset_has_its_own_budget() -> None:
    budgets = {"quick": {"suites": ["ml45"], "seeds": [3], "settings": {"training": {"iterations": 7}}}}
    sweep = small(presets=budgets, settings={"training": {"tasks_per_iteration": 2}, "method": {"sub_skills": 4}})
    (trial,) = planned(sweep.at("quick"), "quick")
    assert (trial.suite, trial.seed, trial.config.seed) == ("ml45", 3, 3)
    assert (trial.config.training.iterations, trial.config.training.tasks_per_iteration) == (7, 2)
    assert trial.config.method.model_dump()["sub_skills"] == 4
    own = {"quick": {"variants": {"one": {"method": {"sub_skills": 9}}}}}
    (trial,) = planned(small(scales=own, variants={"one": {"method": {"em": "soft"}}}).at("quick"), "quick")
    assert (trial.config.method.model_dump()["sub_skills"], trial.config.method.model_dump()["em"]) == (9, "soft")
    trials = planned(sweep.at("quick", ["ml10"], [5, 6]), "quick")
    assert [(trial.suite, trial.seed) for trial in trials] == [("ml10", 5), ("ml10", 6)]
    assert planned(sweep.at("paper"), "paper")[0].config.training.iterations == 2000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"variants": {"one": {"method": {"sub_skill": 3}}}}, "variants.one: got the unknown key method.sub_skill"),
        ({"settings": {"training": {"iterations": -1}}}, "one on ml10: training.iterations: got -1"),
        ({"variants": {"a b": {}, "a/b": {}}}, "variants: got a b, a/b; wanted names that differ"),
        ({"evaluations": {"a": {"steps": 3}}}, "evaluations.a: got the unknown key evaluation.steps"),
        ({"evaluations": {"a": {"shots": [9]}}}, "evaluations.a: .*held_out: got 30; wanted at least 90"),
    ],
)
def test_a_setting_that_there_is_not_is_named_with_its_place(changes: dict, message: str) -> None:
    with pytest.raises((UserError, ValidationError), match=message):
        planned(small(**changes).at("quick"), "quick")


@pytest.mark.parametrize(
    "changes",
    [
        {"variants": {}},
        {"search": {"space": {"method.sub_skills": [1]}, "samples": 1}},
        {"baseline": "two"},
        {"seeds": []},
        {"presets": {"quick": {"variants": {"two": {}}}}},
        {"suites": ["no suite"]},
        {"colour": "red"},
        {"resources": {"workers": 0}},
        {"variants": {}, "search": {"space": {"method.sub_skills": {"low": 3, "high": 2}}, "samples": 1}},
        {"variants": {}, "search": {"space": {"method.alpha": {"low": 0, "high": 2, "log": True}}, "samples": 1}},
    ],
    ids=str,
)
def test_a_sweep_that_is_none_is_refused(changes: dict) -> None:
    with pytest.raises(ValidationError):
        small(**changes)


def search(**suite: list[str]) -> Sweep:
    settings = {"suite": suite, "evaluation": {"every": 500}}
    space = {"method.sub_skills": [1, 2, 3], "method.inner_learning_rate": {"low": 1e-4, "high": 1e-1, "log": True}}
    return small(variants={}, search={"space": space, "samples": 200}, settings=settings)


def test_samples_fill_the_space_and_are_the_same_every_time() -> None:
    sweep = search(train_tasks=["reach"], test_tasks=["push"])
    assert sweep.search is not None
    samples = list(sweep.search.variants().values())
    assert samples == list(sweep.search.variants().values())
    assert [{"method"}] * 200 == [set(sample) for sample in samples]
    counts = [sum(sample["method"]["sub_skills"] == k for sample in samples) for k in (1, 2, 3)]
    assert min(counts) > 40
    rates = [sample["method"]["inner_learning_rate"] for sample in samples]
    assert all(1e-4 <= rate <= 1e-1 for rate in rates)
    decades = [sum(low <= rate < 10 * low for rate in rates) for low in (1e-4, 1e-3, 1e-2)]
    assert min(decades) > 40
    assert len(set(rates)) > 190


@pytest.mark.parametrize("log", [True, False])
def test_a_range_is_kept(log: bool) -> None:
    drawn = [Range(low=2.0, high=3.0, log=log).draw(np.random.default_rng(seed)) for seed in range(100)]
    assert all(2 <= value <= 3 for value in drawn)
    assert len(set(drawn)) > 90


@pytest.mark.parametrize(
    ("suite", "message"),
    [
        ({}, "wanted some of ml10's own meta-training tasks, held out"),
        ({"test_tasks": ["door-close"], "train_tasks": ["reach"]}, "got door-close; wanted some of ml10's own"),
        ({"test_tasks": ["reach"]}, "train_tasks: got reach; wanted those not in test_tasks"),
    ],
)
def test_a_search_must_not_look_at_meta_testing_tasks(suite: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        planned(search(**suite).at("quick"), "quick")
    assert planned(search(train_tasks=["push"], test_tasks=["reach"]).at("quick"), "quick")
