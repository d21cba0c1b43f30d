"""The policies that all replicas share: a quota, a time to live, and for each that is gone why."""

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from services.serving.limits import Limits

MOST_GONE = 10_000
"""Policies of which it is remembered why they are gone."""
POLL_SECONDS = 10.0
"""A replica that asks what was removed is answered at the latest after so long."""
REMOVAL_SECONDS = 0.5
"""A removal is over when all replicas know of it, or after so long: one that was killed never will."""

DELETED = "deleted"
EXPIRED = "its time to live is over"
EVICTED = "evicted for want of room"


class Kept(NamedTuple):
    """A policy on the shelf."""

    info: Mapping[str, Any]
    content: bytes
    """As `packed` makes it; empty where only the rest was asked for."""
    expires: float
    """Seconds since 1970."""


class Gone(NamedTuple):
    """A policy that is no longer there."""

    why: str


class Removals(NamedTuple):
    """What was removed since a replica asked last."""

    version: int
    """To ask with next time."""
    ids: list[str] | None
    """None where it is not known any more: whatever the replica has may be gone."""


class Shelf:
    """Holds packed policies by their ids; a Ray actor for the replicas, an object like others for tests.

    Policies lie in the order in which they were posted last, which is that in which they expire and are evicted.
    """

    def __init__(self, limits: Limits, clock: Callable[[], float] = time.time) -> None:
        self._limits, self._clock = limits, clock
        self._kept: OrderedDict[str, Kept] = OrderedDict()
        self._gone: OrderedDict[str, str] = OrderedDict()
        self._bytes = 0
        self._removed: list[str] = []
        self._forgotten = 0
        self._seen: dict[str, tuple[int, float]] = {}
        self._changed = asyncio.Condition()
        self._samples: dict[str, Mapping[Any, float]] = {}

    async def put(self, name: str, info: Mapping[str, Any], content: bytes) -> Kept | None:
        """Keep a policy, and evict others for it; return it, or None if it is larger than all room there is."""
        room = int(self._limits.megabytes * 1e6)
        if len(content) > room:
            return None
        self._expire()
        if name in self._kept:
            return await self.renew(name)
        while self._kept and (len(self._kept) >= self._limits.policies or self._bytes + len(content) > room):
            self._remove(next(iter(self._kept)), EVICTED)
        self._gone.pop(name, None)
        self._bytes += len(content)
        kept = self._kept[name] = Kept(info, content, self._clock() + 3600 * self._limits.hours)
        await self._notify()
        return kept._replace(content=b"")

    async def renew(self, name: str) -> Kept | None:
        """Begin the time to live of a policy anew; None if it is not there."""
        self._expire()
        if name not in self._kept:
            return None
        self._kept.move_to_end(name)
        kept = self._kept[name] = self._kept[name]._replace(expires=self._clock() + 3600 * self._limits.hours)
        return kept._replace(content=b"")

    async def get(self, name: str, *, content: bool = True) -> Kept | Gone | None:
        """Return a policy, or why it is gone; None if it never was there, or that is forgotten."""
        self._expire()
        if kept := self._kept.get(name):
            return kept if content else kept._replace(content=b"")
        return Gone(self._gone[name]) if name in self._gone else None

    async def all(self) -> list[Kept]:
        """Return all policies without their content, the one posted longest ago first."""
        self._expire()
        return [kept._replace(content=b"") for kept in self._kept.values()]

    async def delete(self, name: str) -> Kept | Gone | None:
        """Remove a policy, and return what was there; when it returns, no replica acts with it any more."""
        found = await self.get(name, content=False)
        if isinstance(found, Kept):
            self._remove(name, DELETED)
            await self._notify()
            await self._acknowledged(self._version)
        return found

    async def removals(self, replica: str, since: int) -> Removals:
        """Return what was removed since a version, as soon as anything is; by asking, a replica says what it knows.

        The version is the one that it was answered last, 0 at first.
        """
        self._seen[replica] = since, self._clock()
        await self._notify()
        async with self._changed:
            try:
                await asyncio.wait_for(self._changed.wait_for(lambda: self._version != since), POLL_SECONDS)
            except TimeoutError:
                self._expire()
        known = self._forgotten <= since <= self._version
        return Removals(self._version, self._removed[since - self._forgotten :] if known else None)

    async def totals(self, replica: str, samples: Mapping[Any, float]) -> dict[Any, float]:
        """Take the figures that a replica has counted so far, and return the sums over all that there ever were."""
        self._samples[replica] = samples
        sums: dict[Any, float] = {}
        for counted in self._samples.values():
            for key, value in counted.items():
                sums[key] = sums.get(key, 0.0) + value
        return sums

    async def size(self) -> tuple[int, int]:
        """Return how many policies there are, and their bytes."""
        self._expire()
        return len(self._kept), self._bytes

    @property
    def _version(self) -> int:
        return self._forgotten + len(self._removed)

    def _expire(self) -> None:
        while self._kept and next(iter(self._kept.values())).expires <= self._clock():
            self._remove(next(iter(self._kept)), EXPIRED)

    def _remove(self, name: str, why: str) -> None:
        self._bytes -= len(self._kept.pop(name).content)
        self._gone[name] = why
        self._gone.move_to_end(name)
        self._removed.append(name)
        if len(self._gone) > MOST_GONE:
            self._gone.popitem(last=False)
        if len(self._removed) > 2 * MOST_GONE:
            del self._removed[:MOST_GONE]
            self._forgotten += MOST_GONE

    async def _notify(self) -> None:
        async with self._changed:
            self._changed.notify_all()

    async def _acknowledged(self, version: int) -> None:
        """Wait until every replica that still asks has been answered with a version."""

        def known() -> bool:
            alive = self._clock() - 2 * POLL_SECONDS
            return all(since >= version for since, at in self._seen.values() if at > alive)

        async with self._changed:
            try:
                await asyncio.wait_for(self._changed.wait_for(known), REMOVAL_SECONDS)
            except TimeoutError:
                self._seen = {name: seen for name, seen in self._seen.items() if seen[0] >= version}
