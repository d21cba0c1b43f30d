"""What stands before the application: the token, the size of a body, how many requests at once; and the count of all.

Plain ASGI, for it is on the way of each action.
"""

import hmac
import json
import time
from collections.abc import Awaitable, Callable, MutableMapping
from hashlib import sha256
from typing import Any

from starlette.exceptions import HTTPException

from services.serving.limits import Limits
from services.serving.metrics import Metrics

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

OPEN = {"/", "/healthz"}
"""Paths that need no token: a page without anything of the service in it, and that a replica answers."""
RETRY_AFTER = (b"retry-after", b"1")


def digest_of(token: str) -> str:
    """Return what a replica knows of the token."""
    return sha256(token.encode()).hexdigest()


class Guard:
    """Lets requests through to an application."""

    def __init__(self, application: Application, token_digest: str, limits: Limits, metrics: Metrics) -> None:
        """Take `digest_of` the token."""
        self._application, self._token, self._limits, self._metrics = application, token_digest, limits, metrics
        self._running = 0
        self._sockets = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, open a control loop, or refuse either."""
        if scope["type"] == "lifespan":
            return await self._application(scope, receive, send)
        refusal = self._refusal(scope)
        if scope["type"] == "websocket":
            if refusal:
                return await _refuse(send, *refusal, prefix="websocket.http.response.")
            self._sockets += 1
            try:
                return await self._application(scope, receive, send)
            finally:
                self._sockets -= 1
        began, status = time.perf_counter(), 500

        async def counted(message: MutableMapping[str, Any]) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        self._running += 1
        try:
            if refusal:
                await _refuse(counted, *refusal)
            else:
                await self._application(scope, self._measured(receive), counted)
        finally:
            self._running -= 1
            route = getattr(scope.get("route"), "path", "none")
            method = scope["method"] if scope["method"] in ("GET", "POST", "DELETE") else "other"
            self._metrics.answered(route, method, status, time.perf_counter() - began)

    def _refusal(self, scope: Scope) -> tuple[int, str, list[tuple[bytes, bytes]]] | None:
        """Return status, reason and headers of the answer to a request that is not let through."""
        headers = dict(scope["headers"])
        if scope["path"] not in OPEN:
            scheme, _, token = headers.get(b"authorization", b"").decode("latin-1").strip().partition(" ")
            given = digest_of(token.strip())
            if scheme.lower() != "bearer" or not hmac.compare_digest(given, self._token):
                wanted = "Authorization: got no token, or another; wanted Bearer and the token of this service"
                return 401, wanted, [(b"www-authenticate", b"Bearer")]
        websocket = scope["type"] == "websocket"
        running, most = (self._sockets, self._limits.sockets) if websocket else (self._running, self._limits.requests)
        if running >= most:
            what = "control loops" if websocket else "requests"
            return 429, f"got {running} {what} at once; wanted at most {most}; try again", [RETRY_AFTER]
        length = headers.get(b"content-length", b"0")
        if length.isdigit() and (len(length) > 18 or int(length) > self._limits.body):
            return 413, self._too_large(length.decode()), [(b"connection", b"close")]
        return None

    def _measured(self, receive: Receive) -> Receive:
        """Return what receives a body that may come in pieces without its length being named before."""
        received = 0

        async def measured() -> MutableMapping[str, Any]:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > self._limits.body:
                raise HTTPException(413, self._too_large("more"), {"connection": "close"})
            return message

        return measured

    def _too_large(self, got: str) -> str:
        most = self._limits.body
        return f"body: got {got[:20]} bytes; wanted at most {most}; send fewer demonstrations, or every second step"


async def _refuse(
    send: Send, status: int, detail: str, headers: list[tuple[bytes, bytes]], prefix: str = "http.response."
) -> None:
    content = json.dumps({"detail": detail}).encode()
    length = (b"content-length", str(len(content)).encode())
    start = [(b"content-type", b"application/json"), length, *headers]
    await send({"type": f"{prefix}start", "status": status, "headers": start})
    await send({"type": f"{prefix}body", "body": content})
