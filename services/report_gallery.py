"""Draw the tasks of every suite, each as its expert solves it: the paper's Figures 6 to 9."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dmil_core.configs import SuiteConfig
from dmil_core.errors import UserError
from services.cli.arguments import parse
from services.cli.places import announce
from services.cli.progress import console
from services.suites.registry import open_suite
from services.suites.rendering import View

SUITES = (
    "ml45", "ml10", "push-around-wall", "kitchen-topburner", "kitchen-microwave", "kitchen-kettle", "kitchen-slide",
)  # fmt: skip
"""The paper's, in the order of its Figures 6 to 9."""
COLUMNS = {"ml45": 10, "kitchen": 4}
"""Of pictures, by what a suite's name begins with."""


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``report gallery``."""

    suites: tuple[str, ...] = SUITES
    """Which suites."""
    output: Path = Path("gallery")
    """Folder for a picture of each suite, SUITE.jpg."""
    seed: int = 0
    """Of the episodes."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args = parse(Arguments, __doc__ or "", arguments, Arguments())
    from services.reporting.gallery import draw_gallery

    announce(gallery=(args.output, "--output FOLDER"))
    for name in args.suites:
        suite = open_suite(SuiteConfig(name=name))
        camera: str | View | None = getattr(suite, "camera", None)
        if camera is None:
            raise UserError(f"--suites: got {name}, which names no camera; wanted suites whose tasks can be drawn")
        path = args.output / f"{name}.jpg"
        draw_gallery(suite, camera, args.seed, path, COLUMNS.get(name.partition("-")[0], 5))
        console.print(str(path))
