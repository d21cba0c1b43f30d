"""The service under load on this machine: how long an action takes, and what comes of replicas that are killed.

It starts `services.serve`, asks it as robots would, and compares every action with that of the same policy here. First
actions are asked for at a fixed rate, then a control loop goes as fast as it can; then, for --mixed-seconds, actions,
adaptations, removals and mistakes come together while a replica is killed every now and then. Whoever asks repeats a
request whose connection broke: each may be.
"""

import asyncio
import os
import random
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import aiohttp
import numpy as np
import psutil

from benchmarks.harness import BenchmarkArguments, Row, lay_out, main
from dmil_core.adapted_policy import AdaptedPolicy
from dmil_core.errors import RunError
from dmil_core.model import Model, load
from services.cli.progress import console

STEPS = 50
"""Of each demonstration, and of adaptation."""
TARGETS = {"act": (4.0, 20.0), "control loop": (2.0, None)}
"""Milliseconds at the median and at the 99th percentile."""
REPEATS = 600
"""Of a request whose connection breaks, 0.1 s after each other: a replica is back by then."""


@dataclass(frozen=True)
class Arguments(BenchmarkArguments):
    """Arguments of ``benchmarks.serving``."""

    model: str = "ml10"
    """As `services.serve` takes it."""
    replicas: int = 2
    """Of the service."""
    rate: float = 200.0
    """Requests for an action in a second."""
    seconds: float = 20.0
    """At this rate, and of the control loop."""
    connections: int = 16
    """Over which they come."""
    mixed_seconds: float = 0.0
    """Of the mixed load; 1800 is what is promised."""
    kill_seconds: float = 60.0
    """From one replica that is killed to the next."""


class Posted(NamedTuple):
    """A policy of the service, and the same one here."""

    body: dict[str, Any]
    policy: AdaptedPolicy
    id: str


class Client:
    """Asks the service, and counts what comes of it."""

    def __init__(self, session: aiohttp.ClientSession) -> None:
        self._session = session
        self.counts: Counter[str] = Counter()

    async def ask(self, method: str, path: str, body: Any = None) -> tuple[int, Any]:
        """Return status and content of an answer; repeat what a broken connection leaves without one."""
        for _ in range(REPEATS):
            try:
                async with self._session.request(method, path, json=body) as answer:
                    return answer.status, await answer.json() if answer.status != 204 else None
            except (aiohttp.ClientConnectionError, aiohttp.ClientPayloadError):
                self.counts["repeated"] += 1
                await asyncio.sleep(0.1)
        raise RunError(f"{path}: got no answer in {REPEATS} tries; wanted one")

    async def act(self, posted: Posted, observation: np.ndarray, wanted: np.ndarray) -> None:
        """Ask for an action, and compare it."""
        status, content = await self.ask(
            "POST", f"/v1/policies/{posted.id}/act", {"observations": observation.tolist()}
        )
        right = status == 200 and np.array_equal(np.array(content["actions"], np.float32), wanted)
        self.counts["right" if right else "refused" if status == 429 else "wrong"] += 1

    async def expect(self, wanted: int, method: str, path: str, body: Any = None) -> None:
        """Ask for what is answered in one way only, or refused for now."""
        status, _ = await self.ask(method, path, body)
        self.counts["right" if status == wanted else "refused" if status == 429 else "wrong"] += 1


def run(args: Arguments) -> Sequence[Row]:
    """Run the benchmark."""
    model, token = load(args.model), secrets.token_hex(32)
    with serving(args, token) as (address, program):
        rows = asyncio.run(_measure(args, model, address, token, program))
    heads = list(dict.fromkeys(key for row in rows for key in row))
    cells = [{head: _cell(row.get(head, "")) for head in heads} for row in rows]
    console.print(lay_out(f"the service, {args.replicas} replicas, load average {os.getloadavg()[0]:.1f}", cells))
    return rows


def _cell(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


@contextmanager
def serving(args: Arguments, token: str) -> Iterator[tuple[str, psutil.Process]]:
    """Have the service run; yield its address and its process.

    Raises:
        RunError: if it does not start.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    flags = ["--port", str(port), "--replicas", str(args.replicas)]
    command = [sys.executable, "-m", "services.serve", args.model, *flags]
    environment = os.environ | {"DMIL_SERVE_TOKEN": token}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        if not any("serving;" in line for line in program.stdout):
            raise RunError(f"{' '.join(command)}: ended with {program.wait()}; wanted it to serve")
        try:
            yield f"http://127.0.0.1:{port}", psutil.Process(program.pid)
        finally:
            program.terminate()


async def _measure(
    args: Arguments, model: Model, address: str, token: str, program: psutil.Process
) -> Sequence[dict[str, Any]]:
    connector = aiohttp.TCPConnector(limit=args.connections)
    header = {"Authorization": f"Bearer {token}"}
    async with aiohttp.ClientSession(address, connector=connector, headers=header) as session:
        client = Client(session)
        posted = await _post(client, model, seed=0)
        observations = np.array(posted.body["demonstrations"][0]["observations"], np.float32)
        actions = [_fresh(posted.policy, observation) for observation in observations]

        async def act(number: int) -> None:
            await client.act(posted, observations[number % STEPS], actions[number % STEPS])

        await _at_rate(act, args.rate, 1.0)  # connections are opened, and the policy reaches every replica
        rows = [_row("act", await _at_rate(act, args.rate, args.seconds), client)]
        client.counts.clear()
        rows.append(_row("control loop", await _control(session, posted, args.seconds, client), client))
        if args.mixed_seconds:
            rows.append(await _mixed(args, model, client, program))
        return rows


async def _post(client: Client, model: Model, seed: int) -> Posted:
    """Post a demonstration that is drawn from what meta-training saw."""
    manifest = model.checkpoint.manifest
    rng, seen, bounds = np.random.default_rng(seed), manifest.observed, model.checkpoint.actions
    assert seen is not None
    observations = rng.uniform(seen.low, seen.high, (STEPS, len(seen)))
    actions = rng.uniform(bounds.low, bounds.high, (STEPS, len(bounds)))
    body = {
        "demonstrations": [{"observations": observations.tolist(), "actions": actions.tolist()}],
        "steps": STEPS, "learning_rate": 1e-4,
    }  # fmt: skip
    policy = await asyncio.to_thread(model.adapt, [(observations, actions)], steps=STEPS, learning_rate=1e-4)
    status, content = await client.ask("POST", "/v1/policies", body)
    while status == 429:
        await asyncio.sleep(1.0)
        status, content = await client.ask("POST", "/v1/policies", body)
    if status not in (200, 201):
        raise RunError(f"POST /v1/policies: got {status}, {content}; wanted 201")
    return Posted(body, policy, content["id"])


def _fresh(policy: AdaptedPolicy, observation: np.ndarray) -> np.ndarray:
    policy.reset()
    return policy(observation)


async def _at_rate(ask: Callable[[int], Awaitable[None]], rate: float, seconds: float) -> list[float]:
    """Ask at a fixed rate, whether answers come or not; return how long each took from when it was due."""
    took: list[float] = []
    began = time.perf_counter()

    async def timed(number: int) -> None:
        await ask(number)
        took.append(time.perf_counter() - began - number / rate)

    async with asyncio.TaskGroup() as group:
        for number in range(int(rate * seconds)):
            await asyncio.sleep(max(0.0, began + number / rate - time.perf_counter()))
            group.create_task(timed(number))
    return took


async def _control(session: aiohttp.ClientSession, posted: Posted, seconds: float, client: Client) -> list[float]:
    """Step through a demonstration again and again, as fast as answers come; return how long each step took."""
    observations, took = posted.body["demonstrations"][0]["observations"], []
    posted.policy.reset()
    actions = [posted.policy(np.array(observation, np.float32)) for observation in observations]
    async with session.ws_connect(f"/v1/policies/{posted.id}/control") as loop:
        ends = time.perf_counter() + seconds
        while time.perf_counter() < ends:
            for number, (observation, wanted) in enumerate(zip(observations, actions, strict=True)):
                began = time.perf_counter()
                await loop.send_json({"observation": observation, "reset": number == 0})
                answer = await loop.receive_json()
                took.append(time.perf_counter() - began)
                right = np.array_equal(np.array(answer["action"], np.float32), wanted)
                client.counts["right" if right else "wrong"] += 1
    return took


def _row(what: str, took: Sequence[float], client: Client) -> dict[str, Any]:
    median, high = (float(value) for value in np.percentile(1000 * np.array(took), (50, 99)))
    wanted_median, wanted_high = TARGETS[what]
    return {
        "what": what, "p50_ms": median, "p50_target_ms": wanted_median, "p99_ms": high, "p99_target_ms": wanted_high,
        **_counted(client),
    }  # fmt: skip


def _counted(client: Client) -> dict[str, int]:
    return {name: client.counts[name] for name in ("right", "refused", "repeated", "wrong")}


async def _mixed(args: Arguments, model: Model, client: Client, program: psutil.Process) -> dict[str, Any]:
    """Ask for all sorts of things while replicas are killed."""
    client.counts.clear()
    policies = [await _post(client, model, seed) for seed in range(1, 5)]
    before, ends = _megabytes(program), time.monotonic() + args.mixed_seconds
    rng = random.Random(0)

    async def acting() -> None:
        while time.monotonic() < ends:
            posted = rng.choice(policies)
            observation = np.array(rng.choice(posted.body["demonstrations"][0]["observations"]), np.float32)
            await client.act(posted, observation, _fresh(posted.policy, observation))
            await asyncio.sleep(0.05)

    async def adapting() -> None:
        while time.monotonic() < ends:
            passing = await _post(client, model, rng.randrange(100, 2**31))
            observation = np.array(passing.body["demonstrations"][0]["observations"][0], np.float32)
            await client.act(passing, observation, _fresh(passing.policy, observation))
            status, _ = await client.ask("DELETE", f"/v1/policies/{passing.id}")
            client.counts["right" if status in (204, 410) else "wrong"] += 1  # 410: asked twice
            await client.expect(410, "POST", f"/v1/policies/{passing.id}/act", {"observations": observation.tolist()})
            await asyncio.sleep(1.0)

    async def mistaken() -> None:
        while time.monotonic() < ends:
            address = f"/v1/policies/{policies[0].id}/act"
            await client.expect(422, "POST", address, {"observations": ["far"]})
            await client.expect(404, "GET", "/v1/policies/never")
            await client.expect(422, "POST", "/v1/policies", {"demonstrations": []})
            await asyncio.sleep(0.5)

    killed = 0
    async with asyncio.TaskGroup() as group:
        for work in (acting, acting, adapting, mistaken):
            group.create_task(work())
        while time.monotonic() < ends:
            await asyncio.sleep(max(0.0, min(args.kill_seconds, ends - time.monotonic())))
            if time.monotonic() < ends and (replicas := _replicas(program)):
                os.kill(rng.choice(replicas).pid, signal.SIGKILL)
                killed += 1
    row = {"what": f"mixed, {args.mixed_seconds:.0f} s", **_counted(client), "killed": killed}
    return row | {"mb_before": before, "mb_after": _megabytes(program)}


def _replicas(program: psutil.Process) -> list[psutil.Process]:
    return [child for child in program.children(recursive=True) if "ServeReplica" in " ".join(child.cmdline())]


def _megabytes(program: psutil.Process) -> float:
    """Return the memory of the replicas and the shelf, which each takes for itself."""
    names = "ServeReplica", "Shelf"
    children = [c for c in program.children(recursive=True) if any(name in " ".join(c.cmdline()) for name in names)]
    return sum(child.memory_full_info().uss for child in children) / 1e6


if __name__ == "__main__":
    main(run, Arguments(), __doc__)
