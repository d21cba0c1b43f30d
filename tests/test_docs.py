"""Every block of code in a page is run, or its command lines are read by their programs; the site and its notebook."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.cli.composition import config_from
from services.cli.yaml_files import read_yaml
from services.suites.rendering import RenderingError, working_backend
from services.sweeps.settings import Sweep
from tests.deploy.command_lines import refused
from tests.dmil_core.old_models import FOLDER

PROJECT = Path(__file__).parents[1]
PAGES = [PROJECT / "README.md", PROJECT / "CONTRIBUTING.md", *sorted((PROJECT / "docs").glob("*.md"))]
RUN_BY = {
    "README.md": "tests/dmil_core/test_model.py",
    "data.md": "tests/dmil_core/test_model.py",
    "mlflow.md": "tests/services/tracking/test_models.py",
    "use-a-policy.md": "tests/dmil_core/test_model.py",
    "your-own-method.md": "tests/services/experiments/test_methods.py",
    "your-own-task.md": "tests/services/suites/test_plug_ins.py",
}
"""The pages with blocks of Python, and what runs them or holds them against the example that it runs."""
ASKED = {"python", "dmil", "ray", "mlflow", "make"}
"""Programs that read their command lines here."""
NOT_ASKED = {
    "docker": "no container engine",
    "kubectl": "no cluster",
    "pip": "the examples are installed by tests/services/suites/test_plug_ins.py and test_methods.py",
    "ruff": "a checker, run by make test",
    "pyright": "a checker, run by make test",
    "sh": "deploy/make_secrets.sh, run by tests/deploy",
} | dict.fromkeys(("source", "export", "set", "for", "done", "do", "cd", "head", "tail"), "the shell's own")
TEXT, OTHERS = re.compile(r"```.*?```", re.DOTALL), {
    "address", "app-name", "allowed-hosts", "build-arg", "dashboard-host", "env-manager", "fail", "include-dashboard",
    "metrics-export-port", "namespace", "no-wait", "node-ip-address", "num-cpus", "runtime-env-json", "submission-id",
    "temp-dir", "working-dir",
}  # fmt: skip
"""What is no block, and flags in it of Ray, MLflow, Docker and pip."""


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```(?:{language})\n(.*?)```", page.read_text("utf-8"), re.DOTALL)


def commands_of(block: str) -> Iterator[list[str]]:
    """Yield the commands of a block of shell, its variables replaced and without what stands before a program."""
    text = block.replace("\\\n", " ")
    for name, value in re.findall(r'^(\w+)="(.*)"$', text, re.MULTILINE):
        text = re.sub(rf"\${name}\b", value, text).replace(f'{name}="{value}"\n', "")
    for line in text.splitlines():
        words = shlex.shlex(re.sub(r"\$\w+", "4", line), posix=True, punctuation_chars="&|;")
        words.whitespace_split = True
        command: list[str] = []
        for word in (*words, ";"):
            if not set(word) <= set("&|;"):
                command.append(word.removeprefix(".venv/bin/"))
                continue
            before = command[:1] and command[0] not in NOT_ASKED
            begun = next((at for at, each in enumerate(command) if before and each in ASKED), 0)
            if command and "=" not in command[begun]:
                yield command[begun:]
            command = []


def commands_in_text(page: Path) -> Iterator[list[str]]:
    """Yield the command lines of a page's text that have arguments; they need not have all that are required."""
    for span in re.findall(r"`([^`]+)`", TEXT.sub("", page.read_text("utf-8"))):
        words = shlex.split(span) if re.match(r"(python -m (services|benchmarks)\.[a-z]|dmil [a-z])", span) else []
        if len(words) > 2 + (words[:1] == ["python"]):
            yield words


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what the pages name: the examples, as installed packages, and a run."""
    for package, kind, entry in (
        ("planar_visits", "suites", "planar-visits = planar_visits:PlanarVisits"),
        ("fetch_reach", "suites", "fetch-reach = fetch_reach:FetchReach"),
        ("reptile", "methods", "reptile = reptile:Reptile"),
    ):
        (information := tmp_path / "lib" / f"{package}-1.0.dist-info").mkdir(parents=True)
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(f"[dmil.{kind}]\n{entry}\n")
        monkeypatch.delitem(sys.modules, package, raising=False)
    for example in (PROJECT / "docs" / "examples").glob("*/*.py"):
        shutil.copy(example, tmp_path / "lib")
    (fetch,) = [block for block in blocks(PROJECT / "docs" / "your-own-task.md", "python") if "FetchReach" in block]
    (tmp_path / "lib" / "fetch_reach.py").write_text(fetch)
    monkeypatch.syspath_prepend(tmp_path / "lib")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (run := tmp_path / "runs" / "NAME").mkdir(parents=True)
    shutil.copytree(FOLDER / "dmil", checkpoint := run / "checkpoints" / "iteration-0000001")
    manifest = json.loads((checkpoint / "manifest.json").read_text("utf-8"))
    (run / "config.json").write_text(json.dumps(manifest["config"]))
    for name in ("mine", "ml45"):
        shutil.copytree(run, tmp_path / "runs" / name)
    (tmp_path / "mine.yaml").write_text("method: {continuity_weight: 0.1}\n")
    return tmp_path


@pytest.mark.parametrize("page", [*PAGES, *PROJECT.glob("models/*/README.md")], ids=lambda page: page.name)
def test_every_command_line_of_a_page_is_taken(page: Path, workplace: Path):
    wrong = []
    for block in blocks(page, "bash|sh"):
        checked = subprocess.run(["bash", "-n"], input=block, capture_output=True, text=True)
        assert checked.returncode == 0, checked.stderr
        for command in commands_of(block):
            if command[0] in ASKED:
                wrong += [f"{shlex.join(command)}: {said}"] if (said := refused(command)) else []
            elif command[0] not in NOT_ASKED:
                wrong.append(f"{shlex.join(command)}: no program that is asked, or has a reason not to be")
    for command in commands_in_text(page):
        said = refused(command) or ""
        wrong += [f"{shlex.join(command)}: {said}"] if said and "Required options" not in said else []
    assert wrong == []


def test_every_flag_in_the_text_of_a_page_is_one():
    sources = [
        path for folder in ("dmil_core", "services", "benchmarks", "tests") for path in (PROJECT / folder).rglob("*.py")
    ]
    fields = {name for path in sources for name in re.findall(r"^    (\w+): ", path.read_text("utf-8"), re.MULTILINE)}
    known = OTHERS | {"help", ""} | {name.replace("_", "-") for name in fields}
    for page in PAGES:
        spans = " ".join(re.findall(r"`([^`]+)`", TEXT.sub("", page.read_text("utf-8"))))
        flags = {name.rpartition(".")[2] for name in re.findall(r"(?<!\S)--([a-z][\w.-]*)", spans)}
        assert {flag for flag in flags if flag.removeprefix("no-") not in known} == set(), page.name


def test_settings_in_the_pages_are_some(tmp_path: Path):
    (points,), (sweep,) = (blocks(PROJECT / "docs" / name, "yaml") for name in ("your-own-task.md", "sweeps.md"))
    for name, text in (("points.yaml", points), ("sweep.yaml", sweep)):
        (tmp_path / name).write_text(text)
    assert config_from("smoke", tmp_path / "points.yaml").suite.points is not None
    assert Sweep.model_validate(read_yaml(tmp_path / "sweep.yaml", "sweep")).row_names == ["DMIL", "DMIL_soft"]


def test_blocks_of_python_are_run_somewhere():
    assert {page.name for page in PAGES if blocks(page, "python")} == set(RUN_BY)
    assert all(page in (PROJECT / test).read_text("utf-8") for page, test in RUN_BY.items())
    languages = {word for page in PAGES for word in re.findall(r"^```(\w+)", page.read_text("utf-8"), re.MULTILINE)}
    assert languages == {"bash", "sh", "python", "yaml", "toml", "text", "math"}, "a test for blocks of another kind"


def test_the_navigation_has_every_page_and_the_readme_two_screens():
    navigation = (PROJECT / "mkdocs.yml").read_text("utf-8").partition("nav:")[2]
    assert [page.name for page in PAGES[1:] if page.name not in navigation] == [], "add it to mkdocs.yml"
    readme = PAGES[0].read_text("utf-8").splitlines()
    assert len(readme) <= 110
    assert max(map(len, readme)) <= 120
    assert [line for block in blocks(PAGES[0], "bash") for line in block.splitlines() if len(line) > 80] == []


@pytest.mark.thorough
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


@pytest.mark.thorough
def test_the_notebook_runs_and_is_committed_as_it_ran(tmp_path: Path):
    notebook = json.loads((PROJECT / "docs" / "first_run.ipynb").read_text("utf-8"))
    film = notebook["cells"][-2]["outputs"][-1]["data"]
    assert 10_000 < len(film["image/jpeg"]) < 100_000
    try:
        working_backend()
    except RenderingError:
        del notebook["cells"][-2]
    (copy := tmp_path / "copy.ipynb").write_text(json.dumps(notebook))
    command = [sys.executable, "-c", "from nbclient.cli import main; main()", "--inplace", str(copy)]
    subprocess.run(command, cwd=PROJECT, check=True)
    ran = json.loads(copy.read_text("utf-8"))["cells"]
    for before, after in zip(notebook["cells"], ran, strict=True):
        kinds = [[output["output_type"] for output in cell.get("outputs", [])] for cell in (before, after)]
        assert kinds[0] == kinds[1]
