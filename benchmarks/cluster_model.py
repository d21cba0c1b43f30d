"""How an iteration's time grows with the workers: a closed form, fed with measured costs and an assumed network."""

import math
from typing import NamedTuple

__all__ = ["Costs", "Network", "Prediction", "calls_of_a_tree", "predict"]


class Costs(NamedTuple):
    """What was measured on one machine."""

    slot: float
    """Seconds that a worker computes for one slot."""
    spread: float
    """Standard deviation of that, as a part of it."""
    step: float
    """Seconds of the outer step."""
    call: float
    """Seconds from the submission of a call without big arguments until its result is there."""
    submit: float
    """Seconds of the driver for each call: submitting it and taking note of its end."""
    buffer: int
    """Bytes of the parameters, and of a gradient."""
    store: float
    """Bytes a second into the object store."""
    add: float
    """Bytes of gradients added a second."""


class Network(NamedTuple):
    """What is assumed: workers on nodes, and what lies between those."""

    workers_per_node: int = 8
    bytes_per_second: float = 1.25e9
    """Of one node's link, in each direction: 10 Gbit/s."""
    latency: float = 1e-4
    """Seconds."""


class Prediction(NamedTuple):
    """Seconds of an iteration, by what takes them; the driver's pass beside all the others."""

    workers: int
    broadcast: float
    compute: float
    waiting: float
    reduction: float
    step: float
    driver: float

    @property
    def iteration(self) -> float:
        """The iteration: the chain of calls, or the driver if that is slower."""
        return max(sum(self[1:6]), self.driver)

    @property
    def largest(self) -> str:
        """What costs most besides compute."""
        return max((name for name in self._fields[1:] if name != "compute"), key=lambda name: getattr(self, name))


def calls_of_a_tree(terms: int, fan_in: int) -> int:
    """Return how many additions of up to `fan_in` terms leave one of them."""
    calls = 0
    while terms > 1:
        calls += sum(min(fan_in, terms - first) > 1 for first in range(0, terms, fan_in))
        terms = -(-terms // fan_in)
    return calls


def predict(costs: Costs, network: Network, workers: int, slots: int, fan_in: int, *, relayed: bool) -> Prediction:
    """Return T(W) of ``docs/performance.md``, for one block a worker.

    Args:
        costs: measured.
        network: assumed.
        workers: W.
        slots: of all workers together.
        fan_in: f.
        relayed: a node passes the parameters on to others as soon as it has them; else all fetch them from the
            learner's node.
    """
    nodes = -(-workers // network.workers_per_node)
    put = costs.buffer / costs.store
    send = network.latency + costs.buffer / network.bytes_per_second
    hops = math.ceil(math.log2(nodes)) if relayed else nodes - 1
    compute = -(-slots // workers) * costs.slot
    # The largest of W normal deviates is about sqrt(2 ln W) standard deviations above the mean.
    waiting = math.sqrt(2 * math.log(workers)) * costs.spread * compute
    reduction, terms = put + costs.call, workers
    while terms > 1:
        together = min(fan_in, terms)
        fetched = send * (together - 1) if terms > network.workers_per_node else 0.0
        reduction += fetched + together * costs.buffer / costs.add + put + costs.call
        terms = -(-terms // fan_in)
    reduction += send if nodes > 1 else 0.0
    driver = costs.submit * (workers + calls_of_a_tree(workers, fan_in) + 1)
    return Prediction(workers, put + costs.call + hops * send, compute, waiting, reduction, costs.step, driver)
