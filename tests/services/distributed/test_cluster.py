"""Which cluster a program works in, and what it says of one that it cannot join."""

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import psutil
import pytest

from dmil_core.errors import UserError
from services.distributed import cluster as own
from services.distributed.cluster import joined, named_address
from tests.services.programs import Cluster


@pytest.fixture
def web_server() -> Iterator[int]:
    """The port of a server that is no Ray."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.server_address[1]
    server.shutdown()
    server.server_close()


@pytest.fixture
def named(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """What a program does to its environment is undone."""
    before = dict(os.environ)
    yield monkeypatch
    os.environ.clear()
    os.environ.update(before)


@pytest.mark.parametrize("address", ["127.0.0.1:{free}", "127.0.0.1:{web}", "no-such-host:1"])
def test_an_address_where_no_ray_answers_is_named_soon(named, free_port, web_server: int, address: str):
    address = address.format(free=free_port(), web=web_server)
    named.setattr(own, "SECONDS_TO_ANSWER", 0.5)
    named.setenv("RAY_ADDRESS", address)
    with (
        pytest.raises(UserError, match=f"^RAY_ADDRESS: got {address}, where no Ray answers; wanted a Ray head"),
        joined(),
    ):
        pass


@pytest.mark.parametrize(("scheme", "whose"), [("http", "a dashboard"), ("ray", "Ray's client")])
def test_the_address_of_a_dashboard_is_told_without_its_secrets(named, scheme: str, whose: str):
    named.setenv("RAY_ADDRESS", f"{scheme}://me:SECRET@127.0.0.1:8265")
    with (
        pytest.raises(UserError, match=rf"^RAY_ADDRESS: got {scheme}://...@127.0.0.1:8265, perhaps for {whose}"),
        joined(),
    ):
        pass


@pytest.mark.parametrize(
    "environment", [{"RAY_AUTH_MODE": "disabled"}, {"RAY_AUTH_TOKEN": "0" * 64}], ids=["no token", "a wrong token"]
)
def test_a_cluster_of_another_token_is_told_soon(cluster: Cluster, environment: dict[str, str]):
    """It is found where it is on loopback only, as in a shell, where nothing says so."""
    code = "from services.distributed.cluster import joined\nwith joined(): pass"
    given = {**os.environ, **environment, "RAY_ADDRESS": cluster.address}
    del given[own.ON_NETWORK]
    program = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=given)
    assert f"UserError: RAY_ADDRESS: got {cluster.address}, where another token is asked for" in program.stderr


@pytest.mark.thorough
def test_a_start_that_takes_ray_too_long_is_made_again(named, logged):
    """As on a busy machine; nothing of the first is left beside the second."""
    from ray._private import services

    get_node, first = services.get_node, iter([Exception("The current node timed out during startup.")])

    def late(*arguments: str) -> object:
        for error in first:
            raise error
        return get_node(*arguments)

    named.setattr(services, "get_node", late)
    named.delenv("RAY_ADDRESS", raising=False)

    def heads() -> set[int]:
        children = psutil.Process().children(recursive=True)
        return {one.pid for one in children if "gcs_server" in one.name() and one.status() != psutil.STATUS_ZOMBIE}

    others = heads()
    with joined(1):
        assert len(heads() - others) == 1
    assert logged() == ["Ray is slow to start here; it is started once more"]


@pytest.mark.parametrize(
    ("address", "name"), [(None, None), ("", None), ("local", None), ("auto", "auto"), ("head:6379", "head:6379")]
)
def test_an_empty_address_names_no_cluster(named, address: str | None, name: str | None):
    if address is not None:
        named.setenv("RAY_ADDRESS", address)
    assert named_address() == name
