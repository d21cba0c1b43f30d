"""What the tests of the science share: ragged trajectories, small networks and their reference."""

from collections.abc import Callable, Iterator, Sequence

import hypothesis
import jaxtyping
import numpy as np
import pytest
import torch
from torch.nn import functional

from dmil_core.demonstrations import Demonstration
from dmil_core.loss_gradients import LossGradient
from dmil_core.losses import Steps
from dmil_core.networks import Layer, Network, Parameters, initialise

OBS_DIM, ACTION_DIM = 4, 3

hypothesis.settings.register_profile("numbers", deadline=None, max_examples=50, derandomize=True)
hypothesis.settings.load_profile("numbers")


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Leave out the run-time type checks of the tests, as in use: to hand in wrong shapes, or to train for long."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


@pytest.fixture(scope="session")
def make_steps() -> Callable[..., Steps]:
    """Draw trajectories of the given lengths."""

    def make(seed: int, lengths: Sequence[int], dtype: torch.dtype = torch.float64) -> Steps:
        generator = torch.Generator().manual_seed(seed)
        states, actions = (
            torch.randn(sum(lengths), size, generator=generator, dtype=torch.float64).to(dtype)
            for size in (OBS_DIM, ACTION_DIM)
        )
        return Steps(states, actions, torch.tensor(lengths))

    return make


@pytest.fixture(scope="session")
def make_parameters() -> Callable[..., Parameters]:
    """Draw a high level and a bank of sub-skills, biases too, so that nothing hides behind a zero."""

    def make(
        seed: int, sub_skills: int, hidden: Sequence[int] = (8, 8), dtype: torch.dtype = torch.float64
    ) -> Parameters:
        rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
        drawn = {
            **initialise("high", [OBS_DIM, *hidden, sub_skills], rng),
            **initialise("low", [OBS_DIM, *hidden, ACTION_DIM], rng, copies=sub_skills),
        }
        return {
            name: (tensor + 0.3 * torch.randn(tensor.shape, generator=generator)).to(dtype)
            for name, tensor in drawn.items()
        }

    return make


@pytest.fixture(scope="session")
def plain_mlp() -> Callable[[Network, torch.Tensor], torch.Tensor]:
    """Run a perceptron by torch.nn.functional alone."""

    def plain(network: Network, inputs: torch.Tensor) -> torch.Tensor:
        for weight, bias in network[:-1]:
            inputs = functional.relu(functional.linear(inputs, weight, bias))
        return functional.linear(inputs, *network[-1])

    return plain


@pytest.fixture(scope="session")
def gradient_of() -> Callable[[LossGradient], Network]:
    """Have a gradient add its gradient to nothing."""

    def gradient(gradient: LossGradient) -> Network:
        out = tuple(Layer(*map(torch.zeros_like, layer)) for layer in gradient.network)
        gradient.add_to(out)
        return out

    return gradient


@pytest.fixture(scope="session")
def make_demonstrations() -> Callable[..., list[Demonstration]]:
    """Draw demonstrations of the given lengths for one task."""

    def make(seed: int, lengths: Sequence[int]) -> list[Demonstration]:
        rng = np.random.default_rng(seed)
        return [
            Demonstration(
                f"d{index}",
                "reach",
                rng.normal(size=(length, OBS_DIM)).astype(np.float32),
                rng.normal(size=(length, ACTION_DIM)).astype(np.float32),
            )
            for index, length in enumerate(lengths)
        ]

    return make
