"""The service as it is started: its token, what listens, a replica that is killed, the page, and fuzzed."""

import os
import secrets
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import psutil
import pytest
from axe_playwright_python.sync_playwright import Axe

import dmil_core as dmil
from services import serve
from services.storage.redaction import SECRETS
from tests.dmil_core.old_models import FOLDER, recorded
from tests.services.test_security import holding, listening, on_loopback

CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance",
    "ignored_auth", "unsupported_method", "negative_data_rejection",
)  # fmt: skip
OPEN = {"GET /: 200"}
"""The page, which asks for the token itself."""


def replicas_of(program: int) -> list[psutil.Process]:
    return [
        one for one in psutil.Process(program).children(recursive=True) if "ServeReplica" in " ".join(one.cmdline())
    ]


@pytest.mark.thorough
def test_the_service_as_a_whole(
    programs, free_port: Callable[[], int], wait_for, doors, browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    token, port = secrets.token_hex(32), free_port()
    monkeypatch.setenv("DMIL_SERVE_TOKEN", token)
    monkeypatch.setenv("TMPDIR", "/tmp")
    model, address = dmil.load(FOLDER / "dmil"), f"http://127.0.0.1:{port}"
    program = programs.start("serve", str(FOLDER / "dmil"), "--port", str(port))
    printed = ""
    while "serving;" not in printed:
        printed += (line := program.stdout.readline())
        assert line, printed
    client = httpx2.Client(base_url=address, headers={"authorization": f"Bearer {token}"}, trust_env=False, timeout=30)

    listened = listening(program.pid)
    assert all(map(on_loopback, listened)), listened
    knocked = doors(program.pid)
    if knocked is not None:
        assert {door for door in knocked.doors if not door.startswith("figures: ")} <= OPEN

    demonstrations = recorded(model, 2)
    body = {"demonstrations": [{"observations": o.tolist(), "actions": a.tolist()} for o, a in demonstrations]}
    posted = client.post("/v1/policies", json=body)
    assert posted.status_code == 201, posted.text
    name, policy = posted.json()["id"], model.adapt(demonstrations)
    observation = demonstrations[0][0][0]

    def acts() -> bool:
        """Ask as a robot would: a connection that broke is opened again."""
        try:
            answer = client.post(f"/v1/policies/{name}/act", json={"observations": observation.tolist()})
        except httpx2.TransportError:
            return False
        assert answer.status_code == 200, answer.text
        np.testing.assert_array_equal(np.array(answer.json()["actions"], np.float32), policy(observation))
        return True

    assert acts()
    before = {replica.pid for replica in replicas_of(program.pid)}
    assert len(before) == 2
    os.kill(min(before), signal.SIGKILL)
    wait_for(acts, "the replica that is left")
    wait_for(lambda: len({r.pid for r in replicas_of(program.pid)} - {min(before)}) == 2, "a replica in its place")
    os.kill(max(before), signal.SIGKILL)
    wait_for(acts, "the new replica, which has the policy from the shelf")

    see_page(browser, address, token, body, tmp_path)
    wait_for(lambda: client.get("/healthz").status_code == 200, "a replica")
    fuzz(address, token, tmp_path)

    program.send_signal(signal.SIGTERM)
    rest, _ = program.communicate()
    assert program.returncode == 143, rest
    assert token not in printed + rest
    assert holding(token, Path.cwd(), tmp_path) == []


def see_page(browser, address: str, token: str, body: dict[str, Any], folder: Path) -> None:
    """Give the page its token and demonstrations, and see what it shows."""
    file, complaints = folder / "mine.npz", []
    both = (np.concatenate([one[field] for one in body["demonstrations"]]) for field in ("observations", "actions"))
    np.savez(file, **dict(zip(("observations", "actions"), both, strict=True)))
    page = browser.new_page()
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(address)
    page.get_by_label("Token").fill("another")
    page.get_by_role("button", name="Open").click()
    page.get_by_text("401: Authorization: got no token, or another").wait_for()
    page.get_by_label("Token").fill(token)
    page.get_by_role("button", name="Open").click()
    page.get_by_label("Demonstrations").set_input_files(file)
    page.get_by_label("Gradient steps").fill("1")
    page.get_by_role("button", name="Adapt").click()
    page.get_by_text("after 1 steps").wait_for()
    assert page.get_by_role("img", name="demonstration 0").count() == 1
    assert page.locator("#policies tbody tr").count() == 2
    assert Axe().run(page).response["violations"] == []
    assert complaints == []
    page.close()


def fuzz(address: str, token: str, folder: Path) -> None:
    """Ask all sorts of things that the OpenAPI document allows, and all sorts that it does not, for some seconds."""
    command = [
        Path(sys.executable).with_name("schemathesis"), "run", f"{address}/openapi.json",
        "--header", f"Authorization: Bearer {token}", "--checks", ",".join(CHECKS), "--max-examples", "10",
        "--request-retries", "3", "--max-time", "30",
    ]  # fmt: skip
    environment = {name: value for name, value in os.environ.items() if name not in SECRETS}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_what_cannot_be_served_is_refused_before_anything_starts(
    complaint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    folder = str(FOLDER / "dmil")
    assert "name: got 'nothing'" in complaint(serve.run, "nothing")
    assert "--replicas: got 0" in complaint(serve.run, folder, "--replicas", "0")
    assert "--limits.policies: got 0" in complaint(serve.run, folder, "--limits.policies", "0")
    monkeypatch.setenv("DMIL_SERVE_TOKEN", "short")
    assert "DMIL_SERVE_TOKEN: got 5 characters" in complaint(serve.run, folder)
    assert list(tmp_path.iterdir()) == []
