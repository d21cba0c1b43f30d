"""What a suite declares of its observations."""

from typing import Any

import pytest
from pydantic import ValidationError

from dmil_core.errors import UserError
from dmil_core.points import Points


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal": (1, 2)}, "goal: got 2 numbers; wanted 3"),
        ({"object": None}, "object: got none"),
        ({"previous": 15}, "got the place 21; wanted less than size, 17"),
        ({"hand": ()}, "at least 1"),
        ({"reach": 0}, "greater than 0"),
        ({"orientation": (17,)}, "got the place 17"),
        ({"object": (-1, 0, 1)}, "greater than or equal to 0"),
    ],
)
def test_what_cannot_be_is_refused(changes: dict[str, Any], message: str) -> None:
    right: dict[str, Any] = {"size": 17, "hand": (0, 1, 2), "object": (4, 5, 6), "goal": (14, 15, 16)}
    Points.model_validate(right)
    with pytest.raises(ValidationError, match=message):
        Points.model_validate(right | changes)


def test_sizes_are_compared() -> None:
    points = Points(size=5, hand=(0, 1, 2))
    points.check(5, 3)
    with pytest.raises(UserError, match=r"suite\.points\.size: got 5; wanted 6"):
        points.check(6, 3)
    with pytest.raises(UserError, match=r"suite\.points\.hand: got 3 numbers; wanted at most 2"):
        points.check(5, 2)
