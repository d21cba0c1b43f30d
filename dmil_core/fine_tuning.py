"""Fine-tuning by Adam on batches of states, its rate falling along a cosine: many steps on many displaced copies."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmil_core.losses import Steps, squared_errors
from dmil_core.networks import Adam, Network, cosine_rate, descend, each_tensor
from dmil_core.settings import FineTuning

BATCH = 128
"""States in a step."""


def on_batches(networks: Sequence[Network], loss: Callable[[Steps], Tensor], steps: Steps, tuning: FineTuning) -> None:
    """Take `tuning.steps` steps of Adam down a loss of batches of states, changing the networks' leaves in place.

    The states are drawn alike each time, so the same support set gives the same networks.
    """
    adam = Adam([tensor for network in networks for layer in network for tensor in layer], tuning.learning_rate)
    generator = torch.Generator().manual_seed(0)
    for step in range(tuning.steps):
        adam.learning_rate = cosine_rate(tuning.learning_rate, step / tuning.steps)
        drawn: Int[Tensor, " batch"] = torch.randint(len(steps.states), (BATCH,), generator=generator, device="cpu")
        drawn = drawn.to(steps.states.device)
        descend(adam, loss(Steps(steps.states[drawn], steps.actions[drawn], torch.ones(BATCH, dtype=torch.int64))))


def free(network: Network) -> Network:
    """Return a copy of a network whose tensors ask for gradients."""
    return each_tensor(network, lambda tensor: tensor.detach().clone().requires_grad_())


def fixed(network: Network) -> Network:
    """Return a network without graph; no copy."""
    return each_tensor(network, torch.Tensor.detach)


def mean_error(
    predictions: Float[Tensor, "steps action_dim"], actions: Float[Tensor, "steps action_dim"]
) -> Float[Tensor, ""]:
    """Return ‖π(s) − a‖², averaged over the steps."""
    return squared_errors(predictions, actions).mean()
