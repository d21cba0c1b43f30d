from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from services.tracking.links import comparison_link, database, run_link, ui_command


@pytest.mark.parametrize(
    ("uri", "site"),
    [
        ("http://127.0.0.1:5000", "http://127.0.0.1:5000"),
        ("https://user:SECRET@host/mlflow/?x=SECRET", "https://host/mlflow"),
        ("sqlite:///mlflow.db", "http://127.0.0.1:5000"),
        ("postgresql://user:SECRET@host/db", "http://127.0.0.1:5000"),
    ],
)
def test_links_lead_to_the_pages_of_the_server_or_of_mlflow_ui_without_secrets(uri: str, site: str):
    assert run_link(uri, "3", "abc").startswith(f"{site}/#/experiments/3/runs/abc?")
    comparison = urlsplit(comparison_link(uri, "3", ["abc", "def"]))
    asked = urlsplit(comparison.fragment)
    assert asked.path == "/compare-runs"
    assert parse_qs(asked.query)["runs"] == ['["abc","def"]']
    assert parse_qs(asked.query)["experiments"] == ['["3"]']
    assert "SECRET" not in comparison.geturl()


@pytest.mark.parametrize(
    ("uri", "command"),
    [
        ("sqlite:///mlflow.db", "dmil tracking ui"),
        ("sqlite:////a b/c.db", "MLFLOW_TRACKING_URI='sqlite:////a b/c.db' dmil tracking ui"),
        ("http://127.0.0.1:5000", None),
    ],
)
def test_a_file_is_looked_at_with_a_server_of_one_s_own(uri: str, command: str | None):
    assert ui_command(uri) == command


def test_a_database_is_the_file_that_its_address_means():
    assert database("sqlite:///a b/c%20d.db?timeout=5") == Path("a b/c d.db")
    assert database("http://host/c.db") is None
