"""Names that somebody else chose, in what other programs read."""

import csv
import html
import io

import pytest
from markdown_it import MarkdownIt
from rich.table import Table

from services.cli.escapes import for_csv, for_latex, for_markdown, one_line
from services.cli.progress import console

NAMES = (
    "<img src=x onerror=alert(1)>", "[x](javascript:alert(1))", "![x][y]", "a|b", "`c`", "*d* _e_ f_g", "\\", "[y]: z",
    "one\n\n# two", "=HYPERLINK(1)", "+1", "-2", "@x", r"\input{/etc/passwd}", "$x^2$~", "[red]r[/] :smile:",
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_markdown_shows_a_name_as_it_is(name: str):
    shown = MarkdownIt("commonmark").enable("table").render(f"| {for_markdown(name)} |\n| --- |\n")
    assert f"<th>{html.escape(' '.join(name.split()))}</th>" in shown


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        (r"\input{/etc/passwd}", r"\textbackslash{}input\{/etc/passwd\}"),
        ("$x^2$~%\n\nb", r"\$x\textasciicircum{}2\$\textasciitilde{}\% b"),
        ("λ_1 & #2", r"$\lambda$\_1 \& \#2"),
    ],
)
def test_latex_sets_a_name_as_it_is(name: str, wanted: str):
    assert for_latex(name) == wanted


def test_no_spreadsheet_takes_a_name_for_a_formula():
    text = io.StringIO()
    csv.writer(text).writerow(map(for_csv, (*NAMES, -1.5, None)))
    (row,) = csv.reader(io.StringIO(text.getvalue()))
    assert [field for field in row if field[:1] in "=+-@" and field != ""] == ["-1.5"]


@pytest.mark.parametrize("name", ["\x1b]0;t\x07", "\x9b2J", "a\x1b[31m", "\u202egnp.exe", "\udcff", "\r-rf", "\x00"])
def test_a_terminal_is_not_steered_by_a_name(name: str, capsys: pytest.CaptureFixture[str]):
    view = Table(name, title=name)
    view.add_row(name)
    console.print(view)
    console.print(f"name: {name}")
    printed = capsys.readouterr().out
    assert printed.count(name.encode("unicode_escape").decode()) == 4
    assert not set(printed) & set("\x1b\x07\x9b\u202e\udcff\r\x00")
    assert "\n" not in one_line(f"{name}\n")


def test_names_are_no_markup_on_the_console(capsys: pytest.CaptureFixture[str]):
    view = Table()
    view.add_row("[red]r[/] :smile:")
    console.print(view)
    console.print("[bold]b[/bold]")
    printed = capsys.readouterr().out
    assert "[red]r[/] :smile:" in printed
    assert "[bold]b[/bold]" in printed
