"""What `make docs` does to pages on their way to the site: those outside docs/, equations, the notebook."""

import json
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

PROJECT = Path(__file__).parents[1]
ROOT_PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "CONTRIBUTING.md", "CHANGELOG.md": "CHANGELOG.md"} | {
    f"models/{card.parent.name}/README.md": f"models/{card.parent.name}.md"
    for card in (PROJECT / "models").glob("*/README.md")
}
EQUATION = re.compile(r"^```math\n(.*?)^```$", re.DOTALL | re.MULTILINE)
NOTEBOOK = "first_run"


def on_files(files: Files, config: Any) -> Files:
    """Add the pages outside docs/, the licence, and the notebook as a page."""
    for name, place in ROOT_PAGES.items():
        text = (PROJECT / name).read_text("utf-8").replace("](docs/", "](")
        files.append(File.generated(config, place, content=text))
    files.append(File.generated(config, "LICENSE", content=(PROJECT / "LICENSE").read_text("utf-8")))
    if (notebook := PROJECT / "docs" / f"{NOTEBOOK}.ipynb").exists():
        files.append(File.generated(config, f"{NOTEBOOK}.md", content=notebook_page(notebook.read_text("utf-8"))))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Turn links to the root into links of the site, and equations into MathML, which browsers show by themselves."""
    for name, place in ROOT_PAGES.items():
        markdown = markdown.replace(f"](../{name}", f"]({place}")
    markdown = markdown.replace(f"]({NOTEBOOK}.ipynb)", f"]({NOTEBOOK}.md)")
    return EQUATION.sub(lambda found: f"<div>{convert(found[1], display='block')}</div>", markdown)


def notebook_page(text: str) -> str:
    """Return a notebook as Markdown: its text, its code, and what its cells printed and drew."""
    return "\n\n".join(part for cell in json.loads(text)["cells"] for part in _parts(cell))


def _parts(cell: dict[str, Any]) -> list[str]:
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return [source]
    parts = [f"```python\n{source}\n```"]
    for output in cell["outputs"]:
        data = output.get("data", {})
        if drawn := [f"data:{kind};base64,{data[kind].strip()}" for kind in data if kind.startswith("image/")]:
            parts.append(f"![What the code above draws]({drawn[0]})")
        elif shown := "".join(output.get("text", data.get("text/plain", ""))):
            parts.append(f"```text\n{shown.rstrip()}\n```")
    return parts
