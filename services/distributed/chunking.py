"""Chunking of the big flat vectors that travel between actors, so that they are cheap to write."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float32

Chunks: TypeAlias = Sequence[Float32[np.ndarray, " _"]]
"""A flat vector in consecutive chunks."""

CHUNK_LENGTH = 2**18
"""Numbers in a chunk, 1 MiB. Ray starts six threads to copy a longer one into its store: where every core computes
already, that takes longer than the copy."""


def to_chunks(vector: Float32[np.ndarray, " size"]) -> Chunks:
    """Return `vector` in chunks, as views."""
    return [vector[first : first + CHUNK_LENGTH] for first in range(0, len(vector), CHUNK_LENGTH)]


def from_chunks(chunks: Chunks) -> Float32[np.ndarray, " size"]:
    """Concatenate the chunks, which may lie in shared memory, into a vector of its own."""
    return np.concatenate(chunks)
