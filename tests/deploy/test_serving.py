"""The service on Kubernetes: its manifest against the schema, and what it has Ray Serve run."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from ray.serve._private.api import call_user_app_builder_with_args_if_necessary
from ray.serve.schema import ServeDeploySchema

from services.serving.deployment import Arguments, built
from tests.deploy.command_lines import listening
from tests.deploy.manifests import DEPLOY, Document, containers, overlay, rendered
from tests.deploy.test_kubernetes import against_kuberay, against_kubernetes, change, nowhere

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def found() -> list[Document]:
    return rendered(DEPLOY / "kuberay" / "serving")


@pytest.fixture(scope="module")
def service(found: list[Document]) -> Document:
    (service,) = [document for document in found if document["kind"] == "RayService"]
    return service


def test_its_documents_are_as_kubernetes_and_kuberay_want_them(
    found: list[Document], service: Document, tmp_path: Path
):
    assert against_kuberay(service) == []
    assert against_kuberay(change(service, "spec/serveConfig", "applications: []"))
    assert against_kuberay(change(service, "spec/rayClusterConfig/headGroupSpec/template/spec/container", []))
    code, output = against_kubernetes([one for one in found if one is not service], tmp_path / "core")
    assert code == 0, output


def test_what_it_selects_opens_and_mounts_is_there(found: list[Document], service: Document):
    made = containers([service])
    client = made[0]._replace(labels={"dmil/client": "true"})
    assert [fault for one in found for fault in nowhere(one, [*made, client])] == []
    claims = {one["metadata"]["name"] for one in overlay("cpu") if one["kind"] == "PersistentVolumeClaim"}
    for container in made:
        assert container.ports <= listening(container.command) | ({6379} if "--head" in container.command else set())
        assert container.resources["requests"] == container.resources["limits"]
    assert all(
        volume["persistentVolumeClaim"]["claimName"] in claims
        for group in (service["spec"]["rayClusterConfig"][key] for key in ("headGroupSpec",))
        for volume in group["template"]["spec"]["volumes"]
    )


def test_ray_serve_takes_its_application(service: Document, monkeypatch: pytest.MonkeyPatch):
    config: dict[str, Any] = yaml.safe_load(service["spec"]["serveConfigV2"])
    (application,) = ServeDeploySchema.model_validate(config).applications
    assert application.import_path == f"{built.__module__}:{built.__name__}"
    monkeypatch.setenv("DMIL_SERVE_TOKEN", "a" * 32)
    made = call_user_app_builder_with_args_if_necessary(built, application.args)
    (arguments,) = made._bound_deployment.init_args
    assert isinstance(arguments, Arguments)
    assert arguments.port is None
    workers = service["spec"]["rayClusterConfig"]["workerGroupSpecs"][0]["template"]["spec"]["containers"][0]
    assert int(workers["resources"]["limits"]["cpu"]) >= arguments.replicas
