"""What holds for every source file of the project: nothing is unpickled, and a file's name says what is in it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[1]
FILES = [
    path for package in ("dmil_core", "services", "benchmarks") for path in sorted((PROJECT / package).rglob("*.py"))
]

UNPICKLING_MODULES = {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}
UNPICKLING_CALLS = {"torch.load", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "pandas.read_pickle"}
VAGUE_NAMES = {"utils.py", "util.py", "helpers.py", "helper.py", "common.py", "misc.py"}


def unpickling(source: str) -> Iterator[str]:
    """Yield what could run code out of a file that is read."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.partition(".")[0] in UNPICKLING_MODULES)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            yield from names & UNPICKLING_CALLS
            if node.module.partition(".")[0] in UNPICKLING_MODULES:
                yield node.module
        elif isinstance(node, ast.Attribute) and (call := ast.unparse(node)) in UNPICKLING_CALLS:
            yield call
        elif isinstance(node, ast.keyword) and node.arg == "allow_pickle" and ast.unparse(node.value) != "False":
            yield ast.unparse(node)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PROJECT)))
def test_nothing_is_unpickled(path: Path):
    assert list(unpickling(path.read_text("utf-8"))) == []


def test_a_name_says_what_is_in_the_file():
    assert [path for path in FILES if path.name in VAGUE_NAMES] == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "weights = torch.load(path)",
        "from torch import load",
        "numpy.load(path, allow_pickle=True)",
        "numpy.load(path, allow_pickle=trusted)",
        "yaml.load(text, Loader=yaml.SafeLoader)",
    ],
)
def test_unpickling_is_found(source: str):
    assert len(list(unpickling(source))) == 1


@pytest.mark.parametrize("source", ["numpy.load(path, allow_pickle=False)", "yaml.safe_load(text)", "'''No pickle.'''"])
def test_safe_reading_is_let_through(source: str):
    assert list(unpickling(source)) == []
