"""The compose file: what Docker Compose says, and that its services find each other and let nobody else in."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.deploy.command_lines import listening
from tests.deploy.manifests import COMPOSE, DEPLOY, DOCKERFILE, ask, composed, documents, stages

pytestmark = pytest.mark.thorough

OTHERS = {"postgres": {5432}, "grafana": {3000}}
"""Ports that are the default of their programs."""
WITHOUT_A_USER_OF_THEIR_IMAGE = {"prometheus", "grafana"}
"""Images of others, which name one that is not root."""
ADDRESS = re.compile(r"(?:https?|postgresql\+psycopg2)://(?:\w+@)?([a-z][\w.-]*|127\.0\.0\.1):(\d+)")


def services() -> dict[str, dict[str, Any]]:
    return composed()["services"]


def ports(name: str) -> set[int]:
    return OTHERS.get(name, set()) | listening(services()[name].get("command") or ())


def addresses() -> list[tuple[str, str, int]]:
    """Return who speaks to whom on which port."""
    found = []
    for name, service in services().items():
        test = service.get("healthcheck", {}).get("test", [])
        texts = [*service.get("environment", {}).values(), *(service.get("command") or ()), *test]
        found += [(name, host, int(port)) for text in texts for host, port in ADDRESS.findall(str(text))]
        found += [
            (name, host, int(port)) for text in texts for host, port in re.findall(r"^--address=(\w+):(\d+)", text)
        ]
    (source,) = documents(DEPLOY / "grafana/provisioning/datasources/prometheus.yaml")[0]["datasources"]
    found += [("grafana", host, int(port)) for host, port in ADDRESS.findall(source["url"])]
    for scrape in documents(DEPLOY / "prometheus/prometheus.yaml")[0]["scrape_configs"]:
        for static in scrape.get("static_configs", ()):
            found += [("prometheus", *target.split(":")) for target in static["targets"]]
    return [(name, host, int(port)) for name, host, port in found]


def complaint(name: str, host: str, port: int) -> str | None:
    """Return what is wrong with an address that a service speaks to."""
    other = name if host == "127.0.0.1" else host
    if other not in services():
        return f"{name} speaks to {host}, which is no service"
    if not set(services()[name]["networks"]) & set(services()[other]["networks"]):
        return f"{name} shares no network with {other}"
    if port not in ports(other):
        return f"{name} speaks to {other} on {port}, which listens on {sorted(ports(other))}"
    return None


def test_docker_compose_takes_it():
    assert ask("docker-compose", "-f", COMPOSE, "config", "-q") == (0, "")


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("    healthcheck:", "    healthchecks:"),
        ("condition: service_healthy", "condition: healthy"),
        ("networks: [watch]", "networks: [watches]"),
    ],
)
def test_docker_compose_finds_a_fault(tmp_path: Path, before: str, after: str):
    text = COMPOSE.read_text("utf-8")
    assert before in text
    (tmp_path / "compose.yaml").write_text(text.replace(before, after))
    code, output = ask("docker-compose", "-f", tmp_path / "compose.yaml", "config", "-q")
    assert code != 0
    assert output


def test_services_speak_to_services_that_listen():
    found = addresses()
    assert len(found) > 12
    assert [error for address in found if (error := complaint(*address))] == []


@pytest.mark.parametrize(
    "address",
    [("head", "mlfow", 5000), ("head", "mlflow", 5001), ("head", "postgres", 5432), ("grafana", "head", 8265)],
)
def test_an_address_where_nobody_listens_is_found(address: tuple[str, str, int]):
    assert complaint(*address)


def test_ports_are_published_on_loopback_only_and_somebody_listens():
    published = {
        (name, port["host_ip"], port["target"], int(port["published"]))
        for name, service in services().items()
        for port in service.get("ports", ())
    }
    assert {name for name, *_ in published} == {"head", "mlflow", "prometheus", "grafana"}
    for name, address, target, there in published:
        assert address == "127.0.0.1"
        assert target in ports(name)
        assert there == target


def test_mlflow_answers_to_the_names_that_it_is_called_by():
    allowed = set(services()["mlflow"]["environment"]["MLFLOW_SERVER_ALLOWED_HOSTS"].split(","))
    called = services()["head"]["environment"]["MLFLOW_TRACKING_URI"].removeprefix("http://")
    assert {called, "127.0.0.1:5000", "localhost:5000"} == allowed


def test_mlflow_has_no_assistant():
    assert "--gunicorn-opts" in services()["mlflow"]["command"]


def test_the_head_asks_for_a_token():
    for name in ("head", "worker"):
        environment = services()[name]["environment"]
        assert environment["RAY_AUTH_MODE"] == "token"
        assert environment["RAY_AUTH_TOKEN_PATH"] == "/run/secrets/ray_token"
        assert {secret["source"] for secret in services()[name]["secrets"]} == {"ray_token", "storage_credentials"}


def test_runs_are_copied_to_a_bucket_that_is_made_and_opens_to_their_keys_alone(tmp_path: Path, make_secrets):
    buckets = services()["bucket"]["command"][2:]
    make_secrets(tmp_path)
    identities = {found["name"]: found for found in json.loads((tmp_path / "store.json").read_text())["identities"]}
    (keys,) = identities["dmil"]["credentials"]
    drawn = (tmp_path / "storage_credentials").read_text()
    for name in ("head", "worker"):
        environment = services()[name]["environment"]
        bucket = environment["DMIL_STORAGE"].removeprefix("s3://")
        assert bucket in buckets
        assert identities["dmil"]["actions"] == [f"{action}:{bucket}" for action in ("Read", "Write", "List")]
        assert environment["AWS_ENDPOINT_URL_S3"] == services()["mlflow"]["environment"]["MLFLOW_S3_ENDPOINT_URL"]
        assert environment["AWS_SHARED_CREDENTIALS_FILE"] == "/run/secrets/storage_credentials"
        assert {"storage"} < set(services()[name]["networks"])
    assert keys["accessKey"] in drawn
    assert keys["secretKey"] in drawn
    assert keys["accessKey"] not in (tmp_path / "store_credentials").read_text()


@pytest.mark.parametrize("name", sorted(services()))
def test_a_service_has_no_more_rights_than_it_needs(name: str):
    service = services()[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert "privileged" not in service
    built = service["image"].startswith("dmil:")
    assert built or service.get("user") or name in WITHOUT_A_USER_OF_THEIR_IMAGE


@pytest.mark.parametrize("name", sorted(set(services()) - {"bucket"}))
def test_a_service_says_whether_it_is_well(name: str):
    checked = {
        stage.name for stage in stages(DOCKERFILE.read_text("utf-8")).values() if "HEALTHCHECK" in str(stage.lines)
    }
    image = services()[name]["image"].partition(":")[2]
    assert "healthcheck" in services()[name] or image in checked | {"cpu"}


def test_nobody_starts_before_what_it_needs():
    needs = {
        name: {n: how["condition"] for n, how in s.get("depends_on", {}).items()} for name, s in services().items()
    }
    well = "service_healthy"
    assert needs["mlflow"] == {"postgres": well, "bucket": "service_completed_successfully"}
    assert needs["bucket"] == {"store": well}
    assert needs["head"] == {"mlflow": well}
    assert needs["worker"] == needs["prometheus"] == {"head": well}
    assert needs["grafana"] == {"prometheus": well}


def test_what_is_mounted_exists_and_what_is_kept_has_a_name():
    volumes = set(composed()["volumes"])
    used = set()
    for service in services().values():
        for mount in service.get("volumes", ()):
            if mount["type"] == "bind":
                assert Path(mount["source"]).exists(), mount
                assert mount["read_only"] is True
            else:
                used.add(mount["source"])
    assert used == volumes


def test_head_and_workers_see_the_same_folders():
    folders = {
        name: {mount["target"]: mount["source"] for mount in services()[name]["volumes"]} for name in ("head", "worker")
    }
    assert folders["worker"].items() <= folders["head"].items()
    assert services()["head"]["environment"]["DMIL_DATA"] in folders["worker"]


def test_the_database_and_the_store_are_out_of_reach():
    for name, network in (("postgres", "records"), ("store", "storage")):
        assert composed()["networks"][network]["internal"] is True
        assert list(services()[name]["networks"]) == [network]
