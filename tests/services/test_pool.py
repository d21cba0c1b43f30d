"""The pool of actors, with actors whose work is to count, to build upon each other, and to die."""

import logging
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import ray
from ray.exceptions import ActorDiedError

from services.actors.pool import DEATHS_ALLOWED, Pool


@pytest.fixture
def make(joined) -> Iterator:
    ray.init(logging_level=logging.ERROR, log_to_driver=False)

    class Counter:
        """Inside a function, so that it travels by value: the workers cannot import a test."""

        def one(self, number: int) -> int:
            return number

        def two(self, number: int) -> tuple[str, int]:
            return f"made {number}", number

        def add(self, *numbers: int) -> tuple[int, int]:
            return os.getpid(), sum(numbers)

        def fetch(self, numbers: list[ray.ObjectRef]) -> int:
            return sum(ray.get(numbers))

        def die(self, folder: Path, deaths: int, number: int) -> tuple[int, int]:
            """Die so many times, and then return the number."""
            before = len(list(folder.iterdir()))
            if before < deaths:
                (folder / str(before)).touch()
                os.kill(os.getpid(), signal.SIGKILL)
            return os.getpid(), number

        def fail(self) -> int:
            raise ArithmeticError("out of numbers")

    yield ray.remote(num_cpus=0)(Counter).remote
    ray.shutdown()


def test_every_call_is_made_once(make):
    pool = Pool(make, 2)
    assert sorted(pool.map("one", [(number,) for number in range(7)])) == [(number, number) for number in range(7)]
    assert list(pool.map("one", [])) == []
    assert pool.restarts == 0
    pool.close()


@pytest.mark.parametrize("ahead", [1, 2, 9])
def test_calls_build_upon_calls_that_are_under_way(make, ahead: int):
    pool = Pool(make, 2, ahead)
    numbers = [pool.submit("two", number, returns=2) for number in range(5)]
    sums = [pool.submit("add", *part, returns=2, beside=part[-1]) for part in (numbers[:2], numbers[2:])]
    total = pool.submit("add", *sums, returns=2)
    last = pool.submit("one", total)
    assert pool.result(last) == 10
    assert [pool.result(call) for call in numbers] == [f"made {number}" for number in range(5)]
    pids = [ray.get(actor.__ray_call__.remote(lambda counter: os.getpid())) for actor in pool._actors]
    assert [pids.index(pool.result(call)) for call in sums] == [numbers[1].worker, numbers[4].worker]
    pool.close()


def test_a_list_of_calls_is_fetched_by_the_actor_itself(make):
    pool = Pool(make, 2, ahead=2)
    numbers = [pool.submit("two", number, returns=2) for number in range(3)]
    total = pool.submit("fetch", numbers)
    assert pool.result(total) == 3
    assert pool.result(pool.submit("fetch", [])) == 0
    pool.close()


@pytest.mark.parametrize("method", ["one", "add"])
def test_what_builds_upon_a_lost_call_is_made_again_too(make, tmp_path: Path, method: str):
    pool = Pool(make, 2, ahead=2)
    own = make()
    lost = pool.submit("die", tmp_path, 2, 5, returns=2)
    kept = pool.submit("two", 6, returns=2)
    both = pool.submit("add", lost, kept, returns=2, beside=kept)
    there = pool.submit("two", both, returns=2, on=own)
    after = [pool.submit(method, there, returns=2 if method == "add" else 1) for _ in range(3)]
    assert pool.result(there) == "made 11"
    assert [pool.result(call) == 11 or ray.get(call.references[-1]) == 11 for call in after] == [True] * 3
    assert pool.restarts == 2
    assert len(pool) == 2
    pool.close()


def test_a_call_that_kills_is_given_up(make, tmp_path: Path):
    pool = Pool(make, 2)
    pool.submit("one", 1)
    deadly = pool.submit("die", tmp_path, DEATHS_ALLOWED, 0)
    with pytest.raises(ActorDiedError):
        pool.result(deadly)
    assert pool.restarts == DEATHS_ALLOWED - 1
    pool.close()


def test_the_death_of_an_actor_of_ones_own_is_told(make, tmp_path: Path):
    pool, own = Pool(make, 1), make()
    first = pool.submit("two", 1, returns=2)
    deadly = pool.submit("die", tmp_path, 1, first, on=own)
    with pytest.raises(ActorDiedError):
        pool.result(pool.submit("one", deadly))
    assert pool.restarts == 0
    pool.close()


def test_an_error_in_a_call_is_told(make):
    pool = Pool(make, 1)
    with pytest.raises(ArithmeticError, match="out of numbers"):
        pool.result(pool.submit("one", pool.submit("fail")))
    pool.close()
