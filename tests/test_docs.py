"""The documentation's site is built without a warning and loads nothing from another place; its notebook runs."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[1]
pytestmark = pytest.mark.thorough


def test_the_site_is_whole_and_loads_nothing_from_a_network(tmp_path: Path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, cwd=PROJECT, env=environment, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    assert "<math" in (tmp_path / "concepts.html").read_text("utf-8")
    assert 'id="dmil_core.model.load"' in (tmp_path / "api.html").read_text("utf-8")
    for page in tmp_path.rglob("*.html"):
        text = page.read_text("utf-8")
        assert re.findall(r"<(?:script|link|img|iframe)\b[^>]*(?:src|href)=\W*(?:https?:)?//[^>]*>", text) == [], page


def test_the_notebook_runs_and_is_committed_as_it_ran(tmp_path: Path):
    notebook, executed = PROJECT / "docs" / "first_run.ipynb", tmp_path / "executed.ipynb"
    code = "from nbclient.cli import main; main()"
    subprocess.run(
        [sys.executable, "-c", code, f"--output={executed.with_suffix('')}", str(notebook)], cwd=PROJECT, check=True
    )
    committed, ran = (json.loads(path.read_text("utf-8"))["cells"] for path in (notebook, executed))
    kinds = [[output["output_type"] for output in cell.get("outputs", [])] for cell in committed]
    assert kinds == [[output["output_type"] for output in cell.get("outputs", [])] for cell in ran]
    assert "image/jpeg" in next(cell for cell in reversed(committed) if cell.get("outputs"))["outputs"][-1]["data"]
    assert notebook.stat().st_size < 100_000
