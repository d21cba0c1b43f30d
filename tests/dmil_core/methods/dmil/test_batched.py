"""The batched gradients of several tasks against the loop over them: in all variants, with ragged and empty sets."""

import pytest
import torch

from dmil_core.losses import Steps
from dmil_core.methods.dmil.batched import Levels, task_gradients
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.meta_gradient import task_gradient
from dmil_core.networks import Parameters, flatten

LENGTHS = [
    ([12, 1, 9], [3, 19], [1, 1, 16, 5], [11, 7]),
    ([5], [30, 4], [2, 2], [1]),
    ([8, 8], [8, 8], [8, 8], [8, 8]),
]
"""Of the trajectories in τ1 to τ4 of three tasks."""
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}


def assert_equal(make_steps, parameters: Parameters, config: DmilConfig, dtype=torch.float64, **options) -> None:
    tasks = [
        tuple(make_steps(4 * task + index, of, dtype) for index, of in enumerate(sets))
        for task, sets in enumerate(LENGTHS)
    ]
    got = task_gradients(parameters, tasks, config, **options)
    wanted = [task_gradient(parameters, one, two, three, four, config, **options) for one, two, three, four in tasks]
    for one, other in zip(got, wanted, strict=True):
        assert one.gradient.dtype == dtype
        assert float((one.gradient - other.gradient).norm() / other.gradient.norm()) <= TOLERANCE[dtype]
        assert one.metrics == pytest.approx(other.metrics, rel=1e-5, abs=1e-6)  # shares have float32


def settings(sub_skills: int, **changes) -> DmilConfig:
    return DmilConfig(**{"sub_skills": sub_skills, "inner_learning_rate": 0.05, "continuity_weight": 0.5, **changes})


@pytest.mark.parametrize(
    ("sub_skills", "dtype"),
    [*((k, torch.float64) for k in range(1, 11)), *((k, torch.float32) for k in (1, 3, 6, 10))],
    ids=str,
)
@pytest.mark.parametrize("order", ["first", "second"])
def test_equals_the_loop(make_parameters, make_steps, sub_skills, order, dtype) -> None:
    assert_equal(
        make_steps, make_parameters(sub_skills, sub_skills, dtype=dtype), settings(sub_skills, order=order), dtype
    )


@pytest.mark.parametrize("order", ["first", "second"])
@pytest.mark.parametrize(
    "variant",
    [
        *({"adapted": adapted, "em": em} for adapted in ("both", "high", "low") for em in ("hard", "soft")),
        {"em": "reference_soft", "continuity": "reference"},
        {"balance": "sinkhorn"},
        {"continuity_weight": 0.0, "inner_steps": 1},
    ],
    ids=str,
)
def test_every_variant_equals_the_loop(make_parameters, make_steps, variant, order) -> None:
    config = settings(3, order=order, posterior_deviation=1.5, **{"inner_steps": 2, **variant})
    assert_equal(make_steps, make_parameters(0, 3), config)
    assert_equal(make_steps, make_parameters(0, 3), config, on_labels=True)


@pytest.mark.parametrize("order", ["first", "second"])
def test_a_sub_skill_without_states_learns_nothing(make_parameters, make_steps, order) -> None:
    parameters = dict(make_parameters(0, 4))
    parameters["high.2.bias"] = torch.tensor([9.0, -9.0, -9.0, -9.0], dtype=torch.float64)
    assert_equal(make_steps, parameters, settings(4, order=order))
    steps: Steps = make_steps(0, [6, 5])
    (gradient, _), *_ = task_gradients(parameters, [(steps,) * 4] * 2, settings(4, order=order))
    size = sum(tensor[0].numel() for name, tensor in parameters.items() if name.startswith("low"))
    assert int((gradient != 0).sum()) <= flatten(parameters).numel() - 3 * size


def test_the_parameters_stay_as_they_are(make_parameters, make_steps) -> None:
    parameters = make_parameters(0, 3)
    before = flatten(parameters).clone()
    assert_equal(make_steps, parameters, settings(3, order="first"))
    assert torch.equal(flatten(parameters), before)
    assert torch.equal(Levels.of(parameters, 2).flat(2, parameters), before.expand(2, -1))
