"""The images: what hadolint says, what goes into them, and who runs in them."""

import fnmatch
import os
import re
import stat
import subprocess
import tomllib
from pathlib import Path

import pytest

from services.suites.rendering import BACKENDS
from tests.deploy.manifests import (
    DEPLOY,
    DOCKERFILE,
    OVERLAYS,
    PROJECT,
    Stage,
    arrays,
    ask,
    composed,
    containers,
    history,
    overlay,
    stages,
)  # fmt: skip

pytestmark = pytest.mark.thorough

TARGETS = ("cpu", "cuda", "mlflow", "store")
IMAGE = re.compile(r"^(?P<name>[\w./-]+):(?P<tag>[\w.-]+)(?:@sha256:[0-9a-f]{64})?$")


def images() -> set[str]:
    """Every image that a deployment names."""
    found = {service["image"] for service in composed()["services"].values()}
    return found | {container.image for name in OVERLAYS for container in containers(overlay(name))}


def complaint(image: str, built: set[str]) -> str | None:
    """Return what is wrong with an image's name."""
    match = IMAGE.match(image)
    if match is None or match["tag"] == "latest":
        return f"{image}: wanted a tag that stays what it is"
    if match["name"] == "dmil" and match["tag"] not in built:
        return f"{image}: the Dockerfile has no such target"
    return None


def let_through(path: str, ignore: str) -> bool:
    """Tell whether a path is in the build's context; the last pattern that fits decides, as with Docker."""
    parents = [str(parent) for parent in Path(path).parents if str(parent) != "."]
    there = True
    for pattern in (line for line in ignore.splitlines() if line and not line.startswith("#")):
        bare = pattern.removeprefix("!").removeprefix("**/")
        if any(fnmatch.fnmatch(name, bare) for name in (path, *parents, Path(path).name)):
            there = pattern.startswith("!")
    return there


@pytest.fixture(scope="module")
def found() -> dict[str, Stage]:
    return stages(DOCKERFILE.read_text("utf-8"))


def test_hadolint_has_nothing_to_say():
    assert ask("hadolint", DOCKERFILE) == (0, "")


def test_hadolint_finds_a_fault(tmp_path: Path):
    broken = tmp_path / "Dockerfile"
    text = DOCKERFILE.read_text("utf-8")
    broken.write_text(text.replace("# hadolint ignore=DL3008\n", "").replace("WORKDIR /opt/dmil", "WORKDIR dmil"))
    code, output = ask("hadolint", broken)
    assert code != 0
    assert {"DL3008", "DL3000"} <= set(output.split())


def test_every_image_is_built_or_pinned():
    assert [error for image in images() if (error := complaint(image, set(TARGETS)))] == []


@pytest.mark.parametrize("image", ["postgres", "postgres:latest", "dmil:gpu", "dmil"])
def test_an_image_that_is_not_is_refused(image: str):
    assert complaint(image, set(TARGETS))


def test_every_target_runs_as_a_user_by_number_with_a_health_check(found: dict[str, Stage]):
    for target in TARGETS:
        lines = history(target, found)
        assert next(line for line in reversed(lines) if line.startswith("USER")) == "USER 1000:1000"
        assert len(arrays(lines, "HEALTHCHECK")) == 1, target


def test_no_build_tool_is_in_a_final_layer(found: dict[str, Stage]):
    for target in TARGETS:
        lines = " ".join(history(target, found))
        assert not re.search(r"pip install|build-essential|gcc|git\b", lines), target


def test_the_bases_have_a_place_for_a_digest():
    arguments = dict(re.findall(r"^ARG (\w+)=(\S+)$", DOCKERFILE.read_text("utf-8"), re.MULTILINE))
    assert set(arguments) == {"PYTHON", "STORE"}
    assert all(IMAGE.match(f"{base}@sha256:{'0' * 64}") for base in arguments.values())


def test_python_is_one_that_the_project_takes():
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["project"]
    version = re.search(r"python:(\d+)\.(\d+)", DOCKERFILE.read_text("utf-8"))
    assert version
    assert f">={version[1]}.{version[2]}" == project["requires-python"]


def test_what_draws_is_installed(found: dict[str, Stage]):
    packages = {package for names in BACKENDS.values() for package in names.split()}
    for target in ("cpu", "cuda"):
        (installed,) = (line for line in history(target, found) if "apt-get install" in line)
        assert packages <= set(installed.split())


def test_what_is_copied_exists_and_is_in_the_context(found: dict[str, Stage]):
    ignore = Path(f"{DOCKERFILE}.dockerignore").read_text("utf-8")
    copied = [
        name
        for stage in found.values()
        for line in stage.lines
        if line.startswith("COPY") and "--from" not in line
        for name in line.split()[1:-1]
        if name != "."
    ]
    assert len(copied) == 6
    for name in copied:
        assert (PROJECT / name).is_file(), name
        assert let_through(name, ignore), name


def test_the_context_has_the_programs_and_no_more():
    ignore = Path(f"{DOCKERFILE}.dockerignore").read_text("utf-8")
    packages = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["packages"]["find"]
    for package in (name.rstrip("*") for name in packages["include"]):
        assert let_through(f"{package}/__init__.py", ignore), package
    for path in (
        "services/reporting/templates/page.html",
        "services/evaluation/paper_results.json",
        "models/ml10/manifest.json",
        "tune_configs/em.yaml",
    ):
        assert (PROJECT / path).is_file()
        assert let_through(path, ignore)
    for path in ("data/x", "runs/a/b", ".git/config", "deploy/secrets/ray_token", "tests/conftest.py", "mlflow.db"):
        assert not let_through(path, ignore), path


def test_the_entry_point_hands_on_the_password(tmp_path: Path):
    (tmp_path / "password").write_text("hush")
    script, show = DEPLOY / "docker" / "with_password.sh", ["sh", "-c", 'printf %s "${PGPASSWORD-none}"']
    environment = {"PATH": os.environ["PATH"]}
    given = environment | {"PGPASSWORD_FILE": str(tmp_path / "password")}
    assert subprocess.check_output(["sh", script, *show], env=given) == b"hush"
    assert subprocess.check_output(["sh", script, *show], env=environment) == b"none"
    missing = environment | {"PGPASSWORD_FILE": str(tmp_path / "none")}
    assert subprocess.run(["sh", script, *show], env=missing, capture_output=True).returncode != 0


def test_secrets_are_drawn_once(tmp_path: Path):
    folder = tmp_path / "secrets"

    def draw() -> dict[str, str]:
        subprocess.run(["sh", DEPLOY / "make_secrets.sh", folder], check=True, capture_output=True)
        return {path.name: path.read_text() for path in folder.iterdir()}

    texts = draw()
    assert draw() == texts
    assert len(texts["ray_token"]) == 64
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    composed_of = {Path(secret["file"]).name for secret in composed()["secrets"].values()}
    assert set(texts) == composed_of | {"serve_token"}  # of Kubernetes alone
    (folder / "store.json").unlink()
    again = draw()
    access = re.search(r"aws_access_key_id = (\w+)", again["store_credentials"])
    assert access
    assert access[1] in again["store.json"]


def test_no_secret_is_in_the_repository():
    tracked = subprocess.check_output(["git", "ls-files", "deploy/secrets"], cwd=PROJECT, text=True).split()
    assert {Path(name).name for name in tracked} == {".gitignore", "kustomization.yaml"}
    for name, service in composed()["services"].items():
        for key, value in service.get("environment", {}).items():
            if re.search("PASSWORD|TOKEN|CREDENTIALS|SECRET", key) and "MODE" not in key:
                assert value.startswith("/run/secrets/"), (name, key)
