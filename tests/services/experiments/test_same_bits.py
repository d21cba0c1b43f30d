"""Runs come to the digests that were written down, on the kind of processor that they were written down for."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from dmil_core.methods.base import FineTuning
from dmil_core.methods.registry import method_type
from services.storage.checkpoints import Checkpoint
from tests.services.experiments.same_bits import RUNS, processor, train

KNOWN = json.loads(Path(__file__).with_name("same_bits.json").read_text())
OLD = Path(__file__).with_name("old_checkpoints")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.thorough) if name.endswith("-1") else name for name in RUNS]
)
def test_a_run_comes_to_the_same_bits_as_ever(workplace: Path, name: str):
    if processor() not in KNOWN:
        pytest.skip(f"no digests for {processor()}; write them down by python -m tests.services.experiments.same_bits")
    assert train(name, workplace / "runs") == KNOWN[processor()][name]


@pytest.mark.parametrize("method", sorted(path.name for path in OLD.iterdir()))
def test_a_checkpoint_of_version_0_1_opens_and_adapts(data, method: str):
    """Written at commit 40f9c62, with 4 hidden units where the method has a network."""
    checkpoint = Checkpoint(OLD / method)
    config = checkpoint.manifest.config
    learner = method_type(config.method.name).restored(config.method, 4, checkpoint.constants)
    parameters = {name: torch.tensor(array) for name, array in checkpoint.parameters.items()}
    demonstrations = data["door-close"].demonstrations
    policy = learner.adapt(parameters, demonstrations[:1], FineTuning(2, 0.01))
    decision = policy.act(demonstrations[1].observations[:1], policy.start(1))
    assert np.isfinite(decision.actions).all()
    assert checkpoint.digest == KNOWN["checkpoints"][method]
