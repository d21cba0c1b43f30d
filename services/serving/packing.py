"""An adapted policy as bytes, for another process: the files that it is saved as, one after the other."""

import tempfile
from pathlib import Path

import numpy as np
from safetensors.numpy import load, save

from dmil_core.adapted_policy import DEMONSTRATIONS, POLICY, SEAL, TENSORS, AdaptedPolicy, load_policy
from dmil_core.checkpoint import CONSTANTS
from dmil_core.files import create_file, read_file

FILES = (POLICY, SEAL, TENSORS, CONSTANTS, DEMONSTRATIONS)
MOST_BYTES = 2**30
"""Of a file."""


def packed(policy: AdaptedPolicy) -> bytes:
    """Return a policy as bytes: safetensors whose values are the files that `AdaptedPolicy.save` writes."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "policy"
        policy.save(folder)
        return save({name: np.frombuffer(read_file(folder, name, MOST_BYTES), np.uint8) for name in FILES})


def unpacked(content: bytes) -> AdaptedPolicy:
    """Return the policy that `packed` made bytes of: it acts to the bit as that one.

    Raises:
        UserError: if they are of something else.
    """
    with tempfile.TemporaryDirectory() as made:
        for name, array in load(content).items():
            create_file(Path(made), name, array.tobytes())
        return load_policy(made)
