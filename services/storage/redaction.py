"""What is shown, logged or stored of addresses and errors: without secrets."""

import os
import re
from urllib.parse import quote, unquote

from dmil_core.errors import RunError, UserError

SECRETS = (
    "AWS_SECRET_ACCESS_KEY",
    "AWS_SESSION_TOKEN",
    "DMIL_SERVE_TOKEN",
    "MLFLOW_TRACKING_PASSWORD",
    "MLFLOW_TRACKING_TOKEN",
    "RAY_AUTH_TOKEN",
)
"""Environment variables that are secrets as a whole."""
ADDRESSES = ("DMIL_STORAGE", "MLFLOW_TRACKING_URI", "http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY")
"""Environment variables that are URLs, which may hold some."""
MIN_SECRET = 4
"""Characters; hiding a shorter secret would garble any text."""
URL = re.compile(
    r"""
    ://
    (?P<user>
        (?:[^\s/:@]*:(?!\d*(?:[^\w@.-]|$))(?:(?!://)[^\n@])*@)?  # a name and a password of any characters; no port
        (?:\S*@)?
    )
    (?P<place>[^\s?\#]*)
    (?P<query>\?[^\s\#]*)?
    (?P<fragment>\#\S*)?
    """,
    re.VERBOSE,
)
MOST_OF_AN_ERROR = 200


def redacted(text: str) -> str:
    """Return a text without users, passwords, queries and fragments of URLs, and without this process's own secrets.

    Every query is hidden, whatever its keys are called: signed URLs and databases have many names for a secret.
    """
    for secret in sorted(_own_secrets(), key=len, reverse=True):
        text = text.replace(secret, "...")
    return URL.sub(_without_secrets, text)


def error_line(error: Exception) -> str:
    """Return an error of a library, or of what is below it, in one line without secrets."""
    text = redacted(" ".join(str(error).split()))
    return text if isinstance(error, UserError | RunError) else f"{type(error).__name__}: {text[:MOST_OF_AN_ERROR]}"


def _own_secrets() -> set[str]:
    """Return the secrets in the environment, also as they stand in a URL."""
    plain = {os.environ.get(name, "") for name in SECRETS}
    for name in ADDRESSES:
        found = URL.search(os.environ.get(name, ""))
        password = found["user"][:-1].partition(":")[2] if found else ""
        plain |= {password, *re.split("[@/]", password)}  # whoever reads the URL otherwise shows a part
    forms = {form for secret in plain for form in (secret, unquote(secret), quote(secret, safe=""))}
    return {secret for secret in forms if len(secret) >= MIN_SECRET}


def _without_secrets(url: re.Match[str]) -> str:
    hidden = {part: bool(url[part]) for part in ("user", "query", "fragment")}
    return f"://{'...@' * hidden['user']}{url['place']}{'?...' * hidden['query']}{'#...' * hidden['fragment']}"
