"""The colours of sub-skills: the same ones on the terminal, in plots and in videos."""

COLOURS = (
    "#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#cc79a7", "#b8a900", "#882255", "#44aa99", "#999999",
)  # fmt: skip
"""Distinct to colour-blind eyes (Okabe and Ito 2008, with a darker yellow; the last three are Tol's)."""


def colour_of(index: int) -> str:
    """Return the colour of a sub-skill, the same everywhere; that of a line, where there are no sub-skills."""
    return COLOURS[index % len(COLOURS)]
