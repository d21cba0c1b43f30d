"""What all replicas share: how long it is kept, what makes room, and who hears of it."""

import asyncio
from collections.abc import Callable

import pytest

from services.serving.limits import Limits
from services.serving.shelf import EVICTED, EXPIRED, MOST_GONE, Gone, Kept, Shelf
from tests.services.serving.loops import run_apart


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def shelf(clock: Callable[[], float]) -> Shelf:
    return Shelf(Limits(policies=10, megabytes=10e-6, hours=1), clock)


def test_a_policy_lives_for_its_time_from_when_it_was_posted_last(shelf: Shelf, clock: Clock):
    async def check() -> None:
        await shelf.put("a", {}, b"1234")
        clock.now = 3000
        kept = await shelf.put("a", {}, b"1234")
        assert kept is not None
        assert kept.expires == 6600
        clock.now = 6599
        assert await shelf.get("a") == Kept({}, b"1234", 6600)
        clock.now = 6600
        assert await shelf.get("a") == Gone(EXPIRED)
        assert await shelf.size() == (0, 0)

    run_apart(check())


def test_bytes_make_room_and_what_is_larger_than_all_is_not_kept(shelf: Shelf):
    async def check() -> None:
        for name in "abc":
            await shelf.put(name, {}, b"1234")
        assert await shelf.get("a") == Gone(EVICTED)
        assert await shelf.size() == (2, 8)
        assert await shelf.put("d", {}, b"12345678901") is None
        assert await shelf.size() == (2, 8)

    run_apart(check())


def test_removals_are_heard_of_at_once_and_a_replica_of_another_shelf_forgets_all(shelf: Shelf):
    async def check() -> None:
        await shelf.put("a", {}, b"")
        asked = asyncio.create_task(shelf.removals("replica", 0))
        await asyncio.sleep(0)
        removal = asyncio.create_task(shelf.delete("a"))
        assert await asked == (1, ["a"])
        assert not removal.done()  # until the replica has done what it heard
        asked = asyncio.create_task(shelf.removals("replica", 1))
        assert isinstance(await removal, Kept)
        asked.cancel()
        assert await shelf.removals("replica", 57) == (1, None)

    run_apart(check())


def test_of_what_is_long_gone_nothing_is_known(shelf: Shelf):
    async def check() -> None:
        for number in range(2 * MOST_GONE + 2):
            await shelf.put(str(number), {}, b"1234567890")
        assert await shelf.get("0") is None
        assert await shelf.get(str(2 * MOST_GONE)) == Gone(EVICTED)
        assert (await shelf.removals("replica", 0)).ids is None

    run_apart(check())
