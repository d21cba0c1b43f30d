"""Every command line in `deploy/` is one that its program takes."""

import json
import re
import shlex
from collections.abc import Iterator

import pytest

from tests.deploy.command_lines import commands, refused
from tests.deploy.manifests import (
    DEPLOY,
    DOCKERFILE,
    JOBS,
    OVERLAYS,
    PROJECT,
    arrays,
    composed,
    containers,
    documents,
    overlay,
    stages,
)  # fmt: skip

pytestmark = pytest.mark.thorough


def of_images() -> Iterator[tuple[str, list[str]]]:
    for stage in stages(DOCKERFILE.read_text("utf-8")).values():
        for instruction in ("CMD", "HEALTHCHECK"):
            for found in arrays(stage.lines, instruction):
                if stage.name != "store" or instruction != "CMD":  # its entry point is the program
                    yield f"Dockerfile, {stage.name}", found


def of_services() -> Iterator[tuple[str, list[str]]]:
    programs = {"prometheus": ["prometheus"], "store": ["weed"]}
    for name, service in composed()["services"].items():
        if command := service.get("command"):
            yield f"compose, {name}", [*programs.get(name, ()), *command]
        if (test := service.get("healthcheck", {}).get("test", [""]))[0] == "CMD":
            yield f"compose, {name}, healthcheck", test[1:]


def of_pods() -> Iterator[tuple[str, list[str]]]:
    for name in OVERLAYS:
        for container in containers(overlay(name)):
            if container.command:
                yield f"{name}, {container.where}", list(container.command)
    for path in JOBS:
        for job in documents(path):
            yield path.name, shlex.split(job["spec"]["entrypoint"])


def of_launchers() -> Iterator[tuple[str, list[str]]]:
    for path in sorted(DEPLOY.glob("cluster*.yaml")):
        for document in documents(path):
            for key, lines in document.items():
                if key.endswith("_commands"):
                    for line in lines:
                        yield from ((path.name, command) for command in commands(line) if command[0] != "python")


@pytest.mark.parametrize("source", [of_images, of_services, of_pods, of_launchers])
def test_every_command_line_is_taken(source):
    found = list(source())
    assert len(found) > 1
    assert [f"{where}: {shlex.join(command)}: {error}" for where, command in found if (error := refused(command))] == []


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("ray start --head --prot=6379", "--prot"),
        ("ray start --head --num-cpus=two", "two"),
        ("ray job submit --adress http://127.0.0.1:8265 -- python -m services.meta_train", "--adress"),
        ("ray job submit -- python -m services.train", "services.train"),
        ("mlflow server --host 0.0.0.0 --allow-hosts a", "--allow-hosts"),
        ("mlflow server --port http", "http"),
        ("python -m services.meta_train --preset ml10-fast", "ml10-fast"),
        ("python -m services.meta_train --preset ml10-quick --iterations 3", "--iterations"),
        ("python -m services.tune_sweep sub-skills", "sub-skills"),
        ("python -m services.tune_sweep sub_skills --preset large", "large"),
        ("python /usr/local/bin/make_buckets.py mlflow", "make_buckets.py"),
        ("prometheus --config=x", "--config"),
        ("minio server /data", "nothing here knows"),
    ],
)
def test_a_faulty_command_line_is_refused(line: str, word: str):
    assert word in (refused(shlex.split(line)) or "")


def test_commands_are_found_in_a_line_of_shell():
    line = "cd dmil && export A=b; ray stop || true && ray start --address=$HEAD:6379 > log"
    assert [" ".join(found[:2]) for found in commands(line)] == ["ray stop", "ray start"]


def test_ray_of_the_manifests_is_the_projects():
    pins = dict(re.findall(r"^([\w.-]+)==(\S+)$", (PROJECT / "constraints.txt").read_text("utf-8"), re.MULTILINE))
    for name in OVERLAYS:
        for document in overlay(name):
            if document["kind"] == "RayCluster":
                assert document["spec"]["rayVersion"] == pins["ray"], json.dumps(document["metadata"])
