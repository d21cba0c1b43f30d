"""A model's input, there and back, and mistakes in it."""

import json
from typing import Any

import numpy as np
import pytest

from dmil_core.demonstrations import Demonstration
from dmil_core.errors import UserError
from services.tracking.packing import packed, unpacked

DRAW = np.random.default_rng(0)
ONE, OTHER = (
    Demonstration(str(steps), "t", DRAW.random((steps, 3), np.float32), DRAW.random((steps, 2), np.float32))
    for steps in (4, 2)
)


def test_what_is_packed_comes_back_through_json_to_the_bit():
    given = json.loads(json.dumps(packed([ONE, OTHER], ONE.observations[1])))
    question = unpacked(given | {"memory": [7]}, 3, 2)
    for before, after in zip((ONE, OTHER), question.support, strict=True):
        np.testing.assert_array_equal(after.observations, before.observations)
        np.testing.assert_array_equal(after.actions, before.actions)
    np.testing.assert_array_equal(question.observation, ONE.observations[1])
    assert question.memory is not None
    assert question.memory.tolist() == [7]
    assert unpacked(given, 3, 2).memory is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"support": None}, "support: got None; wanted a list of at least one demonstration"),
        ({"support": []}, "support: got []; wanted a list of at least one demonstration"),
        ({"support": "push"}, "support: got 'push'; wanted a list"),
        ({"support": [[1.0]]}, "support[0]: got list; wanted a demonstration's observations and actions"),
        ({"support": [{"actions": [[1, 2]]}]}, "support[0]: got actions; wanted"),
        (
            {"support": [{"observations": [[1, 2, 3]], "actions": [[1, 2], [1]]}]},
            "support[0].actions: got [[1, 2], [1]]; wanted one row of 2 numbers for each step",
        ),
        (
            {"support": [{"observations": [[1, 2]], "actions": [[1, 2]]}]},
            "support[0].observations: got the shape (1, 2); wanted one row of 3 numbers for each step",
        ),
        ({"support": [{"observations": [[1, 2, 3]] * 2, "actions": [[1, 2]]}]}, "2 observations for 1 actions"),
        ({"support": [{"observations": [[1, 2, np.nan]], "actions": [[1, 2]]}]}, "support[0]: "),
        ({"observation": None}, "observation: got the shape (); wanted 3 numbers"),
        ({"observation": [1, 2]}, "observation: got the shape (2,); wanted 3 numbers"),
        ({"observation": [1, 2, "x"]}, "observation: got [1, 2, 'x']; wanted 3 numbers"),
        ({"observation": [1, 2, np.inf]}, "observation: got numbers that are not finite"),
        ({"memory": ["x"]}, "memory: got ['x']; wanted whole numbers"),
    ],
)
def test_a_mistake_is_reported_with_its_place(changes: dict[str, Any], message: str):
    with pytest.raises(UserError) as caught:
        unpacked(packed([ONE], ONE.observations[0]) | changes, 3, 2)
    assert message in str(caught.value)
