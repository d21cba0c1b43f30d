"""The replicas as Ray Serve runs them, and the one shelf that they share."""

import socket
import threading
from collections.abc import Callable
from importlib import import_module
from typing import Annotated, Any, cast

import ray
import uvicorn
from pydantic import BaseModel, ConfigDict, Field
from ray import serve
from starlette.applications import Starlette

from dmil_core.errors import RunError, UserError
from dmil_core.model import load
from services.serving.application import application
from services.serving.episodes import played
from services.serving.guard import digest_of
from services.serving.limits import Limits
from services.serving.service import Service
from services.serving.shelf import Shelf
from services.serving.token import given_token

NAMESPACE, SHELF = "dmil-serving", "shelf"
"""By which replicas find the shelf."""
LOOPBACK = "127.0.0.1"
LARGEST_MESSAGE = 2**20
"""Bytes of a message of a control loop."""


class Arguments(BaseModel):
    """What is served; in ``deploy/kuberay`` the arguments of the application."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: str
    """As `dmil_core.load` takes it, on every node."""
    runs: str = "runs"
    replicas: Annotated[int, Field(ge=1)] = 2
    limits: Limits = Limits()
    port: int | None = None
    """Of 127.0.0.1, on which the replicas listen themselves; none where Ray Serve's proxies do."""
    token_digest: str = ""
    """Of the token that is asked for; of that in the environment if not given."""


class _RemoteShelf:
    """Calls the methods of the shelf in its own process."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return getattr(self._actor, name).remote


def shelf_of(limits: Limits) -> Any:
    """Return the actor of the shelf, which is started if there is none; it outlives every replica."""
    return (
        ray.remote(Shelf)
        .options(
            name=SHELF, namespace=NAMESPACE, get_if_exists=True, lifetime="detached", num_cpus=0, max_restarts=-1,
            max_task_retries=-1,
        )
        .remote(limits)
    )  # fmt: skip


class Replica:
    """One replica in a process of its own."""

    def __init__(self, arguments: Arguments) -> None:
        """Load the model, and listen if the replicas are to."""
        if ray.util.get_node_ip_address() == LOOPBACK:
            _keep_to_loopback()
        play = ray.remote(num_cpus=0, max_calls=1)(played).remote  # OpenGL goes with the process
        shelf = cast("Shelf", _RemoteShelf(shelf_of(arguments.limits)))
        service = Service(load(arguments.model, arguments.runs), shelf, arguments.limits, play)
        self._application: Any = application(service, arguments.token_digest)
        self._listener: threading.Thread | None = None
        if arguments.port is not None:
            self._listener = _listening(self._application, arguments.port)
            self._application = Starlette()  # Ray Serve itself is asked nothing

    def __serve_build_asgi_app__(self) -> Any:
        """Return what Ray Serve's proxies ask."""
        return self._application

    def check_health(self) -> None:
        """Raise if nothing listens any more: Ray Serve then starts another replica."""
        if self._listener is not None and not self._listener.is_alive():
            raise RunError("listener: got an end; wanted none")


def _keep_to_loopback() -> None:
    """Have this process's gRPC server, by which replicas of several deployments call each other, listen on loopback.

    Ray Serve would open it to the network, with Ray's token but without a setting for the address.
    """
    replica: Any = import_module("ray.serve._private.replica")
    listen = replica.add_port_to_grpc_server
    replica.add_port_to_grpc_server = lambda server, address: listen(server, f"{LOOPBACK}:0")


def _listening(application: Any, port: int) -> threading.Thread:
    """Answer requests in a thread, on a port that all replicas of this user listen on: the kernel deals them out."""
    listener = socket.socket()
    for option in (socket.SO_REUSEADDR, socket.SO_REUSEPORT):
        listener.setsockopt(socket.SOL_SOCKET, option, 1)
    listener.bind((LOOPBACK, port))
    config = uvicorn.Config(
        application, loop="uvloop", http="httptools", ws_max_size=LARGEST_MESSAGE, ws_per_message_deflate=False,
        log_config=None, access_log=False, server_header=False, lifespan="on",
    )  # fmt: skip
    thread = threading.Thread(
        target=uvicorn.Server(config).run, kwargs={"sockets": [listener]}, name="listener", daemon=True
    )
    thread.start()
    return thread


def built(arguments: Arguments) -> serve.Application:
    """Return the application for Ray Serve; in ``deploy/kuberay`` its ``import_path``.

    Raises:
        UserError: if there is no token.
    """
    digest = arguments.token_digest or digest_of(given_token() or "")
    if digest == digest_of(""):
        raise UserError("DMIL_SERVE_TOKEN: got none; wanted the token that clients are to send")
    deployment: Any = serve.deployment(
        serve.ingress()(Replica), name="replica", num_replicas=arguments.replicas,
        max_ongoing_requests=2 * arguments.limits.requests, ray_actor_options={"num_cpus": 1},
        health_check_period_s=2, health_check_timeout_s=10, graceful_shutdown_timeout_s=2,
    )  # fmt: skip
    return deployment.bind(arguments.model_copy(update={"token_digest": digest}))
