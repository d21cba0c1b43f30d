"""A page as one file: headings, prose, tables that sort, pictures, videos; nothing in it comes from elsewhere."""

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from dmil_core.files import read_file, write_file
from services.reporting.drawing import Picture

MOST_BYTES = 2**28
"""Of a film."""
NUMBER = re.compile(r"([+−-]?[\d.,]+%?(/[\d.,]+)?( (to|±) [+−-]?[\d.,]+)?( \(.*\))?)?")
"""A number, a count of how many, an interval, or nothing."""
TYPES = {".mp4": "video/mp4", ".gif": "image/gif"}


@dataclass(frozen=True)
class Prose:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Notice(Prose):
    """A paragraph in a coloured box: what to know before all else."""

    section: str = ""
    """What the title of the section with more on it begins with; a link leads there where the page has one."""


@dataclass(frozen=True)
class Commands:
    """Command lines, to be copied."""

    caption: str
    lines: Sequence[str]


@dataclass(frozen=True)
class DataTable:
    """A table that sorts where its head is clicked; numbers sort as numbers, also those with more text behind them."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str | int | float]]
    folded: bool = False
    """Whether only the caption is seen at first."""

    @property
    def numeric(self) -> list[bool]:
        """Of each column, whether it has numbers alone, which stand at its right."""
        columns = zip(*self.rows, strict=True)
        return [all(NUMBER.fullmatch(str(field)) for field in column) for column in columns] or [False] * len(self.head)


@dataclass(frozen=True)
class Clip:
    """A video, which goes into the page as it is."""

    caption: str
    """What happens in it: its text alternative too."""
    path: Path
    """An MP4 or a GIF."""

    @property
    def type(self) -> str:
        """Its media type."""
        return TYPES[self.path.suffix]

    @property
    def address(self) -> str:
        """All of it, as a data URL."""
        content = read_file(self.path.parent, self.path.name, MOST_BYTES)
        return f"data:{self.type};base64,{base64.b64encode(content).decode()}"


Part = Prose | Notice | Commands | DataTable | Picture | Clip


@dataclass(frozen=True)
class Section:
    """A chapter of a page."""

    title: str
    parts: Sequence[Part]
    id: str = field(init=False)

    def __post_init__(self) -> None:
        words = "".join(letter if letter.isalnum() else " " for letter in self.title.lower()).split()
        object.__setattr__(self, "id", "-".join(words))


def templates_of(*packages: str) -> Environment:
    """Return the templates of some packages; the first one's come first."""
    loader = ChoiceLoader([PackageLoader(package) for package in packages])
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def write_page(path: Path, title: str, lead: Sequence[Part], sections: Sequence[Section]) -> None:
    """Write a page, the lead above all sections; those without parts are left out, and titles differ.

    Raises:
        DiskFullError: for want of space; the file is then what it was.
    """
    templates = templates_of("services.reporting")
    templates.filters["kind"] = lambda part: type(part).__name__
    kept = [section for section in sections if section.parts]
    page = templates.get_template("page.html").render(
        title=title, lead=lead, sections=kept, ids={section.title: section.id for section in kept}
    )
    write_file(path.parent, path.name, page)
