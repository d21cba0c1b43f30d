"""What holds for every source file of the project: nothing is unpickled, and a file's name says what is in it."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.mutants import misplaced

PROJECT = Path(__file__).parents[1]
PRUNED = {"build", "dist", "data", "runs"}
FILES = [
    path
    for path in sorted(PROJECT.rglob("*.py"))
    if not any(part.startswith(".") or part in PRUNED for part in path.relative_to(PROJECT).parts[:-1])
]

UNPICKLING_MODULES = {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}
UNPICKLING_CALLS = {
    "torch.load", "torch.serialization.load", "yaml.load", "yaml.load_all", "yaml.unsafe_load", "yaml.unsafe_load_all",
    "yaml.full_load", "yaml.full_load_all", "pandas.read_pickle",
}  # fmt: skip
USUAL_ALIASES = {"np": "numpy", "pd": "pandas"}
VAGUE_NAMES = {"utils.py", "util.py", "helpers.py", "helper.py", "common.py", "misc.py"}


def full_names(tree: ast.AST) -> dict[str, str]:
    """Return what the names that a file imports stand for: with `import torch as t`, t stands for torch."""
    names = dict(USUAL_ALIASES)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.asname: alias.name for alias in node.names if alias.asname}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return names


def unpickling(source: str) -> Iterator[str]:
    """Yield what could run code out of a file that is read."""
    tree = ast.parse(source)
    names = full_names(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.partition(".")[0] in UNPICKLING_MODULES)
        elif isinstance(node, ast.ImportFrom) and node.module:
            imported = {f"{node.module}.{alias.name}" for alias in node.names}
            yield from imported & UNPICKLING_CALLS
            if node.module.partition(".")[0] in UNPICKLING_MODULES:
                yield node.module
            else:
                yield from (name for name in imported if name.rpartition(".")[2] in UNPICKLING_MODULES)
        elif isinstance(node, ast.Attribute):
            first, dot, rest = ast.unparse(node).partition(".")
            if (call := names.get(first, first) + dot + rest) in UNPICKLING_CALLS:
                yield call
        elif isinstance(node, ast.keyword) and node.arg == "allow_pickle" and ast.unparse(node.value) != "False":
            yield ast.unparse(node)
        elif isinstance(node, ast.Call):
            yield from unpickling_call(node, names)


def unpickling_call(node: ast.Call, names: dict[str, str]) -> Iterator[str]:
    """Yield a call that would unpickle without the word: by position, by name or out of a dictionary of arguments."""
    words = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
    first, dot, rest = ast.unparse(node.func).partition(".")
    called = names.get(first, first) + dot + rest
    if called == "numpy.load" and len(node.args) > 2:  # the third is allow_pickle
        yield ast.unparse(node)
    if called in {"__import__", "importlib.import_module"} and UNPICKLING_MODULES & set(words):
        yield ast.unparse(node)
    if any(keyword.arg is None and "allow_pickle" in ast.unparse(keyword.value) for keyword in node.keywords):
        yield ast.unparse(node)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PROJECT)))
def test_nothing_is_unpickled(path: Path):
    assert list(unpickling(path.read_text("utf-8"))) == []


def test_the_whole_tree_is_looked_at():
    places = {path.relative_to(PROJECT).parts[0] for path in FILES}
    assert places >= {"dmil_core", "services", "benchmarks", "tests"}
    assert Path(__file__) in FILES


def test_a_name_says_what_is_in_the_file():
    assert [path for path in FILES if path.name in VAGUE_NAMES] == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "weights = torch.load(path)",
        "from torch import load",
        "from torch import load as read",
        "import torch as t\nt.load(path)",
        "from torch import serialization as s\ns.load(path)",
        "import torch.serialization as s\ns.load(path)",
        "from numpy import load\nload(path, allow_pickle=True)",
        "from numpy import load as read\nread(path, None, True)",
        "np.load(path, None, True)",
        "np.load(path, **{'allow_pickle': True})",
        "import joblib",
        "import joblib as j",
        "from joblib import load",
        "from pandas.io import pickle",
        "import pandas as p\np.read_pickle(path)",
        "import yaml as y\ny.load(text, y.Loader)",
        "from yaml import unsafe_load",
        "__import__('pickle')",
        "from importlib import import_module\nimport_module('dill')",
        "numpy.load(path, allow_pickle=True)",
        "numpy.load(path, allow_pickle=trusted)",
        "yaml.load(text, Loader=yaml.SafeLoader)",
    ],
)
def test_unpickling_is_found(source: str):
    assert len(list(unpickling(source))) == 1


@pytest.mark.parametrize(
    "source",
    [
        "numpy.load(path, allow_pickle=False)",
        "from numpy import load\nload(path)",
        "yaml.safe_load(text)",
        "from json import load\nload(file)",
        "'''No pickle.'''",
    ],
)
def test_safe_reading_is_let_through(source: str):
    assert list(unpickling(source)) == []


@pytest.mark.parametrize(
    "page", sorted([*PROJECT.glob("*.md"), *PROJECT.glob("docs/*.md")]), ids=lambda path: path.name
)
def test_files_that_a_page_names_exist(page: Path):
    named = re.findall(
        r"`((?:benchmarks|deploy|dmil_core|docs|models|services|tests|tune_configs)/[\w./-]+)`", page.read_text("utf-8")
    )
    made = ("deploy/secrets/",)  # by a script, for one machine alone
    places = [name for name in named if "NAME" not in name and not name.startswith(made)]
    assert [name for name in places if not (PROJECT / name).exists()] == []


OPENING = {
    "open", "read_text", "read_bytes", "write_text", "write_bytes", "unlink", "rename", "rmdir", "touch", "mkdir",
    "makedirs", "symlink_to", "hardlink_to", "mkstemp", "mkdtemp", "NamedTemporaryFile",
}  # fmt: skip
"""Calls by which files are opened, made or removed; and all of shutil's, but these:"""
PACKAGES = {"dmil_core", "services"}
HARMLESS = {"shutil.disk_usage", "shutil.which", "shutil.get_terminal_size"}
FREE = {"dmil_core/files.py", "services/local_cluster.py"}
"""The one way into a folder, and what has folders of its own."""
BY_HAND = {
    "services/cli/streams.py": {"open", "os.open"},  # the null device
    "services/distributed/node_info.py": {"(CONTROL_GROUP / name).read_text"},  # the kernel's
    "services/demonstrations/npz.py": {"archive.open"},  # a member of an archive in memory
    "services/evaluation/paper_results.py": {"(files('services.evaluation') / 'paper_results.json').read_text"},
    "services/doctor.py": {"folder.rmdir"},  # one that it made, if it is empty
    "services/experiments/champions.py": {"folder.mkdir"},  # for MLflow to download into
    "services/reporting/film.py": {"made.read_bytes"},  # out of a temporary folder of its own
    "services/storage/private.py": {"shutil.rmtree", "tempfile.mkdtemp", "folder.mkdir", "path.unlink", "os.open"},
    "services/storage/remote.py": {"self._files.makedirs", "self._files.open"},
}
"""Who else does it, and what."""


def opened_by_hand(source: str) -> set[str]:
    """Return the calls that open, make or remove a file."""
    tree = ast.parse(source)
    names, found = full_names(tree), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            first, dot, rest = called.partition(".")
            full = names.get(first, first) + dot + rest
            if full.rpartition(".")[2] in OPENING or (full.startswith("shutil.") and full not in HARMLESS):
                found.add(called)
    return found


def test_what_opens_a_file_by_hand_is_found():
    source = "import shutil as s\nfrom os import unlink as u\ns.rmtree(a)\nu(b)\nPath(c).open()\nopen(d)\ns.which(e)"
    assert opened_by_hand(source) == {"s.rmtree", "u", "Path(c).open", "open"}


def test_files_of_folders_are_opened_in_one_way():
    ours = {str(path.relative_to(PROJECT)): path for path in FILES if path.relative_to(PROJECT).parts[0] in PACKAGES}
    found = {name: opened_by_hand(path.read_text("utf-8")) for name, path in ours.items() if name not in FREE}
    assert {name: calls for name, calls in found.items() if calls} == BY_HAND, "see dmil_core/files.py"


def test_the_faults_of_make_mutants_have_their_places():
    assert misplaced() == []
