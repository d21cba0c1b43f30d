"""Methods by name: those of packages beside ours, and what is said of one that cannot be used or is there twice."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from dmil_core.errors import UserError
from dmil_core.methods.configs import config_type, method_names
from dmil_core.methods.mil.config import MilConfig
from dmil_core.methods.nearest_neighbour.config import NearestNeighbourConfig
from dmil_core.methods.registry import OURS, method_type

NEAREST = "from dmil_core.methods.nearest_neighbour.method import NearestNeighbour as Nearest"


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Installs a package: its method's name, and its module with a class Nearest."""

    def install(name: str, module: str, code: str = NEAREST) -> None:
        folder = tmp_path / module
        information = folder / f"{module}-1.0.dist-info"
        information.mkdir(parents=True)
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(f"[dmil.methods]\n{name} = {module}:Nearest\n")
        (folder / f"{module}.py").write_text(code)
        monkeypatch.syspath_prepend(folder)
        monkeypatch.delitem(sys.modules, module, raising=False)

    return install


def test_methods_of_packages_stand_behind_ours(install) -> None:
    install("nearest", "one_package")
    install("mean", "another_package")
    assert method_names() == [*OURS, "mean", "nearest"]
    assert method_type("nearest") is OURS["nearest-neighbour"]
    assert config_type("nearest") is NearestNeighbourConfig


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (
            "import nowhere",
            "which cannot be imported: ModuleNotFoundError: No module named 'nowhere' (faulty_package.py, ",
        ),
        (
            "import sys\nsys.exit()",
            "which cannot be imported: SystemExit:  (faulty_package.py, line 2); wanted what the",
        ),
        (
            "class Out(BaseException): ...\nraise Out",
            "which cannot be imported: Out:  (faulty_package.py, line 2); wanted",
        ),
        ("", "which cannot be imported: AttributeError: module 'faulty_package' has no attribute 'Nearest'; wanted"),
        ("Nearest = 3", "got 3; wanted a class derived from Method; see docs/your-own-method.md"),
        ("class Nearest: ...", "wanted a class derived from Method"),
    ],
)
def test_a_fault_of_a_package_is_reported_in_words(install, code: str, said: str) -> None:
    install("nearest", "faulty_package", code)
    with pytest.raises(UserError, match=r"method\.name: got nearest, faulty_package:Nearest") as caught:
        method_type("nearest")
    assert said in str(caught.value)


@pytest.mark.parametrize("name", ["foo", 3, ["dmil"]])
def test_what_names_no_method_is_reported_with_all_that_there_are(install, name: object) -> None:
    install("nearest", "one_package")
    with pytest.raises(UserError, match=r"method.name: got .*; wanted one of dmil, .*, nearest(;|$)"):
        method_type(name)


@pytest.mark.parametrize("asked", ["nearest", "dmil", "foo"])
def test_two_packages_of_one_name_are_distinguished(install, asked: str) -> None:
    install("nearest", "one_package")
    install("nearest", "another_package")
    with pytest.raises(
        UserError, match=r"entry points dmil\.methods: got nearest twice, .*; uninstall either"
    ) as caught:
        method_type(asked)
    for both in ("one_package:Nearest", "another_package:Nearest"):
        assert both in str(caught.value)


@pytest.mark.parametrize("asked", ["mil", "dmil", "foo"])
def test_a_package_s_method_does_not_pass_for_one_of_ours(install, asked: str) -> None:
    install("mil", "one_package")
    with pytest.raises(UserError) as caught:
        method_type(asked)
    assert str(caught.value) == (
        "entry points dmil.methods: got mil twice, a method of our own and one_package:Nearest of "
        "the package one_package; wanted another name than any of ours; rename the package's, or uninstall it"
    )
    assert config_type("mil") is MilConfig
