import shlex
from typing import Any

import pytest

from dmil_core.configs import ExperimentConfig, preset_of
from services import meta_train
from services.cli.arguments import parse, peek
from services.cli.composition import EARLY, checked, defaults_from
from services.reporting.settings import flags, nearest_preset


def changed(config: ExperimentConfig, **sections: Any) -> ExperimentConfig:
    settings = config.model_dump()
    for section, values in sections.items():
        settings[section] = settings[section] | values if isinstance(values, dict) else values
    return checked(settings)


def test_the_nearest_preset_is_that_with_the_fewest_differences():
    for size in ("paper", "quick", "smoke"):
        found = nearest_preset(preset_of("kitchen-kettle", size, "mil"))
        assert (found.size, found.differing) == (size, {})
    config = changed(preset_of("ml10", "quick"), seed=3, training={"iterations": 7})
    assert nearest_preset(config)[::2] == ("quick", {"seed": 3, "training.iterations": 7})


@pytest.mark.parametrize(
    "config",
    [
        preset_of("ml45", "paper"),
        changed(
            preset_of("ml10", "quick"),
            seed=7,
            suite={"goal_visible": False, "train_tasks": ("reach", "push"), "horizon": 200},
            demonstrations={"source": "npz:some file.npz", "longest": "reference", "noise": 1e-05},
            method={"standardise": False, "sub_skills": 5},
            training={"gradient_clip": None},
            evaluation={"shots": (1, 3, 5), "support_draws": 2, "every": 500},
        ),
        changed(preset_of("kitchen", "smoke", "pemirl"), suite={"train_tasks": None}, evaluation={"shots": (2,)}),
    ],
    ids=["a preset", "every kind of value", "another method"],
)
def test_the_flags_give_the_settings_again(config: ExperimentConfig):
    found = nearest_preset(config)
    arguments = ["--suite", config.suite.name, "--preset", found.size, "--method", config.method.name]
    arguments += shlex.split(flags(found.differing))
    given = parse(meta_train.Arguments, "", arguments, meta_train.Arguments(defaults_from(peek(arguments, **EARLY))))
    assert given.experiment == config
