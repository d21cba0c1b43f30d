"""What the checks of the deployments share."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.deploy.manifests import DEPLOY


@pytest.fixture(scope="session")
def make_secrets() -> Callable[[Path], None]:
    """Draws every secret into a folder, as a user would."""

    def make(folder: Path) -> None:
        subprocess.run(["sh", DEPLOY / "make_secrets.sh", folder], check=True, capture_output=True)

    return make
