"""Pages in a real browser: what they ask for, complain of, and show to whoever cannot see."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, sync_playwright

CHROMIUM = shutil.which("chromium")


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.fail("no chromium here; wanted it for the tests of pages: apt-get install chromium")
    with sync_playwright() as playwright:
        # Its sandbox does not work for root, and the pages are our own.
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


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
            description = element.evaluate(
                "e => e.alt || e.ariaLabel || [...e.querySelectorAll(':scope > title, :scope > desc')]"
                ".map(x => x.textContent).join(': ')"
            )
            found.append((description, box["width"] if box else 0.0, box["height"] if box else 0.0))
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
