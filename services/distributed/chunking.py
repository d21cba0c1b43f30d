"""How a big flat vector travels between actors: as one object, in pieces that are cheap to write."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float32

Freight: TypeAlias = Sequence[Float32[np.ndarray, " _"]]
"""A flat vector in consecutive pieces."""

PIECE = 2**18
"""Numbers in a piece, 1 MiB. Ray starts six threads to copy a longer one into its store: where every core computes
already, that takes longer than the copy."""


def pack(vector: Float32[np.ndarray, " size"]) -> Freight:
    """Return `vector` in pieces, as views."""
    return [vector[first : first + PIECE] for first in range(0, len(vector), PIECE)]


def unpack(freight: Freight) -> Float32[np.ndarray, " size"]:
    """Copy the pieces, which may lie in memory that others read, into one vector of one's own."""
    return np.concatenate(freight)
