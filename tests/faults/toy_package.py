"""The toy suite as an installed package."""

import shutil
from pathlib import Path


def install(folder: Path) -> Path:
    """Lay the toy suite into `folder` as pip would, and return that."""
    shutil.copy(Path(__file__).with_name("toy_suite.py"), folder / "toy_suite.py")
    information = folder / "toy_suite-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-suite\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[dmil.suites]\ntoy = toy_suite:ToySuite\n")
    return folder
