"""The files of Ray's cluster launcher, as Ray itself reads them."""

import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from ray.autoscaler._private.util import prepare_config, validate_config

from services.suites.rendering import BACKENDS
from tests.deploy.manifests import DEPLOY, PROJECT, documents

pytestmark = pytest.mark.thorough

FILES = sorted(DEPLOY.glob("cluster*.yaml"))


def read(path: Path) -> dict[str, Any]:
    return documents(path)[0]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_ray_takes_it(path: Path):
    validate_config(prepare_config(read(path)))


@pytest.mark.parametrize(
    ("key", "value"),
    [("max_worker", 3), ("idle_timeout_minutes", "ten"), ("upscaling_speed", "fast"), ("auth", {"user": "admin"})],
)
def test_ray_finds_a_fault(key: str, value: Any):
    with pytest.raises(jsonschema.ValidationError):
        validate_config(prepare_config(read(FILES[0]) | {key: value}))


def test_ray_finds_a_head_of_no_type():
    with pytest.raises(ValueError, match="head_node_type"):
        validate_config(prepare_config(read(DEPLOY / "cluster.yaml") | {"head_node_type": "heads"}))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_node_asks_for_the_token_that_is_brought_along(path: Path):
    config = read(path)
    home = next(place for place, origin in config["file_mounts"].items() if origin == ".").rpartition("/")[0]
    assert config["file_mounts"][f"{home}/.ray/auth_token"] == "deploy/secrets/ray_token"
    assert "deploy/secrets" in config["rsync_exclude"]
    for kind in ("head", "worker"):
        start = config[f"{kind}_start_ray_commands"][-1]
        assert re.search(r"export RAY_AUTH_MODE=token\b.*\bray start", start)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_what_it_installs_is_the_project_and_what_draws(path: Path):
    setup = " ".join(read(path)["setup_commands"])
    assert {package for names in BACKENDS.values() for package in names.split()} <= set(setup.split())
    assert "-c constraints.txt" in setup
    assert (PROJECT / "constraints.txt").is_file()
