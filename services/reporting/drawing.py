"""Plots as inline SVG: legible in light and dark, with a text alternative, each sub-skill in one colour everywhere."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import StringIO
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup, escape
from matplotlib import rc_context, style
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

from services.cli.colours import COLOURS, colour_of

DASHES = ("solid", "dashed", "dotted", "dashdot")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
INK = "#010203"
"""Stands for the page's own colour of text until the SVG is on the page."""
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "dmil",
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "legend.framealpha": 0.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "figure.constrained_layout.h_pad": 0.09,
    "figure.constrained_layout.w_pad": 0.09,
    "grid.alpha": 0.2,
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "text.parse_math": False,  # names are text
} | dict.fromkeys(
    ("text.color", "axes.labelcolor", "axes.edgecolor", "axes.titlecolor", "xtick.color", "ytick.color", "grid.color"),
    INK,
)
_numbers = count(1)


class Picture(NamedTuple):
    """A plot as it goes into a page."""

    title: str
    description: str
    """What it shows, for whoever does not see it."""
    svg: str


def style_of(index: int) -> dict[str, Any]:
    """Return how one of several lines is drawn: by colour, and where colours begin again by its dashes."""
    return {"color": colour_of(index), "linestyle": DASHES[index // len(COLOURS) % len(DASHES)]}


def marker_of(index: int) -> str:
    """Return the marker of a sub-skill, the same in every picture; that of a line, where there are no sub-skills."""
    return MARKERS[index % len(MARKERS)]


def ink_on(colour: Any) -> str:
    """Return black or white, whichever has the higher contrast with a colour (WCAG 2)."""
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in to_rgb(colour)]
    return "#000000" if np.dot(linear, (0.2126, 0.7152, 0.0722)) > 0.179 else "#ffffff"


def legend_of_markers(figure: Figure, names: Sequence[str], linestyle: Any = "none") -> None:
    """Draw a legend below a figure, with the colour and the marker of each name."""
    handles = [Line2D([], [], marker=marker_of(k), color=colour_of(k), linestyle=linestyle) for k in range(len(names))]
    figure.legend(handles, names, loc="outside lower center", ncols=min(len(names), 6), frameon=False)


def scale_by_logarithms(axis: Axes) -> None:
    """Scale an axis upwards by logarithms, with plain numbers beside it."""
    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_locator(NullLocator())


@contextmanager
def panels(
    rows: int = 1, columns: int = 1, *, width: float = 7.0, height: float = 3.0
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Give a figure with a grid of axes, `width` by `height` inches of 72 points in all, in the style of all pictures.

    It is no figure of pyplot's, so that no backend is set for a process that draws in windows of its own.
    """
    # Whatever a matplotlibrc in the working directory says.
    with style.context("default"), rc_context(STYLE):
        figure = Figure((width, height), layout="constrained")
        yield figure, list(figure.subplots(rows, columns, squeeze=False).flat)


def to_picture(figure: Figure, title: str, description: str) -> Picture:
    """Return a figure as inline SVG that has a size, a text alternative, and ids that no other picture has."""
    text = StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = text.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    # Half as long with two decimals.
    svg = re.sub(r'\b[dxy]="[^"]*"', lambda numbers: re.sub(r"(\.\d\d)\d+", r"\1", numbers[0]), svg)
    prefix = f"p{next(_numbers)}-"
    svg = re.sub(r'(\bid="|xlink:href="#|url\(#)', rf"\g<1>{prefix}", svg).replace(INK, "currentColor")
    head = f'role="img" aria-labelledby="{prefix}title {prefix}description"'
    texts = f'<title id="{prefix}title">{escape(title)}</title>'
    texts += f'<desc id="{prefix}description">{escape(description)}</desc>'
    opening, content = svg.split(">", 1)
    return Picture(title, description, Markup(f"{opening} {head}>{texts}{content}"))
