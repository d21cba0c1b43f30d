"""Mutations of bytes and of what JSON and YAML can say."""

import copy
import json
import math
from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any

from hypothesis import strategies

Odd = Callable[[], Any]
"""Draws a value that no reader expects."""

DEEP: Any = 0
for _ in range(60):
    DEEP = [DEEP]
ODD: list[Any] = [
    None, True, False, -1, 0, 1, 2**31, 2**63, 2**64, 10**13, 10**400, -(10**19), 0.5, -0.0, 1e308, math.nan, math.inf,
    "", "../../x", "/etc/passwd", "\0", "é\u202e", "x" * 5000, "9" * 5000, "nan", [], {}, [[]], {"": {}}, [0] * 500,
    DEEP, [10**7, 10**6], [2**40], [-3], [0], {"x": 2}, "2001-99-99", "0" * 64,
]  # fmt: skip
"""Values that no reader expects somewhere."""

scalars = strategies.none() | strategies.booleans() | strategies.integers() | strategies.floats() | strategies.text()
json_values = strategies.recursive(
    scalars,
    lambda inner: strategies.lists(inner, max_size=4) | strategies.dictionaries(strategies.text(), inner, max_size=4),
    max_leaves=8,
)


def mutated_bytes(content: bytes, draw: Random) -> bytes:
    """Return `content` with one to three places flipped, overwritten, cut out, cut off, doubled or filled in."""
    mutated = bytearray(content)
    for _ in range(draw.choice([1, 1, 1, 2, 3])):
        start = draw.randrange(len(mutated) + 1)
        end = min(len(mutated), start + draw.choice([1, 1, 2, 4, 8, 64, 4096]))
        part = mutated[start:end]
        match draw.randrange(8):
            case 0 | 1:
                if part:
                    mutated[start] ^= 1 << draw.randrange(8)
            case 2:
                mutated[start:end] = draw.randbytes(len(part))
            case 3:
                del mutated[start:end]
            case 4:
                del mutated[start:]
            case 5:
                mutated[start:start] = part * draw.choice([1, 2, 50])
            case 6:
                mutated[start:end] = draw.choice([b"\0", b"\xff", b"9", b"[", b" "]) * len(part)
            case 7:
                mutated[start:start] = draw.randbytes(draw.choice([1, 4, 64]))
    return bytes(mutated)


def mutated_value(value: Any, draw: Random, odd: Odd) -> Any:
    """Return a copy of what JSON can say, with a field replaced, removed, renamed, added or swapped with another."""
    mutated = copy.deepcopy(value)
    places = list(_places(mutated))
    if not places:
        return odd()
    inside, key = draw.choice(places)
    other_inside, other = draw.choice(places)
    match draw.randrange(6):
        case 0 | 1:
            inside[key] = odd()
        case 2:
            del inside[key]
        case 3:
            if isinstance(inside, dict):
                inside[draw.choice(["", "x", f"{key}s", "__class__", "../x"])] = inside.pop(key)
        case 4:
            if isinstance(inside, dict):
                inside[draw.choice(["", "x", "files", "seed"])] = odd()
            else:
                inside.append(odd())
        case 5:
            one, two = copy.deepcopy(inside[key]), copy.deepcopy(other_inside[other])
            inside[key], other_inside[other] = two, one
    return mutated


def _places(value: Any) -> Any:
    """Yield every container with every key or index of it."""
    if isinstance(value, dict | list):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            yield value, key
            yield from _places(value[key])


def plain_odd(draw: Random) -> Odd:
    """Return what draws from the fixed list of odd values."""
    return partial(draw.choice, ODD)


def json_bytes(value: Any) -> bytes:
    return json.dumps(value).encode()
