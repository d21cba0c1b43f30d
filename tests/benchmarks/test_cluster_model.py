"""The closed form of an iteration's time on a cluster."""

import math

import pytest

from benchmarks.cluster_model import Costs, Network, calls_of_a_tree, predict, seconds_of_a_tree

COSTS = Costs(
    slot=1.0,
    spread=0.0,
    step=0.25,
    call=0.5,
    submit=0.001,
    buffer=1000,
    store=1000.0,
    add=4000.0,
    demonstrations=0,
    resident=0,
)  # exact in binary, so that sums are too
NETWORK = Network(workers_per_node=2, bytes_per_second=1000.0, latency=1.0)


@pytest.mark.parametrize(
    ("terms", "fan_in", "calls"), [(1, 8, 0), (2, 8, 1), (8, 8, 1), (9, 8, 2), (10, 8, 3), (64, 8, 9), (7, 2, 6)]
)
def test_additions_of_a_tree(terms: int, fan_in: int, calls: int):
    assert calls_of_a_tree(terms, fan_in) == calls


def test_one_worker_pays_for_two_hops_only():
    found = predict(COSTS, NETWORK, 1, 10, 8, relayed=False)
    assert found[:6] == (1, 1.5, 10.0, 0.0, 1.5, 0.25)
    assert found.iteration == 13.25


def test_a_node_fetches_parameters_once_and_its_gradients_stay_on_it():
    two = predict(COSTS, NETWORK, 2, 10, 8, relayed=False)
    assert two[:6] == (2, 1.5, 5.0, 0.0, 1.5 + 0.5 + 1.5, 0.25)
    four = predict(COSTS, NETWORK, 4, 12, 8, relayed=False)
    assert four[:6] == (4, 1.5 + 2, 3.0, 0.0, 1.5 + (3 * 2 + 1 + 1.5) + 2, 0.25)


def test_relaying_turns_the_number_of_nodes_into_its_logarithm():
    for workers, hops in ((2, 0), (4, 1), (16, 3), (64, 5)):
        assert predict(COSTS, NETWORK, workers, workers, 8, relayed=True).broadcast == 1.5 + 2 * hops
        assert predict(COSTS, NETWORK, workers, workers, 8, relayed=False).broadcast == 1.5 + 2 * (workers // 2 - 1)


def test_the_driver_is_slowest_in_the_end():
    found = predict(COSTS._replace(submit=1.0), NETWORK, 64, 64, 8, relayed=True)
    assert found.driver == 64 + 9 + 1
    assert found.largest == "driver"
    assert found.iteration == found.driver > sum(found[1:6])


def test_more_workers_wait_longer_for_the_slowest():
    waits = [predict(COSTS._replace(spread=0.1), NETWORK, n, n, 8, relayed=True).waiting for n in (1, 2, 1000)]
    assert waits == [0, 0.1 * math.sqrt(2 * math.log(2)), 0.1 * math.sqrt(2 * math.log(1000))]


def test_workers_without_a_group_of_slots_do_nothing():
    ten = predict(COSTS, NETWORK, 10, 10, 8, relayed=True)
    assert predict(COSTS, NETWORK, 1000, 10, 8, relayed=True) == ten
    assert (ten.workers, ten.compute) == (10, 1.0)


def test_a_worker_computes_the_slots_of_a_group_together():
    assert predict(COSTS, NETWORK, 10, 10, 8, relayed=True, together=5)[:3:2] == (2, 5.0)
    assert predict(COSTS, NETWORK, 1, 10, 8, relayed=True, together=5).compute == 10.0
    assert predict(COSTS, NETWORK, 1, 3, 8, relayed=True, together=5).compute == 3.0


def test_a_tree_of_additions_beats_one_process_that_fetches_all():
    tree, alone = (seconds_of_a_tree(COSTS, NETWORK, 64, fan_in) for fan_in in (8, 64))
    assert tree == 2 * (7 * 2.0 + 8 * 0.25 + 1.5) + 2.0
    assert alone == 63 * 2.0 + 64 * 0.25 + 1.5 + 2.0
