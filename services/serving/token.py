"""The token of the service: from the environment, a file that it names, or a file of the service's own."""

import os
from pathlib import Path

from dmil_core.errors import UserError
from dmil_core.files import named, read_file

TOKEN, TOKEN_PATH = "DMIL_SERVE_TOKEN", "DMIL_SERVE_TOKEN_PATH"
LEAST = 16
MOST_BYTES = 4096


def given_token() -> str | None:
    """Return the token that the environment gives, itself or by its file; None if it gives none.

    Raises:
        UserError: if it is too short to be one, or cannot be sent in a header.
    """
    token, source = os.environ.get(TOKEN), TOKEN
    if not token:
        path, source = os.environ.get(TOKEN_PATH), TOKEN_PATH
        if not path:
            return None
        token = read_file(*named(Path(path)), MOST_BYTES).decode("utf-8", "replace").strip()
    if len(token) < LEAST or not token.isascii() or not token.isprintable() or " " in token:
        raise UserError(
            f"{source}: got {len(token)} characters; wanted at least {LEAST} of ASCII without spaces, as `openssl rand "
            "-hex 32` prints"
        )
    return token
