"""Text of somebody else's, such as a name, as another program is to take it: as text and nothing more."""

import re

CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""What moves a terminal's cursor, colours it or types into it, turns the direction of text, or is no character."""
MARKDOWN = re.compile(r"[\\`*<|]|\](?=[(\[:])|(?<!\w)_|_(?!\w)")
LATEX = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"λ": r"$\lambda$", "σ": r"$\sigma$"}
)


def one_line(text: str) -> str:
    """Return a text without line breaks, as for a comment, and with control characters as escapes."""
    return for_terminal(" ".join(text.split()))


def for_terminal(text: str) -> str:
    r"""Return a text whose control characters but tabs and line breaks are written out, as ``\x1b``."""
    return CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def for_markdown(text: str) -> str:
    """Return a text in one line that Markdown shows as it is: no HTML, no link, no column of a table."""
    return MARKDOWN.sub(r"\\\g<0>", one_line(text))


def for_latex(text: str) -> str:
    """Return a text in one line that LaTeX sets as it is."""
    return one_line(text).translate(LATEX)


def for_csv(value: object) -> object:
    """Return a value that no spreadsheet takes for a formula: a text that begins as one is quoted."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) else value
