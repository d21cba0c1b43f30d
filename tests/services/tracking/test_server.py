"""MLflow's server as this program starts it: nobody gets in without its token, and artifacts have one folder."""

import base64
import re
import urllib.error
import urllib.request
from typing import Any

import pytest
from flask.testing import FlaskClient

from services.tracking.server import create_app

TOKEN = "the-token"
CREATE = "/api/2.0/mlflow/experiments/create"


@pytest.fixture
def client(tmp_path, monkeypatch: pytest.MonkeyPatch) -> FlaskClient:
    from mlflow import server

    monkeypatch.setenv("MLFLOW_TRACKING_TOKEN", TOKEN)
    monkeypatch.setitem(server.app.before_request_funcs, None, list(server.app.before_request_funcs[None]))
    return create_app().test_client()


def basic(user: str, password: str) -> str:
    return f"Basic {base64.b64encode(f'{user}:{password}'.encode()).decode()}"


@pytest.mark.parametrize(
    ("login", "status"),
    [
        (None, 401),
        ("", 401),
        ("Bearer", 401),
        ("Bearer the-toke", 401),
        ("Bearer the-token\xe9", 401),
        (basic(TOKEN, "x"), 401),
        (basic("", ""), 401),
        (f"Bearer {TOKEN}", 200),
        (basic("anybody", TOKEN), 200),
    ],
)
def test_the_server_opens_to_its_token_alone(client: FlaskClient, login: str | None, status: int):
    headers = {} if login is None else {"Authorization": login}
    for path in ("/version", "/api/2.0/mlflow/experiments/search"):
        with client.get(path, headers=headers) as answer:
            assert (answer.status_code == 401) == (status == 401)
    if status == 401:
        assert client.post("/ajax-api/2.0/mlflow/upload-artifact", headers=headers).status_code == 401
        assert client.get("/health", headers=headers).status_code == 200


@pytest.mark.parametrize(
    ("body", "kind"),
    [
        ('{"name": "a", "artifact_location": "/etc"}', "application/json"),
        ('{"name": "a", "artifactLocation": "file:///etc"}', "application/json"),
        ('"{\\"name\\": \\"a\\", \\"artifact_location\\": \\"s3://x\\"}"', "text/plain"),
    ],
)
def test_nobody_names_a_place_for_artifacts(client: FlaskClient, body: str, kind: str):
    answer = client.post(CREATE, data=body, content_type=kind, headers={"Authorization": f"Bearer {TOKEN}"})
    assert (answer.status_code, b"artifacts have one folder here" in answer.data) == (403, True)


def test_without_a_token_there_is_no_server(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("MLFLOW_TRACKING_TOKEN", raising=False)
    with pytest.raises(ValueError, match=r"MLFLOW_TRACKING_TOKEN: got none"):
        create_app()


def test_pages_are_served_to_whoever_read_the_password(programs, free_port, answers, wait_for):
    port = free_port()
    program = programs.start("tracking", "ui", "--port", str(port))
    site = f"http://127.0.0.1:{port}"
    wait_for(lambda: answers(f"{site}/health") or program.poll() is not None, "MLflow's server")
    assert program.poll() is None

    def status(password: str, path: str) -> Any:
        request = urllib.request.Request(f"{site}{path}", headers={"Authorization": basic("me", password)})
        try:
            with urllib.request.urlopen(request) as answer:
                return answer.status
        except urllib.error.HTTPError as error:
            error.close()
            return error.code

    printed = "".join(program.stdout.readline() for _ in range(3))
    assert site in printed
    password = re.findall(r"^password: (\S+)$", printed, re.MULTILINE)[0]
    assert [status(password, "/"), status("", "/"), status(password[1:], "/")] == [200, 401, 401]
    assert status(password, "/ajax-api/3.0/mlflow/assistant/config") == 404


def test_a_server_s_pages_are_its_own(programs, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://me:SECRET@127.0.0.1:1")
    code, said = programs("tracking", "ui")
    assert code == 2
    assert "MLFLOW_TRACKING_URI: got http://...@127.0.0.1:1, which has pages itself; wanted a database" in said
