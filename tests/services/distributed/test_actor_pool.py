"""The pool of actors, with actors whose work is to count, to build upon each other, and to die."""

import logging
import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import ray
from ray.exceptions import OutOfMemoryError

from dmil_core.errors import RunError
from services.distributed.actor_pool import MAX_DEATHS, Pool
from services.distributed.calls import DeadlyCallError, LostError, Worker
from services.distributed.metrics import Meter, WorkerCounter


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
                time.sleep(0.3)  # until what was done before has been answered
                os.kill(os.getpid(), signal.SIGKILL)
            return os.getpid(), number

        def run_out_of_memory(self, folder: Path) -> int:
            """End once as if by Ray's memory monitor."""
            (folder / str(len(list(folder.iterdir())))).touch()
            if len(list(folder.iterdir())) == 1:
                raise OutOfMemoryError("the node has hardly any memory left")
            return 1

        def sleep(self, seconds: float, folder: Path) -> tuple[int, int]:
            time.sleep(seconds)
            return os.getpid(), 1

        def fail(self) -> int:
            raise ArithmeticError("out of numbers")

    yield ray.remote(num_cpus=0)(Counter).remote
    ray.shutdown()


@pytest.fixture
def make_broken(make):
    class Broken:
        def __init__(self) -> None:
            raise FileNotFoundError("no such thing")

    return ray.remote(num_cpus=0)(Broken).remote


def pid_of(worker: Worker | None) -> int:
    assert worker is not None
    return ray.get(worker.actor.__ray_call__.remote(lambda counter: os.getpid()))


@pytest.fixture
def counter() -> WorkerCounter:
    return WorkerCounter("counter", Meter())


def test_every_call_is_made_once(make, counter: WorkerCounter):
    pool = Pool(make, 2, listener=counter)
    calls = [pool.submit("one", number) for number in range(7)]
    assert sorted(pool.results(calls)) == [(number, number) for number in range(7)]
    assert list(pool.results([])) == []
    assert counter.count == ("counter", 2, 0)
    pool.close()
    assert counter.count == ("counter", 0, 0)


@pytest.mark.parametrize("max_in_flight", [1, 2, 9])
def test_calls_build_upon_calls_that_are_under_way(make, max_in_flight: int):
    pool = Pool(make, 2, max_in_flight)
    numbers = [pool.submit("two", number, returns=2) for number in range(5)]
    sums = [pool.submit("add", *part, returns=2, same_worker_as=part[-1]) for part in (numbers[:2], numbers[2:])]
    total = pool.submit("add", *sums, returns=2)
    last = pool.submit("one", total)
    assert pool.result(last) == 10
    assert [pool.result(call) for call in numbers] == [f"made {number}" for number in range(5)]
    assert [pool.result(call) for call in sums] == [pid_of(call.worker) for call in (numbers[1], numbers[4])]
    pool.close()


def test_a_list_of_calls_is_fetched_by_the_actor_itself(make):
    pool = Pool(make, 2, max_in_flight=2)
    numbers = [pool.submit("two", number, returns=2) for number in range(3)]
    total = pool.submit("fetch", numbers)
    assert pool.result(total) == 3
    assert pool.result(pool.submit("fetch", [])) == 0
    pool.close()


@pytest.mark.parametrize("method", ["one", "add"])
def test_what_builds_upon_a_lost_call_is_made_again_too(
    make, counter: WorkerCounter, wait_for, tmp_path: Path, method: str
):
    pool = Pool(make, 2, max_in_flight=2, listener=counter)
    own = make()
    lost = pool.submit("die", tmp_path, 2, 5, returns=2)
    kept = pool.submit("two", 6, returns=2)
    both = pool.submit("add", lost, kept, returns=2, same_worker_as=kept)
    there = pool.submit("two", both, returns=2, actor=own)
    after = [pool.submit(method, there, returns=2 if method == "add" else 1) for _ in range(3)]
    assert pool.result(there) == "made 11"
    assert [pool.result(call) == 11 or ray.get(call.references[-1]) == 11 for call in after] == [True] * 3
    assert counter.count.restarted == 2
    wait_for(lambda: bool(pool.poll() or len(pool) == 2), "the replacement")
    pool.close()


def test_a_call_whose_actor_ray_ends_for_want_of_memory_is_made_again(make, tmp_path: Path, caplog):
    pool = Pool(make, 1)
    assert pool.result(pool.submit("run_out_of_memory", tmp_path)) == 1
    assert "worker 0 ended for want of memory in the course of" in caplog.text
    pool.close()


def test_a_call_that_kills_is_given_up(make, counter: WorkerCounter, tmp_path: Path):
    pool = Pool(make, 2, listener=counter)
    pool.submit("one", 1)
    deadly = pool.submit("die", tmp_path, MAX_DEATHS, 7, returns=2, label="a deadly call")
    after = pool.submit("add", deadly, 1, returns=2)
    with pytest.raises(DeadlyCallError, match="a deadly call: 3 workers ended") as error:
        pool.result(deadly)
    assert error.value.call is deadly
    assert counter.count.restarted == MAX_DEATHS
    pool.retry(deadly)
    pool.result(after)
    assert ray.get(after.references[-1]) == 8
    pool.close()


def test_calls_that_wait_behind_a_deadly_one_are_not_suspected(make, counter: WorkerCounter, tmp_path: Path):
    pool, count = Pool(make, 1, max_in_flight=MAX_DEATHS, listener=counter), MAX_DEATHS
    for number in range(count):
        (tmp_path / str(number)).mkdir()
    deaths = [pool.submit("die", tmp_path / str(number), 1, number) for number in range(count)]
    assert [pool.result(call)[1] for call in deaths] == [*range(count)], "the last saw as many deaths as are allowed"
    assert counter.count.restarted == count
    pool.close()


def test_a_hung_actor_is_overtaken(make, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    """Both where others wait for what it makes, and where it is the only one."""
    monkeypatch.setattr("services.distributed.stragglers.MIN_TIMEOUT_SECONDS", 4.0)  # longer than a busy machine takes
    for size in (1, 2):
        counter = WorkerCounter("counter", Meter())
        pool = Pool(make, size, max_in_flight=2, listener=counter)
        list(pool.results([pool.submit("one", number) for number in range(10)]))
        hung = pid_of(pool._workers[0])
        os.kill(hung, signal.SIGSTOP)
        numbers = [pool.submit("one", number, label=f"number {number}") for number in range(4)]
        waiting = pool.submit("fetch", [numbers[0]])
        assert pool.result(waiting) == 0
        assert [pool.result(call) for call in numbers] == [0, 1, 2, 3]
        assert "worker 0 is slow: number" in caplog.text
        assert "a backup runs it too" in caplog.text
        caplog.clear()
        assert counter.count.restarted == 1
        assert hung not in map(pid_of, pool._workers)
        pool.close()


@pytest.mark.thorough
def test_where_the_slow_actor_is_first_its_answer_counts(
    make, counter: WorkerCounter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("services.distributed.stragglers.MIN_TIMEOUT_SECONDS", 0.5)
    pool = Pool(make, 2, listener=counter)
    list(pool.results([pool.submit("sleep", 0.01, tmp_path) for _ in range(10)]))
    for _ in range(MAX_DEATHS + 1):  # a backup that is dropped while it starts is no failure to start
        slow = pool.submit("sleep", 0.8, tmp_path)
        pid, _ = pool.result(slow)
        assert pid in map(pid_of, pool._workers)
    slow = pool.submit("sleep", 3.0, tmp_path)
    pid, _ = pool.result(slow)
    assert pid in map(pid_of, pool._workers)
    assert counter.count.restarted == 0
    pool.close()


def test_killing_all_actors_again_and_again_loses_nothing(make, counter: WorkerCounter, tmp_path: Path):
    pool = Pool(make, 2, max_in_flight=2, listener=counter)
    draw = random.Random(0)
    killed = 0
    for _ in range(4):
        calls = [pool.submit("sleep", 0.02, tmp_path, returns=2) for _ in range(10)]
        sums = [pool.submit("add", *calls[first : first + 5], returns=2) for first in (0, 5)]
        for worker in draw.sample(pool._workers, draw.choice([1, 2])):
            if worker.healthy:
                os.kill(pid_of(worker), signal.SIGKILL)
                killed += 1
        assert [ray.get(part.references[-1]) for part in sums if pool.result(part)] == [5, 5]
    assert killed >= 4
    assert 1 <= counter.count.restarted <= killed, "one that was idle may have been killed unnoticed"
    pool.close()


def test_actors_that_cannot_start_are_reported(make_broken):
    with pytest.raises(RunError, match=r"3 ended while they started.*no such thing"):
        Pool(make_broken, 1)


def test_the_death_of_an_actor_of_ones_own_is_reported(make, counter: WorkerCounter, tmp_path: Path):
    pool, own = Pool(make, 1, listener=counter), make()
    first = pool.submit("two", 1, returns=2)
    deadly = pool.submit("die", tmp_path, 1, first, actor=own)
    with pytest.raises(LostError, match="its actor died"):
        pool.result(pool.submit("one", deadly))
    assert counter.count.restarted == 0
    pool.close()


def test_an_error_in_a_call_is_reported(make):
    pool = Pool(make, 1)
    with pytest.raises(ArithmeticError, match="out of numbers"):
        pool.result(pool.submit("one", pool.submit("fail")))
    pool.close()
