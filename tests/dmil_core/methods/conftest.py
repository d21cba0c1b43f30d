"""What the tests of several methods share: small settings, and parameters drawn with them."""

import numpy as np
import pytest
import torch

from dmil_core.demonstrations import Demonstration
from dmil_core.methods.mil.config import MilConfig
from dmil_core.methods.mlsh.config import MlshConfig
from dmil_core.methods.option_gail.config import OptionGailConfig, OptionGailOfflineConfig
from dmil_core.methods.option_gail.method import OptionGail, OptionGailOffline
from dmil_core.methods.option_gail.option_model import OptionModel
from dmil_core.networks import Parameters
from dmil_core.seeding import named_rng
from dmil_core.trajectories import Rollout

OFFLINE = OptionGailOfflineConfig(hidden_layers=2, hidden_units=8, trajectories=3, likelihood_iterations=2)
PLAYING = OptionGailConfig(
    hidden_layers=2,
    hidden_units=8,
    trajectories=3,
    likelihood_iterations=2,
    offline_iterations=4,
    offline_steps=1,
    environment_steps=9,
    minibatch=4,
    discriminator_passes=2,
    policy_epochs=2,
    discriminator_units=8,
    critic_units=8,
)
SMALL_MIL = MilConfig(
    layers=1,
    heads=2,
    units=8,
    key_units=4,
    value_units=3,
    feed_forward_units=6,
    positions=6,
    batch_pairs=16,
    output_scale=1.0,
    inner_learning_rate=0.05,
)
SMALL_MLSH = MlshConfig(
    sub_skills=3,
    hidden_layers=2,
    hidden_units=8,
    warm_up_updates=5,
    joint_updates=7,
    batch_size=20,
    passes=3,
    trajectories=6,
)


@pytest.fixture
def demonstrations(make_demonstrations) -> list[Demonstration]:
    return make_demonstrations(0, [7, 3, 9, 1, 6, 5, 8, 4, 2])


@pytest.fixture
def offline(demonstrations) -> OptionGailOffline:
    return OptionGailOffline.prepared(OFFLINE, 3, demonstrations)


@pytest.fixture
def playing(demonstrations) -> OptionGail:
    return OptionGail.prepared(PLAYING, 3, demonstrations)


@pytest.fixture
def rollouts() -> list[Rollout]:
    draw = np.random.default_rng(5)
    return [
        Rollout(
            draw.normal(size=(steps + 1, 4)).astype(np.float32),
            draw.normal(size=(steps, 3)).astype(np.float32),
            sub_skills=draw.integers(0, 3, steps),
            solved_at=steps - 1 if success else None,
        )
        for steps, success in ((5, True), (1, False), (3, False))
    ]


def drawn_parameters(method: OptionGailOffline | OptionGail) -> Parameters:
    """Draw parameters of which none is zero."""
    generator = torch.Generator().manual_seed(1)
    drawn = method.initial_parameters(named_rng(0, "initial"))
    return {name: tensor + 0.3 * torch.randn(tensor.shape, generator=generator) for name, tensor in drawn.items()}


def model_of(parameters: Parameters) -> OptionModel:
    return OptionModel.of(parameters, -20.0)
