"""Prometheus and Grafana: their own checks, and that they ask for what the code exports."""

import json
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from ray.dashboard.modules.reporter.reporter_agent import METRICS_GAUGES

from services.distributed.metrics import MEASURES
from tests.deploy.manifests import DEPLOY, PROJECT, ask, composed, documents

pytestmark = pytest.mark.thorough

PROMETHEUS, GRAFANA = DEPLOY / "prometheus", DEPLOY / "grafana"
RULES = documents(PROMETHEUS / "alerts.yaml")[0]["groups"][0]["rules"]
DASHBOARD = json.loads((GRAFANA / "dashboards" / "dmil.json").read_text("utf-8"))
SUFFIXES = {"counter": ("_total",), "gauge": ("",), "histogram": ("_bucket", "_sum", "_count")}
EXPORTED = {
    f"ray_{measure.name}{suffix}": {"suite", *measure.labels, *({"le"} if suffix == "_bucket" else ())}
    for measure in MEASURES
    for suffix in SUFFIXES[measure.kind]
}
"""Names that Ray gives our metrics, and their labels."""
RAYS_OWN = {f"ray_{name}" for name in METRICS_GAUGES}


def expressions(part: Any) -> Iterator[str]:
    """Yield every query of a dashboard or of rules."""
    if isinstance(part, dict):
        yield from (part[key] for key in ("expr", "definition") if key in part)
    for value in part.values() if isinstance(part, dict) else part if isinstance(part, list) else ():
        yield from expressions(value)


def complaints(queries: Sequence[str]) -> list[str]:
    """Return what queries ask for that nobody exports."""
    found = []
    for query in queries:
        names = set(re.findall(r"\bray_\w+", query))
        found += [f"{name}: nobody exports it" for name in sorted(names - set(EXPORTED) - RAYS_OWN)]
        known = set().union(*(EXPORTED.get(name, set()) for name in names))
        for labels in re.findall(r"\b(?:by|on|ignoring) \(([^)]*)\)|\{(\w+)=", query):
            for label in re.findall(r"\w+", " ".join(labels)):
                if names & set(EXPORTED) and label not in known:
                    found.append(f"{label}: no label of {', '.join(sorted(names))}")
    return found


def sources(part: Any) -> Iterator[str]:
    """Yield the uid of every data source that a dashboard asks."""
    if isinstance(part, dict):
        if isinstance(part.get("datasource"), dict):
            yield part["datasource"]["uid"]
        for value in part.values():
            yield from sources(value)
    elif isinstance(part, list):
        for value in part:
            yield from sources(value)


def headings(page: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", page, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title).strip().lower().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("name", ["prometheus.yaml", "kubernetes.yaml"])
def test_promtool_takes_the_configuration(name: str):
    code, output = ask("promtool", "check", "config", PROMETHEUS / name)
    assert code == 0, output
    assert "4 rules found" in output


def test_promtool_finds_a_fault(tmp_path: Path):
    folder = tmp_path / "prometheus"
    shutil.copytree(PROMETHEUS, folder)
    for name, before, after in [
        ("prometheus.yaml", "file_sd_configs", "file_sd"),
        ("alerts.yaml", "for: 8m", "for: soon"),
    ]:
        text = (PROMETHEUS / name).read_text("utf-8")
        (folder / name).write_text(text.replace(before, after))
        assert ask("promtool", "check", "config", folder / "prometheus.yaml")[0] != 0
        (folder / name).write_text(text)
    assert ask("promtool", "check", "config", folder / "prometheus.yaml")[0] == 0


def alerts_tested(folder: Path, rules: str) -> tuple[int, str]:
    """Run the alerts' tests on rules."""
    (folder / "alerts.yaml").write_text(rules)
    shutil.copy(Path(__file__).parent / "alerts_test.yaml", folder)
    return ask("promtool", "test", "rules", "alerts_test.yaml", cwd=folder)


def test_alerts_fire_when_they_should(tmp_path: Path):
    code, output = alerts_tested(tmp_path, (PROMETHEUS / "alerts.yaml").read_text("utf-8"))
    assert code == 0, output


@pytest.mark.parametrize(
    ("before", "after"),
    [("> 3600", "> 36000"), ("for: 8m", "for: 2m"), ("> 3 *", "> 0 *"), ("[15m])) > 0\n", "[15m])) > 999\n")],
)
def test_an_alert_that_fires_otherwise_is_found(before: str, after: str, tmp_path: Path):
    text = (PROMETHEUS / "alerts.yaml").read_text("utf-8")
    assert before in text
    assert alerts_tested(tmp_path, text.replace(before, after))[0] != 0


def test_every_query_asks_for_what_is_exported():
    queries = [*expressions(RULES), *expressions(DASHBOARD)]
    assert len(queries) > 20
    assert complaints(queries) == []


def test_every_measure_of_ours_is_shown():
    asked = " ".join(expressions(DASHBOARD))
    assert [measure.name for measure in MEASURES if f"ray_{measure.name}" not in asked] == []


@pytest.mark.parametrize(
    ("query", "word"),
    [
        ("rate(ray_dmil_iterations[5m])", "ray_dmil_iterations"),
        ("ray_dmil_spool_length", "ray_dmil_spool_length"),
        ("sum by (task) (ray_dmil_workers)", "task"),
        ('ray_dmil_workers{type="adaptation"}', "type"),
        ("ray_node_cpus", "ray_node_cpus"),
    ],
)
def test_a_query_for_what_nobody_exports_is_found(query: str, word: str):
    (found,) = complaints([query])
    assert found.startswith(word)


def test_the_dashboard_asks_the_provisioned_source():
    provisioned = {
        source["uid"] for source in documents(GRAFANA / "provisioning/datasources/prometheus.yaml")[0]["datasources"]
    }
    asked = list(sources(DASHBOARD))
    assert set(asked) == provisioned
    assert len(asked) > 2 * len(DASHBOARD["panels"])
    assert list(sources({"panels": [{"datasource": {"uid": "other"}}]})) == ["other"]


def test_the_dashboard_is_whole():
    panels = DASHBOARD["panels"]
    assert [panel["id"] for panel in panels] == list(range(1, len(panels) + 1))
    assert DASHBOARD["uid"] == "dmil"
    taken = [
        (x, y)
        for panel in panels
        for x in range(panel["gridPos"]["x"], panel["gridPos"]["x"] + panel["gridPos"]["w"])
        for y in range(panel["gridPos"]["y"], panel["gridPos"]["y"] + panel["gridPos"]["h"])
    ]
    assert len(taken) == len(set(taken)), "two panels lie over each other"
    assert max(x for x, _ in taken) < 24


def test_the_dashboard_is_where_grafana_looks():
    (provider,) = documents(GRAFANA / "provisioning/dashboards/dmil.yaml")[0]["providers"]
    mounted = {mount["target"]: Path(mount["source"]) for mount in composed()["services"]["grafana"]["volumes"]}
    assert (mounted[provider["options"]["path"]] / "dmil.json").is_file()


def test_every_alert_has_a_paragraph_in_the_runbook():
    page = (PROJECT / "docs" / "operations.md").read_text("utf-8")
    assert len(RULES) == 4
    for rule in RULES:
        path, _, anchor = rule["annotations"]["runbook"].partition("#")
        assert path == "docs/operations.md"
        assert anchor == rule["alert"].lower()
        assert anchor in headings(page), rule["alert"]


def test_prometheus_reads_the_list_that_ray_writes():
    (scrape,) = (s for s in documents(PROMETHEUS / "prometheus.yaml")[0]["scrape_configs"] if s["job_name"] == "ray")
    (file,) = scrape["file_sd_configs"][0]["files"]
    folder = {mount["target"] for mount in composed()["services"]["prometheus"]["volumes"]}
    assert str(Path(file).parent) in folder
    assert str(Path(file).parent) in {mount["target"] for mount in composed()["services"]["head"]["volumes"]}
