"""What the deployments say: their documents read and rendered, and the containers in them."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml

PROJECT = Path(__file__).parents[2]
DEPLOY = PROJECT / "deploy"
DOCKERFILE, COMPOSE = DEPLOY / "docker" / "Dockerfile", DEPLOY / "compose.yaml"
OVERLAYS = ("cpu", "gpu")
JOBS = sorted((DEPLOY / "kuberay" / "jobs").glob("*.yaml"))

Document = dict[str, Any]


class MissingToolError(Exception):
    """A program that the checks need is not on this machine."""


def tool(name: str) -> str:
    """Return where a program is: beside this Python, as the extra `deploy` installs them, or on the PATH.

    Raises:
        MissingToolError: says what brings it.
    """
    beside = shutil.which(name, path=str(Path(sys.executable).parent))
    if found := beside or shutil.which(name):
        return found
    origin = {
        "kubectl": "kubectl 1.27 or newer, for `kubectl kustomize`: https://kubernetes.io/docs/tasks/tools",
        "promtool": "apt-get install prometheus",
        "prometheus": "apt-get install prometheus",
    }
    raise MissingToolError(f"{name}: not found; wanted {origin.get(name, 'make check-deploy, which installs it')}")


def ask(name: str, *arguments: str | Path, cwd: Path = PROJECT) -> tuple[int, str]:
    """Run a program and return its exit code and what it printed."""
    ran = subprocess.run([tool(name), *map(str, arguments)], cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    return ran.returncode, ran.stdout.decode()


def documents(path: Path) -> list[Document]:
    """Read a file of YAML documents."""
    return [document for document in yaml.safe_load_all(path.read_text("utf-8")) if document]


def rendered(folder: Path) -> list[Document]:
    """Render a folder with Kustomize, as ``kubectl apply -k`` would."""
    code, output = ask("kubectl", "kustomize", folder)
    assert code == 0, output
    return list(yaml.safe_load_all(output))


@cache
def overlay(name: str) -> tuple[Document, ...]:
    """Return the documents of an overlay and of the jobs that go with it."""
    return (*rendered(DEPLOY / "kuberay" / name), *(job for path in JOBS for job in documents(path)))


@cache
def composed() -> Document:
    """Return the compose file as Docker Compose understands it."""
    code, output = ask("docker-compose", "-f", COMPOSE, "config", "--format", "json")
    assert code == 0, output
    return json.loads(output)


class Container(NamedTuple):
    """A container of a deployment."""

    where: str
    image: str
    command: Sequence[str]
    environment: Mapping[str, str]
    ports: frozenset[int]
    """That it is said to listen on."""
    labels: Mapping[str, str]
    """Of its pod."""
    resources: Mapping[str, Mapping[str, str]]


def pods(document: Document) -> Iterator[tuple[str, Document, dict[str, str], Sequence[str]]]:
    """Yield name, template, labels and command line of every pod that a document asks for.

    KubeRay gives the pods of a cluster labels of its own, and makes a command line of `rayStartParams`.
    """
    spec, name = document.get("spec", {}), f"{document['kind']} {document['metadata']['name']}"
    if document["kind"] in ("Deployment", "StatefulSet"):
        yield name, spec["template"], spec["template"]["metadata"]["labels"], ()
    elif document["kind"] == "RayCluster":
        groups = [("head", spec["headGroupSpec"]), *(("worker", group) for group in spec["workerGroupSpecs"])]
        for kind, group in groups:
            labels = {"ray.io/cluster": document["metadata"]["name"], "ray.io/node-type": kind}
            flags = [f"--{key}={value}" for key, value in group["rayStartParams"].items()]
            place = ["--head"] if kind == "head" else ["--address=head:6379"]
            yield f"{name}, {kind}", group["template"], labels, ["ray", "start", *place, *flags]
    elif document["kind"] == "RayService":
        cluster = spec["rayClusterConfig"]
        for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
            flags = [f"--{key}={value}" for key, value in group["rayStartParams"].items()]
            place = ["--head"] if group is cluster["headGroupSpec"] else ["--address=head:6379"]
            served = f"--port={yaml.safe_load(spec['serveConfigV2'])['http_options']['port']}"
            labels = group["template"]["metadata"]["labels"]
            yield name, group["template"], labels, ["ray", "start", *place, *flags, served]
    elif document["kind"] == "RayJob":
        yield name, spec["submitterPodTemplate"], spec["submitterPodTemplate"]["metadata"]["labels"], ()


def containers(found: Sequence[Document]) -> list[Container]:
    """Return all containers that Kubernetes documents ask for."""
    return [
        Container(
            f"{where}, {container['name']}",
            container["image"],
            [*container.get("command", ()), *container.get("args", ())] or command,
            {entry["name"]: entry.get("value", "") for entry in container.get("env", ())},
            frozenset(port["containerPort"] for port in container.get("ports", ())),
            labels,
            container.get("resources", {}),
        )
        for document in found
        for where, template, labels, command in pods(document)
        for container in template["spec"]["containers"]
    ]


class Stage(NamedTuple):
    """A stage of the Dockerfile."""

    name: str
    base: str
    lines: tuple[str, ...]
    """Its instructions, each on one line."""


def stages(text: str) -> dict[str, Stage]:
    """Read a Dockerfile's stages."""
    found: dict[str, Stage] = {}
    for line in re.sub(r"\\\n\s*", "", text).splitlines():
        if match := re.match(r"FROM (\S+) AS (\S+)", line):
            found[match[2]] = Stage(match[2], match[1], ())
        elif found and line and not line.startswith("#"):
            last = found[next(reversed(found))]
            found[last.name] = last._replace(lines=(*last.lines, line))
    return found


def history(name: str, found: Mapping[str, Stage]) -> list[str]:
    """Return the instructions of a stage after those of the stages that it is built upon."""
    stage = found[name]
    return [*(history(stage.base, found) if stage.base in found else ()), *stage.lines]


def arrays(lines: Sequence[str], instruction: str) -> list[list[str]]:
    """Return the command lines of instructions in their form of a JSON array."""
    found = [re.search(rf"^{instruction} (?:.*CMD )?(\[.*\])$", line) for line in lines]
    return [json.loads(match[1]) for match in found if match]
