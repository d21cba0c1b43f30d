"""A seeded fuzz over combinations: settings x paths x data x a stroke at a random moment, with the promises as oracle.

A combination is named by its number: ``make fuzz ARGS="--first 17 --count 1"`` tries the 17th again. Each trains on the
toy twice, in worlds of their own with the same names: undisturbed, and struck; then the world is mended and the run
gone on with. What must hold is in docs/reliability.md.
"""

import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from random import Random

import numpy as np
import tyro

from dmil_core.files import WRITING
from services.reporting import run_report
from services.storage import replication
from services.tracking import tracker
from services.tracking.client import set_mlflow_defaults
from tests.faults.strokes import STROKES, MachineLost, Stroke
from tests.faults.toy_package import install
from tests.faults.worlds import World

LATE_IMPORTS = (
    "mlflow.pyfunc", "mlflow.store.tracking.sqlalchemy_store", "mlflow.store.model_registry.sqlalchemy_store",
    "services.tracking.__main__", "services.tracking.models", "torch.fx.experimental.symbolic_shapes",
)  # fmt: skip
"""What a run imports when it needs it; a fork has it already."""
NAMES = (
    "run", "a b", "it's", r"$\frac{1}{2}$", "[red]x[/y]", "-n", "--resume", "é", "e\u0301", "日本", "x" * 244,
    "x" * 250, "..", "a/b", "a\nb", "%s{0}", "#1?x=1&y", "~", "*", "`id`", "$(id)", " ", "'", '"', "\\", ".hidden",
    "a=b,c", "0", "\u202e", "None", "iteration-0000003", "a;b|c", "<b>&", "other",
)  # fmt: skip
PLACES = (
    "w",
    "with blank",
    "a=b,c",
    "#x",
    "%41",
    "é",
    "~x",
    "a'b",
    'q"q',
    "x\\y",
    "[z]",
    "$HOME",
    "a:b",
    "u?x=1",
    "-d",
)
RUNS = ("runs", "my runs", "r=1,2", "deep/er", "~runs", "x#y")
ODDITIES = ("",) * 6 + ("arrays", "arrays", "in place", "in place", "nan", "reward", "no success")
LEARNING = ("dmil", "dmil", "behaviour-cloning", "option-gail-offline", "mlsh")
METHODS = (*LEARNING, "per-task", "nearest-neighbour")
DEMOS = "my demos=1.npz"
DATA = ("",) * 8 + ("sound",) * 4 + ("short", "nan", "cut off")
MISTAKES = (
    ("--seed", "x"), ("--method", "none"), ("--suite", "none"), ("--training.iterations", "-1"), ("--no-such", "1"),
    ("--evaluation.every", "7"), ("--config", "nowhere.yaml"), ("--demos", "npz:a=nowhere.npz"),
    ("--evaluation.shots", "99"),
)  # fmt: skip


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``combinations``."""

    first: int = 0
    """Number of the first combination."""
    count: int | None = None
    """How many; none for as many as there is time for."""
    seconds: float = 3600.0
    """After which no other is begun."""
    stroke: str | None = None
    """Only combinations with this one."""


class Combination:
    """What a number stands for."""

    def __init__(self, number: int) -> None:
        """Draw it."""
        self.draw = draw = Random(f"combination {number}")
        self.stroke_name = draw.choices(list(STROKES), [weight for _, weight in STROKES.values()])[0]
        self.stroke: Stroke = STROKES[self.stroke_name][0]()
        self.moment = draw.uniform(0, 1.05)
        self.name = draw.choice(NAMES) if draw.random() < 0.6 else "run"
        self.place, self.runs = draw.choice(PLACES), draw.choice(RUNS)
        self.oddity, self.demos = draw.choice(ODDITIES), draw.choice(DATA)
        self.has_storage = "storage" in self.stroke_name or isinstance(self.stroke, MachineLost) or draw.random() < 0.3
        self.settings = drawn_settings(draw)

    def __str__(self) -> str:
        """Return what it is, in a line."""
        method = self.settings[1]
        data = f"demos {self.demos}" if self.demos else self.oddity or "toy"
        where = f"{self.runs!r}/{self.name[:20]!r} in {self.place!r}"
        return f"{method}, {data}, {where}, {self.stroke_name} at {self.moment:.2f}"

    def world(self, root: Path, template: Path) -> World:
        """Make a world for it."""
        world = World(root, self.place, self.runs, self.name, template)
        world.variables |= {"TOY_ODDITY": self.oddity, "MLFLOW_TRACKING_URI": "", "DMIL_DATA": ""}
        world.variables["DMIL_STORAGE"] = f"file://{world.storage}" if self.has_storage else ""
        if self.demos:
            write_demos(world.place / DEMOS, self.demos)
        return world

    def has_claimed(self, world: World) -> bool:
        """Whether the storage has noted whose the name is, and nothing else yet: another run needs another name."""
        return (world.storage / "runs" / world.run.name / "claim").exists()

    def arguments(self) -> list[str]:
        """Return the arguments of a new run."""
        demos = [f"--demos=npz:{task}={DEMOS}" for task in ("a", "b", "d")] if self.demos else []
        where = [
            "--suite",
            "toy",
            "--preset",
            "smoke",
            "--runner",
            "local",
            f"--runs={self.runs}",
            f"--name={self.name}",
        ]
        return [*where, *self.settings, *demos]


def drawn_settings(draw: Random) -> list[str]:
    """Return flags for a run of a second or so, now and then with a mistake among them."""
    method, every = draw.choice(METHODS), draw.randint(1, 3)
    iterations = draw.randint(0, 8) if method in LEARNING else 0
    settings: dict[str, object] = {
        "method": method, "training.iterations": iterations, "training.checkpoint-every": every,
        "training.checkpoints-kept": draw.randint(1, 3), "training.tasks-per-iteration": draw.randint(1, 4),
        "training.slots-per-group": draw.randint(1, 2), "seed": draw.choice([0, 7, 2**63 - 1]),
        "training.schedule": draw.choice(["constant", "cosine"]), "evaluation.episodes": 1, "evaluation.shots": 1,
        "evaluation.fine-tuning-steps": draw.randint(0, 2), "demonstrations.trailing-steps": draw.choice([0, 3]),
        "evaluation.optimiser": draw.choice(["sgd", "adam"]),
    }  # fmt: skip
    flags = [text for name, value in settings.items() for text in (f"--{name}", str(value))]
    if draw.random() < 0.3:
        flags += ["--evaluation.every", str(every * draw.randint(1, 2))]
    if draw.random() < 0.2:
        flags += ["--evaluation.controls", "no-adaptation"]
    if draw.random() < 0.3:
        flags.append("--quiet")
    return flags + list(draw.choice(MISTAKES) if draw.random() < 0.07 else ())


def write_demos(path: Path, kind: str) -> None:
    """Write a data set of the toy's sizes, sound or with one oddity."""
    rng = np.random.default_rng(0)
    lengths = np.full(14, 12)
    observations, actions = rng.normal(size=(14 * 12, 4)).astype("f4"), rng.uniform(-1, 1, (14 * 12, 2)).astype("f4")
    if kind == "nan":
        observations[30, 1] = np.nan
    if kind == "short":
        lengths[0], lengths[1] = 1, 23
    np.savez(path, observations=observations, actions=actions, episode_lengths=lengths)
    if kind == "cut off":
        path.write_bytes(path.read_bytes()[:-40])


class BrokenPromiseError(Exception):
    """What does not hold."""


def demand(holds: bool, what: str) -> None:
    """Raise BrokenPromiseError if something does not hold."""
    if not holds:
        raise BrokenPromiseError(what)


def attempt(number: int, root: Path, template: Path) -> str:
    """Try a combination in the folder `root`, and return what came of it.

    Raises:
        BrokenPromiseError: names the promise.
    """
    combination = Combination(number)
    try:
        plain = combination.world(root / "plain", template)
        struck = combination.world(root / "struck", template)
    except OSError:
        return "no such names"  # what no folder can be called
    began = time.monotonic()
    before = plain.bystanders()
    code = plain.start("meta_train", *combination.arguments()).wait()
    seconds = time.monotonic() - began
    demand(code in (0, 1, 2), f"undisturbed: exit code {code}")
    check_beside(plain, before)
    if code:
        return f"ends with {code}: {plain.printed().splitlines()[-1][-200:]}"
    check_delivered(plain, plain.losses())
    code, reached = strike(combination, struck, seconds)
    if code or not struck.is_begun:  # the machine may be lost just after the run's end
        resumes = struck.is_begun or (struck.storage / "runs" / struck.run.name / "config.json").exists()
        if isinstance(combination.stroke, MachineLost) and not resumes and combination.has_claimed(struck):
            return "lost with its name"
        again = [f"--resume={struck.run}", "--runner", "local"] if resumes else combination.arguments()
        resumed = struck.start("meta_train", *again).wait()
        demand(resumed == 0, f"exit code {code}, then {resumed} with {again[0]}")
    demand(struck.bits() == plain.bits(), "other bits than undisturbed")
    demand(struck.start("tracking.__main__", "flush", str(struck.run)).wait() == 0, "tracking flush fails")
    check_delivered(struck, plain.losses())
    return f"exit {code}" + (f", on from {reached}" if code else "") + ", same bits"


def strike(combination: Combination, world: World, seconds: float) -> tuple[int, int]:
    """Strike a run of that world after a part of those seconds, and mend the world.

    Returns:
        The run's exit code, and the iteration of the checkpoint that it left.
    """
    stroke, draw = combination.stroke, combination.draw
    out = stroke.prepare(world, draw)
    before = world.bystanders()
    program = world.start("meta_train", *combination.arguments(), out=out)
    try:
        program.wait(combination.moment * seconds)
        newest = world.newest() if stroke.keeps_checkpoints else -1
        stroke.strike(world, program, draw)
        code = program.wait()
    finally:
        program.send(signal.SIGKILL)
        stroke.mend(world)
    demand(code in stroke.codes, f"exit code {code}")
    demand(not (world.root / "away").exists(), "another folder was made in the place of the moved one")
    check_beside(world, before, is_sudden=stroke.is_sudden)
    reached = world.newest()
    demand(reached >= newest, f"a checkpoint of iteration {newest} was there, now {reached}")
    if stroke.keeps_all and world.is_begun:
        demand(reached >= world.recorded(), f"iteration {world.recorded()} was finished, the checkpoint has {reached}")
    return code or 0, reached


def check_beside(world: World, before: dict[str, str], *, is_sudden: bool = False) -> None:
    """See that nothing else has changed, and that no program told a traceback."""
    after = world.bystanders()
    changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    if is_sudden:
        changed = [name for name in changed if not name.startswith("tmp") and WRITING not in name]
    demand(not changed, f"changed: {', '.join(changed)}")
    demand("Traceback" not in world.printed(), "a traceback")


def check_delivered(world: World, losses: int) -> None:
    """See that MLflow has the run as finished, with the losses of all iterations."""
    status, delivered = world.delivered()
    demand(status == "FINISHED", f"MLflow says {status}")
    demand(delivered == losses, f"MLflow has {delivered} iterations of {losses}")


def prepare(folder: Path) -> Path:
    """Import what runs need, make what they share, and return an MLflow database with its tables."""
    sys.path.insert(0, str(install(folder)))
    set_mlflow_defaults()
    for module in LATE_IMPORTS:
        import_module(module)
    run_report.write_run_page = lambda run, path: path.write_text("")  # its pictures take longer than the run
    replication.SECONDS = tracker.LINGER_SECONDS = 0.1
    database = folder / "mlflow.db"
    if not (child := os.fork()):
        from mlflow import MlflowClient

        MlflowClient(f"sqlite:///{database}").search_experiments()
        os._exit(0)
    os.waitpid(child, 0)
    return database


def main(arguments: Arguments) -> int:
    """Try combinations; return 1 if a promise was broken."""
    folder = Path(tempfile.mkdtemp(prefix="dmil-fuzz-"))
    (folder / "toy").mkdir()
    template = prepare(folder / "toy")
    began, number, kept = time.monotonic(), arguments.first, False
    outcomes: dict[str, Counter[str]] = defaultdict(Counter)
    while time.monotonic() < began + arguments.seconds and number - arguments.first != arguments.count:
        combination, root, started = Combination(number), folder / str(number), time.monotonic()
        number += 1
        if arguments.stroke not in (None, combination.stroke_name):
            continue
        print(f"{number - 1:5} {combination}: ", end="", flush=True)
        try:
            outcome = attempt(number - 1, root, template)
            shutil.rmtree(root)
        except BrokenPromiseError as error:
            outcome = f"BROKEN: {error}; see {root}"
            kept = True
        print(f"{outcome} ({time.monotonic() - started:.1f} s)", flush=True)
        outcomes[combination.stroke_name][
            "broken" if "BROKEN" in outcome else "refused" if "ends" in outcome else "held"
        ] += 1
    print(f"\n{'struck by':28}{'held':>8}{'refused':>9}{'broken':>8}")
    for name in (*outcomes, "all"):
        counts = sum(outcomes.values(), Counter()) if name == "all" else outcomes[name]
        print(f"{name:28}{counts['held']:8}{counts['refused']:9}{counts['broken']:8}")
    if not kept:
        shutil.rmtree(folder)
    return int(kept)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, description=__doc__)))
