"""Serve a model over HTTP, on this machine alone: demonstrations in, actions out, behind a token; docs/serving.md.

The token comes from DMIL_SERVE_TOKEN, from the file that DMIL_SERVE_TOKEN_PATH names, or else lies in FOLDER/token.
"""

import logging
import signal
import socket
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from dmil_core.errors import RunError, UserError
from dmil_core.files import read_file
from services.cli.arguments import exit_code, parse
from services.cli.progress import console
from services.distributed.cluster import joined, named_address
from services.serving.guard import digest_of
from services.serving.limits import Limits
from services.serving.token import MOST_BYTES, TOKEN, TOKEN_PATH, given_token
from services.storage.private import private_token
from services.storage.redaction import error_line, redacted

NAME = "dmil"
"""Of the application in Ray Serve."""


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``serve``."""

    model: Annotated[str, tyro.conf.Positional]
    """A run's name, its folder or that of a checkpoint, or models:/NAME@champion."""
    port: int = 8000
    """Of 127.0.0.1, to listen on."""
    replicas: int = 2
    """Processes that answer; each takes a CPU."""
    limits: Limits = field(default_factory=Limits)
    """What the service bears."""
    folder: Path = Path("serving")
    """For the token, if the environment gives none."""
    runs: Path = Path("runs")
    """The folder that runs' own folders are in."""


def run(arguments: Sequence[str]) -> None:
    """Run the program, until it is stopped."""
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    if args.replicas < 1:
        raise UserError(f"--replicas: got {args.replicas}; wanted at least 1")
    from dmil_core.model import load

    model = load(args.model, args.runs)
    token, place = given_token(), f"{TOKEN} or {TOKEN_PATH}"
    _check_port(args.port)
    if token is None:
        path = private_token(args.folder.absolute(), lambda exposed: console.print(exposed, soft_wrap=True))
        token, place = read_file(path.parent, path.name, MOST_BYTES).decode(), str(path)
    with joined(args.replicas):
        _start(args, digest_of(token))
        manifest = model.checkpoint.manifest
        console.print(
            f"model: {manifest.config.suite.name}, {manifest.config.method.name}, {manifest.iteration} iterations, "
            f"{model.checkpoint.digest[:12]}\n"
            f"address: http://127.0.0.1:{args.port} (a page; /openapi.json, /metrics)\n"
            f"token: {place}; each request has the header Authorization: Bearer TOKEN\n"
            "serving; stop it with Ctrl-C",
            soft_wrap=True,
        )
        try:
            threading.Event().wait()
        finally:
            _stop()


def _start(args: Arguments, digest: str) -> None:
    """Start the replicas, and wait until all listen."""
    import ray
    from ray import serve

    from services.serving.deployment import LOOPBACK, Arguments, built

    alone = named_address() is None or ray.util.get_node_ip_address() == LOOPBACK
    given = str(Path(args.model).absolute()) if Path(args.model).exists() else args.model
    arguments = Arguments(
        model=given,
        runs=str(args.runs.absolute()),
        replicas=args.replicas,
        limits=args.limits,
        port=args.port if alone else None,
        token_digest=digest,
    )
    logging.getLogger("ray.serve").setLevel(logging.WARNING)
    on_termination = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        serve.start(
            proxy_location="Disabled" if alone else "HeadOnly",
            http_options={"host": LOOPBACK, "port": args.port},
            logging_config={"enable_access_log": False, "log_level": "WARNING"},
        )
        serve.run(built(arguments), name=NAME, route_prefix="/")
    except RuntimeError as error:
        deployments = serve.status().applications[NAME].deployments.values()
        why = redacted(" ".join(one.message for one in deployments).strip()) or error_line(error)
        raise RunError(f"no replica starts: {why}\nwanted {args.replicas}, a CPU for each") from error
    finally:
        for number, handler in on_termination.items():
            signal.signal(number, handler)


def _stop() -> None:
    """End the replicas and the shelf in a cluster that was joined, and goes on; one of one's own ends with them."""
    if named_address() is None:
        return
    import ray
    from ray import serve

    from services.serving.deployment import NAMESPACE, SHELF

    serve.delete(NAME)
    ray.kill(ray.get_actor(SHELF, NAMESPACE))


def _check_port(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do: closed connections do not count
        try:
            probe.bind(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            raise UserError(f"--port: got {port}, which cannot be listened on ({error}); wanted a free one") from error


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
