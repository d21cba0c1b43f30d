"""What the service does, without HTTP: adapts, keeps policies where all replicas find them, and acts."""

import asyncio
import contextlib
import functools
import hashlib
import logging
import time
import uuid
import weakref
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from dmil_core.adapted_policy import AdaptedPolicy
from dmil_core.errors import UserError, shorten
from dmil_core.methods.base import Decision
from dmil_core.model import DivergedError, Model
from dmil_core.recorded import Interface
from dmil_core.settings import sub_skills_of
from services.serving.bodies import Described
from services.serving.episodes import played
from services.serving.limits import Limits
from services.serving.metrics import Metrics
from services.serving.packing import unpacked
from services.serving.policies import Arrays, FieldError, act, adapted
from services.serving.shelf import Gone, Kept, Shelf
from services.storage.redaction import error_line
from services.suites.registry import open_suite

logger = logging.getLogger(__name__)

ID_DIGITS = 32
"""Of a policy's id."""
FEW_ROWS = 16
"""So many observations are acted on at once; more are left to a thread."""


class BusyError(Exception):
    """More adaptations at once than a replica takes."""


class MissingError(Exception):
    """A policy that is not there."""

    def __init__(self, name: str, gone: Gone | None) -> None:
        why = "which no demonstrations were posted for" if gone is None else f"gone: {gone.why}"
        super().__init__(f"id: got {shorten(name)}, {why}; wanted one that is there: POST its demonstrations")
        self.gone = gone is not None


@dataclass(eq=False)
class Held:
    """A policy in this replica, ready to act."""

    policy: AdaptedPolicy
    expires: float
    """Seconds since 1970."""
    removed: bool = field(default=False)

    @property
    def usable(self) -> bool:
        """Whether it may act still."""
        return not self.removed and time.time() < self.expires


class Posted(NamedTuple):
    """A policy that was asked for."""

    info: dict[str, Any]
    new: bool
    """Whether it was adapted now."""


class Service:
    """One replica: a model, and the shelf that all share.

    Whatever is asked of several at once happens in the order of their event loop; only adapting, and acting on many
    observations, is left to threads.
    """

    def __init__(
        self, model: Model, shelf: Shelf, limits: Limits, play: Callable[..., Awaitable[dict[str, Any]]] | None = None
    ) -> None:
        """Begin without a policy.

        `play` does what `played` does, in another process; a thread of this one if not given.
        """
        self._play = play or functools.partial(asyncio.to_thread, played)
        self.model, self.limits, self.metrics = model, limits, Metrics()
        self.name = uuid.uuid4().hex
        self._shelf = shelf
        checkpoint = model.checkpoint
        self.digest = checkpoint.digest
        method = checkpoint.method(len(checkpoint.actions))
        manifest = checkpoint.manifest.model_copy(update={"actions": checkpoint.actions})
        self.interface = Interface.of(manifest, method)
        self._ready: OrderedDict[str, Held] = OrderedDict()
        self._held: weakref.WeakValueDictionary[str, Held] = weakref.WeakValueDictionary()
        self._removals = 0
        self._adaptations = 0
        self._one_at_a_time = asyncio.Lock()
        self._playing = False

    @functools.cached_property
    def described(self) -> Described:
        """The model in words and numbers."""
        config, interface = self.model.checkpoint.manifest.config, self.interface
        return Described(
            model=self.digest,
            method=config.method.name,
            suite=config.suite.name,
            obs_dim=interface.obs_dim,
            action_dim=interface.action_dim,
            low=list(interface.actions.low),
            high=list(interface.actions.high),
            sub_skills=sub_skills_of(config.method),
            trained_on=interface.trained_on,
            steps=self.model.fine_tuning.steps,
            learning_rate=self.model.fine_tuning.learning_rate,
            tasks=self._tasks,
        )

    @property
    def _tasks(self) -> list[str]:
        suite = self.model.checkpoint.manifest.config.suite
        with contextlib.suppress(UserError):
            opened = open_suite(suite)
            return [*opened.train_tasks, *opened.test_tasks]
        return []

    async def follow_removals(self) -> None:
        """Forget at once what another replica removes; to be run beside all else."""
        version = 0
        while True:
            try:
                version, removed = await self._shelf.removals(self.name, version)
            except Exception as error:  # noqa: BLE001  whatever Ray raises while the shelf starts anew
                logger.warning(f"the shelf of policies does not answer ({error_line(error)}); asking it again")
                removed = None
                await asyncio.sleep(1.0)
            for name in list(self._held) if removed is None else removed:
                self._forget(name)

    def _forget(self, name: str) -> None:
        self._removals += 1
        self._ready.pop(name, None)
        if (held := self._held.pop(name, None)) is not None:
            held.removed = True

    async def adapt(self, recorded: Sequence[Arrays], steps: int | None, learning_rate: float | None) -> Posted:
        """Return the policy for what was demonstrated; where it is there already, its time to live begins anew.

        Raises:
            FieldError: for what is no demonstration of such a robot, or adaptation that diverges.
            BusyError: if too many wait already.
        """
        steps = self.model.fine_tuning.steps if steps is None else steps
        rate = self.model.fine_tuning.learning_rate if learning_rate is None else learning_rate
        self._check(recorded, steps)
        name = self._name_of(recorded, steps, rate)
        if kept := await self._shelf.renew(name):
            return Posted(_with_expiry(kept), new=False)
        if self._adaptations >= self.limits.adaptations:
            self.metrics.adaptations.labels("refused").inc()
            raise BusyError
        self._adaptations += 1
        try:
            async with self._one_at_a_time:
                if kept := await self._shelf.renew(name):
                    return Posted(_with_expiry(kept), new=False)
                return await self._adapted(name, recorded, steps, rate)
        finally:
            self._adaptations -= 1

    async def _adapted(self, name: str, recorded: Sequence[Arrays], steps: int, rate: float) -> Posted:
        began, before = time.perf_counter(), self._removals
        try:
            policy, content, info = await asyncio.to_thread(adapted, self.model, self.digest, recorded, steps, rate)
        except DivergedError as error:
            self.metrics.adaptations.labels("diverged").inc()
            raise FieldError(str(error), "body", "learning_rate") from error
        except UserError as error:
            self.metrics.adaptations.labels("refused").inc()
            raise FieldError(str(error), "body", "demonstrations") from error
        self.metrics.adaptations.labels("done").inc()
        self.metrics.adaptation_seconds.observe(time.perf_counter() - began)
        kept = await self._shelf.put(name, {"id": name, **info}, content)
        if kept is None:
            raise FieldError(
                f"demonstrations: got a policy of {len(content)} bytes with them; wanted at most the "
                f"{self.limits.megabytes:g} MB of all: send fewer",
                "body", "demonstrations",
            )  # fmt: skip
        self._hold(name, Held(policy, kept.expires), before)
        return Posted(_with_expiry(kept), new=True)

    def _check(self, recorded: Sequence[Arrays], steps: int) -> None:
        """See whether shapes and counts are those of the model."""
        if len(recorded) > self.limits.demonstrations:
            raise FieldError(
                f"demonstrations: got {len(recorded)}; wanted at most {self.limits.demonstrations}",
                "body", "demonstrations",
            )  # fmt: skip
        if steps > self.limits.steps:
            raise FieldError(f"steps: got {steps}; wanted at most {self.limits.steps}", "body", "steps")
        interface = self.interface
        for number, (observations, actions) in enumerate(recorded):
            where = "body", "demonstrations", number
            for name, values, wanted in (
                ("observations", observations, interface.obs_dim),
                ("actions", actions, interface.action_dim),
            ):
                if values.ndim != 2 or values.shape[1] != wanted:
                    raise FieldError(
                        f"{name}: got the shape {values.shape}; wanted (steps, {wanted}), {interface.trained_on}",
                        *where, name,
                    )  # fmt: skip
                if not np.isfinite(values).all():
                    raise FieldError(f"{name}: got numbers beyond float32; wanted real ones", *where, name)
            if len(observations) - len(actions) not in (0, 1):
                raise FieldError(
                    f"actions: got {len(actions)} steps for {len(observations)} of observations; wanted as many",
                    *where, "actions",
                )  # fmt: skip

    def _name_of(self, recorded: Sequence[Arrays], steps: int, rate: float) -> str:
        """Return what names a policy: the same model, demonstrations and settings give the same."""
        sha = hashlib.sha256(repr((self.digest, steps, rate, len(recorded))).encode())
        for observations, actions in recorded:
            for values in (observations[: len(actions)], actions):
                sha.update(repr(values.shape).encode())
                sha.update(np.ascontiguousarray(values).data)
        return sha.hexdigest()[:ID_DIGITS]

    async def held(self, name: str) -> Held:
        """Return a policy, which is fetched from the shelf if this replica does not hold it.

        Raises:
            MissingError: if it is not there.
        """
        held = self._held.get(name)
        if held is not None and held.usable:
            if name in self._ready:
                self._ready.move_to_end(name)
            return held
        before = self._removals
        found = await self._shelf.get(name)
        if not isinstance(found, Kept):
            raise MissingError(name, found)
        policy = held.policy if held is not None else await asyncio.to_thread(unpacked, found.content)
        held = Held(policy, found.expires)
        self._hold(name, held, before)
        return held

    def _hold(self, name: str, held: Held, before: int) -> None:
        """Keep a policy at hand, unless something was removed since `before`: it may have been this one."""
        if self._removals != before:
            return
        self._held[name] = self._ready[name] = held
        self._ready.move_to_end(name)
        while len(self._ready) > self.limits.cached:
            self._ready.popitem(last=False)

    async def info(self, name: str) -> dict[str, Any]:
        """Return what is known of a policy.

        Raises:
            MissingError: if it is not there.
        """
        found = await self._shelf.get(name, content=False)
        if not isinstance(found, Kept):
            raise MissingError(name, found)
        return _with_expiry(found)

    async def all(self) -> list[dict[str, Any]]:
        """Return what is known of all policies."""
        return [_with_expiry(kept) for kept in await self._shelf.all()]

    async def delete(self, name: str) -> None:
        """Remove a policy from all replicas.

        Raises:
            MissingError: if it is not there.
        """
        found = await self._shelf.delete(name)
        self._forget(name)
        if not isinstance(found, Kept):
            raise MissingError(name, found)

    async def act(
        self, held: Held, rows: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes _"] | None
    ) -> Decision:
        """Return what the function `act` does, of many rows in a thread."""
        if len(rows) <= FEW_ROWS:
            return act(held.policy, rows, memory)
        return await asyncio.to_thread(act, held.policy, rows, memory)

    async def play(self, name: str, task: str, episode: int) -> dict[str, Any]:
        """Let a policy act in an episode of the suite that the model is of, one at a time in a replica.

        Raises:
            MissingError: if the policy is not there.
            FieldError: if the task is not.
            BusyError: if another episode is played.
        """
        found = await self._shelf.get(name)
        if not isinstance(found, Kept):
            raise MissingError(name, found)
        if task not in (tasks := self.described.tasks):
            wanted = f"one of {', '.join(tasks)}" if tasks else "none: the suite is not installed here"
            raise FieldError(f"task: got {shorten(task)}; wanted {wanted}", "body", "task")
        if self._playing:
            raise BusyError
        self._playing = True
        try:
            config = self.model.checkpoint.manifest.config
            return await self._play(found.content, config.suite, task, episode, config.seed)
        finally:
            self._playing = False

    async def figures(self) -> bytes:
        """Return the figures of all replicas in Prometheus' format."""
        totals = await self._shelf.totals(self.name, self.metrics.samples())
        policies, size = await self._shelf.size()
        return self.metrics.text(totals, policies=policies, policy_bytes=size)

    async def report_figures(self, seconds: float) -> None:
        """Tell the shelf every some seconds what was counted here; to be run beside all else."""
        while True:
            await asyncio.sleep(seconds)
            with contextlib.suppress(Exception):
                await self._shelf.totals(self.name, self.metrics.samples())


def _with_expiry(kept: Kept) -> dict[str, Any]:
    return {**kept.info, "expires_at": datetime.fromtimestamp(kept.expires, UTC).isoformat()}
