"""What is shown of addresses: nothing that lets anybody in."""

from urllib.parse import quote

import pytest

from services.storage.redaction import redacted


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("sqlite:///mlflow.db", "sqlite:///mlflow.db"),
        ("http://127.0.0.1:5000", "http://127.0.0.1:5000"),
        ("http://127.0.0.1:5000 failed; ask me@home", "http://127.0.0.1:5000 failed; ask me@home"),
        ("(http://127.0.0.1:5000) failed; ask me@home", "(http://127.0.0.1:5000) failed; ask me@home"),
        ("postgresql://user:SECRET@host/db", "postgresql://...@host/db"),
        ("http://user:SEC@RE/T@host:5000/x failed", "http://...@host:5000/x failed"),
        ("got 'https://SECRET@host'; wanted", "got 'https://...@host'; wanted"),
        ("got 'ftp://me:it's \"SECRET\"@host'; wanted", "got 'ftp://...@host'; wanted"),
        ("sftp://me:12SEC RET/@host/runs and s3://bucket", "sftp://...@host/runs and s3://bucket"),
        ("http://me:SECRET@host?at=a@SECRET", "http://...@SECRET"),
        ("postgresql://host/db?user=me&pw=SECRET&x=1", "postgresql://host/db?..."),
        ("gs://bucket/x?X-Goog-Signature=SECRET failed", "gs://bucket/x?... failed"),
        ("http://host/a#access:SECRET failed", "http://host/a#... failed"),
        ("http://host/?k=SECRET#SECRET", "http://host/?...#..."),
    ],
)
def test_an_address_is_shown_without_its_secrets(text: str, shown: str):
    assert redacted(text) == shown


@pytest.mark.parametrize("name", ["MLFLOW_TRACKING_TOKEN", "DMIL_STORAGE", "https_proxy"])
def test_secrets_of_this_process_are_hidden_wherever_they_stand(name: str, monkeypatch: pytest.MonkeyPatch):
    secret = "rosé & p/w"
    monkeypatch.setenv(name, secret if "TOKEN" in name else f"http://me:{quote(secret, safe='')}@host/x")
    for form in (secret, quote(secret, safe="")):
        assert redacted(f"login failed: me, {form!r}, denied") == "login failed: me, '...', denied"


def test_parts_of_a_password_that_was_not_quoted_are_hidden(monkeypatch: pytest.MonkeyPatch):
    """Libraries take what is behind its at sign for the host, and show the rest as a path."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://me:left@host/right@127.0.0.1:9/x")
    assert (
        redacted("no answer from 'host', url: /right@127.0.0.1:9/x") == "no answer from '...', url: /...@127.0.0.1:9/x"
    )
