"""How an iteration's time grows with the workers: a closed form, fed with measured costs and an assumed network."""

import math
from typing import NamedTuple


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
    demonstrations: int
    """Bytes of all demonstrations."""
    resident: int
    """Bytes of memory that a worker had at most."""


class Network(NamedTuple):
    """What is assumed: workers on nodes, and what lies between those."""

    workers_per_node: int = 8
    bytes_per_second: float = 1.25e9
    """Of one node's link, in each direction: 10 Gbit/s."""
    latency: float = 1e-4
    """Seconds."""

    def nodes(self, workers: int) -> int:
        """Return how many nodes so many workers are on."""
        return -(-workers // self.workers_per_node)

    def send(self, size: int) -> float:
        """Return the seconds in which so many bytes come from one node to another."""
        return self.latency + size / self.bytes_per_second


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


def seconds_of_a_tree(costs: Costs, network: Network, terms: int, fan_in: int) -> float:
    """Return what it takes to add gradients of so many workers, from them in the store to their sum with the learner.

    With a fan-in of all `terms` one process adds all of them.
    """
    seconds, left = 0.0, terms
    while left > 1:
        together = min(fan_in, left)
        fetched = network.send(costs.buffer) * (together - 1) if left > network.workers_per_node else 0.0
        seconds += fetched + together * costs.buffer / costs.add + costs.buffer / costs.store + costs.call
        left = -(-left // fan_in)
    return seconds + (network.send(costs.buffer) if network.nodes(terms) > 1 else 0.0)


def predict(
    costs: Costs, network: Network, workers: int, slots: int, fan_in: int, *, relayed: bool, together: int = 1
) -> Prediction:
    """Return T(W) of ``docs/performance.md``, W being `workers` and f `fan_in`, for one block a worker.

    There is work for no more workers than there are groups of slots, of `together` slots each. If `relayed`, a node
    passes the parameters on to others as soon as it has them; else all fetch them from the learner's node.
    """
    groups = -(-slots // together)
    workers = min(workers, groups)
    nodes = network.nodes(workers)
    put = costs.buffer / costs.store
    hops = math.ceil(math.log2(nodes)) if relayed else nodes - 1
    compute = min(slots, -(-groups // workers) * together) * costs.slot
    # The largest of W normal deviates is about sqrt(2 ln W) standard deviations above the mean.
    waiting = math.sqrt(2 * math.log(workers)) * costs.spread * compute
    reduction = put + costs.call + seconds_of_a_tree(costs, network, workers, fan_in)
    driver = costs.submit * (workers + calls_of_a_tree(workers, fan_in) + 1)
    broadcast = put + costs.call + hops * network.send(costs.buffer)
    return Prediction(workers, broadcast, compute, waiting, reduction, costs.step, driver)
