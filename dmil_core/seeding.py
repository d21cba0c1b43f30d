"""Random generators named by what they are for.

A name, for example ``(seed, "batch", iteration, slot)``, is all that is needed to draw the same numbers again
anywhere: in another process, after a crash, in a resumed run.
"""

import hashlib

import numpy as np


def named_rng(seed: int, *name: str | int) -> np.random.Generator:
    """Return the random generator that belongs to `name` under the experiment's `seed`."""
    digest = hashlib.sha256(
        "\x1f".join(repr(part if isinstance(part, str) else int(part)) for part in name).encode()
    ).digest()
    return np.random.default_rng([seed, *np.frombuffer(digest, dtype=np.uint32).tolist()])


def named_seed(seed: int, *name: str | int) -> int:
    """Return a 31-bit seed for a library with a generator of its own, such as a simulator."""
    return int(named_rng(seed, *name).integers(2**31))
