"""What a user sees of a run in MLflow: the pages of a real server, in a real browser."""

import os
from collections.abc import Callable, Iterator

import matplotlib.image
import numpy as np
import pytest
from mlflow import MlflowClient
from playwright.sync_api import Browser, Page, expect

from services import meta_train
from services.demonstrations.store import DemoStore
from services.experiments.finished_run import FinishedRun
from services.tracking.__main__ import run as tracking_program
from services.tracking.delivery import Identity
from services.tracking.links import comparison_link, run_link
from tests.services.programs import QUICK_EVALUATION, Server

pytestmark = pytest.mark.thorough
MILLISECONDS = 60_000


@pytest.fixture(scope="module")
def tracked(mlflow_server: Server, store: DemoStore, tmp_path_factory: pytest.TempPathFactory) -> Iterator[FinishedRun]:
    """A run whose records the server has."""
    runs = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("DMIL_DATA", str(store.root))
        environment.setenv("MLFLOW_TRACKING_URI", mlflow_server.uri)
        arguments = ["--preset", "ml10-smoke", "--runner", "local", "--runs", str(runs), "--name", "seen"]
        meta_train.run([*arguments, "--training.iterations", "3", *QUICK_EVALUATION])
        yield FinishedRun(runs / "seen")


@pytest.fixture
def visit(browser: Browser) -> Iterator[Callable[[str], Page]]:
    """Opens pages of MLflow, which are of the kind that never come to rest."""
    context = browser.new_context(viewport={"width": 1400, "height": 1000})
    context.set_default_timeout(MILLISECONDS)
    expect.set_options(timeout=MILLISECONDS)

    def visit(address: str) -> Page:
        page = context.new_page()
        page.goto(address, wait_until="domcontentloaded")
        return page

    yield visit
    context.close()


def page_of(run: FinishedRun, below: str = "") -> str:
    """Return the address of a run's page, or of one below it."""
    identity = Identity.of(run.folder)
    link = run_link(os.environ["MLFLOW_TRACKING_URI"], str(identity.experiment_id), str(identity.run_id))
    address, mark, asked = link.partition("?")
    return f"{address}{below}{mark}{asked}"


def test_its_first_page_has_the_table_and_the_tags(tracked: FinishedRun, visit):
    page = visit(page_of(tracked))
    expect(page.get_by_text("Success rates of dmil (goal visible")).to_be_visible()
    table = page.locator("table", has=page.get_by_text("95% interval"))
    expect(table.first).to_contain_text("meta-testing")
    for tag in ("suite", "method", "seed", "shots", "data"):
        expect(page.get_by_text(f"{tag}:", exact=True).or_(page.get_by_text(tag, exact=True)).first).to_be_visible()
    tags = MlflowClient().get_run(str(Identity.of(tracked.folder).run_id)).data.tags
    assert (tags["suite"], tags["method"], tags["seed"], tags["shots"]) == ("ml10", "dmil", "0", "1")
    digests = tracked.checkpoint.manifest.data
    assert all(f"/{task}/" in tags["data"] and digest[:12] in tags["data"] for task, digest in digests.items())


def test_its_report_shows_with_its_figures(tracked: FinishedRun, visit):
    frame = visit(page_of(tracked, "/artifacts/report/report.html")).frame_locator("iframe")
    expect(frame.get_by_role("heading", name="seen: dmil on ml10")).to_be_visible()
    figures = frame.locator("main svg[role=img]")
    expect(figures.first).to_be_visible()
    box = figures.first.bounding_box()
    assert box is not None
    assert min(box["width"], box["height"]) > 60
    assert figures.count() >= 4


def test_what_was_drawn_later_is_there_after_the_report_is_delivered_again(
    tracked: FinishedRun, visit, capsys: pytest.CaptureFixture[str]
):
    before = MlflowClient().get_run(str(Identity.of(tracked.folder).run_id)).info
    (tracked.folder / "report" / "videos").mkdir()
    matplotlib.image.imsave(tracked.folder / "report" / "videos" / "reach.png", np.zeros((40, 60, 3)))
    tracking_program(["report", str(tracked.folder)])
    assert "delivered: 1 of 1 records" in capsys.readouterr().out
    page = visit(page_of(tracked, "/artifacts/report/videos/reach.png"))
    expect(page.locator("img[src^='blob:']").first).to_be_visible()
    after = MlflowClient().get_run(before.run_id).info
    assert (after.status, after.end_time) == ("FINISHED", before.end_time)


def test_load_of_the_machine_is_among_the_system_metrics(tracked: FinishedRun, visit):
    page = visit(page_of(tracked, "/system-metrics"))
    for name in ("cpu_utilization_percentage", "disk_usage_percentage"):
        expect(page.get_by_text(name).first).to_be_visible()


def test_a_link_opens_the_comparison_of_the_runs_that_it_names(tracked: FinishedRun, visit):
    client, identity = MlflowClient(), Identity.of(tracked.folder)
    experiment = str(identity.experiment_id)
    other = client.create_run(experiment, run_name="the other").info.run_id
    client.log_metric(other, "loss", 0.5)
    page = visit(comparison_link(os.environ["MLFLOW_TRACKING_URI"], experiment, [str(identity.run_id), other]))
    expect(page.get_by_text("Comparing 2 Runs from 1 Experiment")).to_be_visible()
    for name in ("seen", "the other"):
        expect(page.get_by_text(name, exact=True).first).to_be_visible()
