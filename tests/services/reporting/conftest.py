import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page

from dmil_core.configs import preset_of
from services.cli.composition import checked
from services.cli.yaml_files import merged
from services.demonstrations.store import DemoStore, data_root
from services.distributed.runner import LocalRunner
from services.experiments.experiment import Experiment
from services.experiments.finished_run import FinishedRun
from services.storage.checkpoints import Checkpoints
from services.tracking.tracker import Tracker

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "planar_visits" / "planar_visits.py"


@dataclass
class Opened:
    """A page in a browser, and all that it asked for or complained of."""

    page: Page
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def faults(self) -> list[str]:
        """Return the serious and critical findings of axe."""
        found: list[dict[str, Any]] = Axe().run(self.page).response["violations"]
        return [
            f"{fault['id']}: {node['html'][:200]}"
            for fault in found
            if fault["impact"] in {"serious", "critical"}
            for node in fault["nodes"]
        ]

    def sorted_by(self, caption: str, column: str) -> list[str]:
        """Click a column's head in a table, and return what stands in the column then."""
        table = self.page.get_by_role("table", name=caption)
        table.get_by_role("button", name=column, exact=True).click()
        names = table.locator("thead th").all_inner_texts()
        place = next(i for i, name in enumerate(names, start=1) if name == column)
        return table.locator(f"tbody tr > :nth-child({place})").all_inner_texts()

    def pictures(self) -> list[tuple[str, float, float]]:
        """Return the text alternative and the size in pixels of every picture and video."""
        found = []
        for element in self.page.locator("main svg[role=img], main img, main video").all():
            box = element.bounding_box()
            told = element.evaluate(
                "e => e.alt || e.ariaLabel || [...e.querySelectorAll(':scope > title, :scope > desc')]"
                ".map(x => x.textContent).join(': ')"
            )
            found.append((told, box["width"] if box else 0.0, box["height"] if box else 0.0))
        return found


@pytest.fixture
def open_page(browser: Browser):
    """Open a file in the browser; at the end of the test it must have asked for nothing but itself."""
    context = browser.new_context(viewport={"width": 1200, "height": 900})

    def open_page(path: Path) -> Opened:
        page = context.new_page()
        opened = Opened(page)
        page.on("request", lambda request: opened.requests.append(request.url))
        page.on("console", lambda message: opened.complaints.append(message.text))
        page.on("pageerror", lambda error: opened.complaints.append(str(error)))
        page.goto(path.absolute().as_uri())
        opened.requests = [url for url in opened.requests if not url.startswith(("data:", path.absolute().as_uri()))]
        return opened

    yield open_page
    context.close()


@pytest.fixture(scope="session")
def planar_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the demonstrations of planar visits are kept, so that each is made once."""
    return tmp_path_factory.mktemp("planar-data")


@pytest.fixture
def planar_visits(tmp_path: Path, planar_data: Path, mlflow_file: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A suite whose episodes take no time, the example of the guide, as an installed package; an empty workplace."""
    package = tmp_path / "packages"
    information = package / "planar_visits-0.1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: planar-visits\nVersion: 0.1.0\n")
    (information / "entry_points.txt").write_text("[dmil.suites]\nplanar-visits = planar_visits:PlanarVisits\n")
    shutil.copy(EXAMPLE, package)
    monkeypatch.syspath_prepend(package)
    monkeypatch.delitem(sys.modules, "planar_visits", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DMIL_DATA", str(planar_data))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    return tmp_path


@pytest.fixture
def trained(planar_visits: Path) -> Callable[..., FinishedRun]:
    """Meta-trains a little on planar visits, and returns what is left: a checkpoint, without an evaluation."""

    def train(name: str, of: str = "dmil", **settings: Any) -> FinishedRun:
        config = preset_of("planar-visits", "smoke", of)
        given: dict[str, Any] = {"demonstrations": {"per_task": 14, "held_out": 8}}
        if config.training.iterations:
            given["training"] = {"iterations": 4, "checkpoint_every": 4}
        config = checked(merged(config.model_dump(), given | settings, "test"))
        experiment = Experiment(config, DemoStore(data_root()))
        runner = LocalRunner(experiment.suite)
        folder = planar_visits / "runs" / name
        folder.mkdir(parents=True)
        (folder / "config.json").write_text(config.model_dump_json())
        data = experiment.collect(runner)
        tracker = Tracker(folder, "test")
        experiment.train(runner, data, Checkpoints(folder / "checkpoints", 1), tracker)
        tracker.close("FINISHED")
        return FinishedRun(folder)

    return train
