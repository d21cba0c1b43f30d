"""The Kubernetes manifests: rendered, held against the schemas, and that what they name is there."""

import copy
import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from services.distributed.simulation_worker import ENVIRONMENTS_KEPT
from tests.deploy.command_lines import listening
from tests.deploy.manifests import (
    DEPLOY,
    JOBS,
    OVERLAYS,
    Container,
    Document,
    ask,
    containers,
    documents,
    overlay,
    rendered,
)  # fmt: skip

pytestmark = pytest.mark.thorough

SCHEMAS = Path(__file__).parent / "schemas"
KUBERAY = {"RayCluster": "rayclusters.v1.json", "RayJob": "rayjobs.v1.json", "RayService": "rayservices.v1.json"}
GIVEN = {"postgres": {5432}, "submitter": set()}
"""Ports that are the default of their programs."""
BYTES = {"Mi": 2**20, "Gi": 2**30}
WORKER_BYTES = 690_000_000 + 220_000_000 + ENVIRONMENTS_KEPT * 24_000_000
"""Of an adaptation worker at paper size and a simulation worker with all its environments, see docs/performance.md."""


def strict(schema: Any) -> Any:
    """Return an OpenAPI schema that refuses the keys it does not name."""
    if isinstance(schema, list):
        return [strict(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    made = {key: strict(value) for key, value in schema.items()}
    if isinstance(made.get("properties"), dict) and not made.get("x-kubernetes-preserve-unknown-fields"):
        made.setdefault("additionalProperties", False)
    if made.pop("x-kubernetes-int-or-string", False):
        made.pop("type", None)
    return made


def schema(kind: str) -> Any:
    return strict(json.loads((SCHEMAS / KUBERAY[kind]).read_text())["openAPIV3Schema"])


def against_kuberay(document: Document) -> list[str]:
    validator = jsonschema.Draft202012Validator(schema(document["kind"]))
    return [f"{error.json_path}: {error.message}" for error in validator.iter_errors(document)]


def against_kubernetes(found: list[Document], folder: Path) -> tuple[int, str]:
    folder.mkdir(exist_ok=True)
    for number, document in enumerate(found):
        (folder / f"{number}.yaml").write_text(yaml.safe_dump(document))
    return ask("kubernetes-validate", "--strict", *sorted(folder.iterdir()))


def of_kind(kind: str, name: str = "cpu") -> dict[str, Document]:
    return {document["metadata"]["name"]: document for document in overlay(name) if document["kind"] == kind}


def selected(selector: Document, found: list[Container]) -> list[Container]:
    """Return the containers of the pods that a selector fits."""
    labels = selector.get("matchLabels", selector)
    return [container for container in found if labels.items() <= dict(container.labels).items()]


def nowhere(document: Document, found: list[Container]) -> Iterator[str]:
    """Yield what a service, policy or budget selects or opens that is not there."""
    name, spec = f"{document['kind']} {document['metadata']['name']}", document.get("spec", {})
    if document["kind"] == "NetworkPolicy":
        own = spec["podSelector"]
        rules = [(own, rule, "from") for rule in spec.get("ingress", ())]
        for rule in spec.get("egress", ()):
            rules += [(peer["podSelector"], rule, "to") for peer in rule.get("to", ()) if "podSelector" in peer]
        peers = [peer["podSelector"] for _, rule, side in rules for peer in rule.get(side, ()) if "podSelector" in peer]
        for selector in [own, *peers]:
            if not selected(selector, found):
                yield f"{name}: no pod is {selector}"
        for selector, rule, _ in rules:
            open_ports = {port["port"] for port in rule.get("ports", ())}
            there = set().union(*(container.ports for container in selected(selector, found)))
            if open_ports - there:
                yield f"{name}: opens {open_ports - there} of {selector}, which has {there}"
    elif document["kind"] in ("Service", "PodDisruptionBudget") and not selected(spec["selector"], found):
        yield f"{name}: no pod is {spec['selector']}"


def secrets_named(part: Any) -> Iterator[tuple[str, str]]:
    """Yield name and key of every secret that a document refers to."""
    if isinstance(part, dict):
        if "secretKeyRef" in part:
            yield part["secretKeyRef"]["name"], part["secretKeyRef"]["key"]
        if part.get("mode") == "token":
            yield part["secretName"], "auth_token"
    for value in part.values() if isinstance(part, dict) else part if isinstance(part, list) else ():
        yield from secrets_named(value)


def size(text: str) -> int:
    match = re.fullmatch(r"(\d+)(Mi|Gi)", text)
    assert match, text
    return int(match[1]) * BYTES[match[2]]


@pytest.mark.parametrize("name", OVERLAYS)
def test_core_kinds_are_as_kubernetes_wants_them(name: str, tmp_path: Path):
    core = [document for document in overlay(name) if document["kind"] not in KUBERAY]
    assert len(core) > 15
    code, output = against_kubernetes(core, tmp_path / "core")
    assert code == 0, output


@pytest.mark.parametrize("name", OVERLAYS)
def test_kuberay_kinds_are_as_its_schemas_want_them(name: str):
    found = [document for document in overlay(name) if document["kind"] in KUBERAY]
    assert [document["kind"] for document in found] == ["RayCluster", "RayJob", "RayJob"]
    for document in found:
        assert against_kuberay(document) == []


def change(document: Document, path: str, value: Any) -> Document:
    """Return a document with another value, or a key more, at a path."""
    made = copy.deepcopy(document)
    *way, last = path.split("/")
    part: Any = made
    for key in way:
        part = part[int(key)] if key.isdigit() else part[key]
    part[last] = value
    return made


@pytest.mark.parametrize(
    ("kind", "path", "value"),
    [
        ("Deployment", "spec/replica", 1),
        ("Deployment", "spec/template/spec/containers/0/ports/0/containerPort", "http"),
        ("NetworkPolicy", "spec/ingres", []),
        ("PodDisruptionBudget", "spec/maxUnavailible", 1),
    ],
)
def test_a_core_kind_with_a_fault_is_refused(kind: str, path: str, value: Any, tmp_path: Path):
    document = next(iter(of_kind(kind).values()))
    code, output = against_kubernetes([change(document, path, value)], tmp_path / "core")
    assert code != 0, output


@pytest.mark.parametrize(
    ("kind", "path", "value"),
    [
        ("RayCluster", "spec/autoscalerOption", {}),
        ("RayCluster", "spec/authOptions/mode", "tokens"),
        ("RayCluster", "spec/workerGroupSpecs/0/maxReplica", 3),
        ("RayCluster", "spec/workerGroupSpecs/0/template/spec/containers/0/envs", []),
        ("RayCluster", "spec/headGroupSpec/rayStartParams/num-cpus", 0),
        ("RayJob", "spec/entryPoint", "true"),
        ("RayJob", "spec/submitterPodTemplate/spec/container", []),
    ],
)
def test_a_kuberay_kind_with_a_fault_is_refused(kind: str, path: str, value: Any):
    document = next(iter(of_kind(kind).values()))
    assert against_kuberay(document) == []
    assert against_kuberay(change(document, path, value))


def test_kustomize_finds_a_fault(tmp_path: Path):
    (tmp_path / "kustomization.yaml").write_text("resources: [cluster.yaml]\n")
    code, output = ask("kubectl", "kustomize", tmp_path)
    assert code != 0
    assert "cluster.yaml" in output


@pytest.mark.parametrize("name", OVERLAYS)
def test_what_is_selected_and_opened_is_there(name: str):
    found = list(overlay(name))
    assert [error for document in found for error in nowhere(document, containers(found))] == []


@pytest.mark.parametrize(
    ("kind", "path", "value"),
    [
        ("NetworkPolicy", "spec/podSelector", {"matchLabels": {"app": "ray"}}),
        ("PodDisruptionBudget", "spec/selector/matchLabels", {"ray.io/cluster": "dml"}),
        ("Service", "spec/selector", {"app": "mlflow"}),
    ],
)
def test_what_selects_nothing_is_found(kind: str, path: str, value: Any):
    found = list(overlay("cpu"))
    assert list(nowhere(change(next(iter(of_kind(kind).values())), path, value), containers(found)))


def test_a_port_that_nobody_has_is_found():
    found = list(overlay("cpu"))
    policy = change(of_kind("NetworkPolicy")["postgres"], "spec/ingress/0/ports/0/port", 5433)
    assert "5433" in next(nowhere(policy, containers(found)))


@pytest.mark.parametrize("name", OVERLAYS)
def test_containers_listen_on_what_they_say(name: str):
    for container in containers(list(overlay(name))):
        known = next((ports for word, ports in GIVEN.items() if word in container.where), None)
        listens = known if known is not None else listening(container.command)
        standard = {6379} if "--head" in container.command else set()
        assert container.ports <= listens | standard, container.where


@pytest.mark.parametrize("name", OVERLAYS)
def test_what_is_called_is_a_service(name: str):
    services = of_kind("Service", name)
    for container in containers(list(overlay(name))):
        for text in [*container.environment.values(), *container.command]:
            for host, port in re.findall(r"(?:http|postgresql\+psycopg2)://(?:\w+@)?([\w-]+):(\d+)", text):
                assert int(port) in {entry["port"] for entry in services[host]["spec"]["ports"]}, text


def test_a_services_port_is_named_by_its_pods():
    for service in of_kind("Service").values():
        (port,) = service["spec"]["ports"]
        for container in selected(service["spec"]["selector"], containers(list(overlay("cpu")))):
            assert container.ports >= {port["port"]}
            assert f'"containerPort": {port["port"]}, "name": "{port["targetPort"]}"' in json.dumps(overlay("cpu"))


def test_secrets_are_referred_to_and_made_by_the_generator():
    generator = documents(DEPLOY / "secrets" / "kustomization.yaml")[0]
    made = {
        (entry["name"], pair.partition("=")[0]) for entry in generator["secretGenerator"] for pair in entry["files"]
    }
    service = rendered(DEPLOY / "kuberay" / "serving")
    for name in OVERLAYS:
        found = [*overlay(name), *service]
        assert "Secret" not in {document["kind"] for document in found}
        assert set(secrets_named(found)) == made


def test_the_generator_makes_secrets_of_the_files(tmp_path: Path, make_secrets: Callable[[Path], None]):
    (tmp_path / "kustomization.yaml").write_bytes((DEPLOY / "secrets" / "kustomization.yaml").read_bytes())
    make_secrets(tmp_path)
    found = rendered(tmp_path)
    assert {document["metadata"]["name"] for document in found} == {"ray-token", "serve-token", "postgres-password"}
    code, output = against_kubernetes(found, tmp_path / "core")
    assert code == 0, output


@pytest.mark.parametrize("name", OVERLAYS)
def test_a_worker_has_the_memory_that_its_cpus_need(name: str):
    cluster = of_kind("RayCluster", name)["dmil"]
    (group,) = cluster["spec"]["workerGroupSpecs"]
    (container,) = group["template"]["spec"]["containers"]
    resources = container["resources"]
    assert resources["requests"] == resources["limits"]
    cpus, store = int(resources["limits"]["cpu"]), int(group["rayStartParams"]["object-store-memory"])
    assert cpus * WORKER_BYTES + store + 2**30 <= size(resources["limits"]["memory"])
    assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]


def test_only_the_gpu_overlay_asks_for_gpus():
    asked = {name: "nvidia.com/gpu" in json.dumps(overlay(name)) for name in OVERLAYS}
    assert asked == {"cpu": False, "gpu": True}


@pytest.mark.parametrize("name", OVERLAYS)
def test_every_container_is_restricted(name: str):
    text = json.dumps(list(overlay(name)))
    found = re.findall(r'"allowPrivilegeEscalation": (\w+), "capabilities": {"drop": \["(\w+)"\]}', text)
    assert found == [("false", "ALL")] * (len(containers(list(overlay(name)))) + 1)  # and the autoscaler


def test_everything_that_is_not_named_is_closed():
    spec = of_kind("NetworkPolicy")["nothing"]["spec"]
    assert spec == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}


def test_jobs_go_to_the_cluster_that_is_there():
    clusters = of_kind("RayCluster")
    for path in JOBS:
        (job,) = documents(path)
        assert job["spec"]["clusterSelector"]["ray.io/cluster"] in clusters
        assert job["metadata"]["namespace"] in of_kind("Namespace")
        assert f"--name {job['metadata']['name']}" in job["spec"]["entrypoint"]


def test_claims_are_made():
    claims = set(of_kind("PersistentVolumeClaim"))
    named = set(re.findall(r'"claimName": "([\w-]+)"', json.dumps(list(overlay("cpu")))))
    assert named == claims


def test_an_overlay_with_the_object_store_tells_every_ray_pod_of_it(tmp_path: Path):
    base, component = (os.path.relpath(DEPLOY / "kuberay" / part, tmp_path) for part in ("cpu", "object-store"))
    (tmp_path / "kustomization.yaml").write_text(
        yaml.safe_dump({"namespace": "dmil", "resources": [base], "components": [component]})
    )
    found = rendered(tmp_path)
    (cluster,) = [document for document in found if document["kind"] == "RayCluster"]
    assert against_kuberay(cluster) == []
    for group in (cluster["spec"]["headGroupSpec"], *cluster["spec"]["workerGroupSpecs"]):
        (container,) = group["template"]["spec"]["containers"]
        assert {"name": "DMIL_STORAGE", "value": "s3://BUCKET/dmil"} in container["env"]
        assert container["envFrom"] == [{"secretRef": {"name": "object-store"}}]
    (policy,) = [document for document in found if document["metadata"]["name"] == "object-store"]
    assert policy["spec"]["egress"] == [{"ports": [{"port": 443, "protocol": "TCP"}]}]
    assert selected(policy["spec"]["podSelector"], containers(found))
    code, output = against_kubernetes([policy], tmp_path / "core")
    assert code == 0, output
