"""The floors of the project: a file imports from its own floor and from those below, never from one above."""

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[1]

# The longest name that a module's own begins with gives its floor. A package stands on the floor of its lowest module,
# because its __init__ runs before any of them.
FLOORS = {
    "dmil_core.demonstrations": 0,
    "dmil_core.settings": 0,
    "dmil_core.dmil_config": 0,
    "dmil_core.errors": 0,
    "dmil_core.statistics": 0,
    "dmil_core.seeding": 0,
    "dmil_core.networks": 1,
    "dmil_core.slopes": 1,
    "dmil_core.losses": 1,
    "dmil_core.adaptation": 1,
    "dmil_core.meta_gradient": 1,
    "dmil_core.methods": 2,
    "dmil_core.configs": 2,
    "dmil_core.outer_loop": 2,
    "services.suites": 3,
    "services.cli.yaml_files": 3,
    "services.demonstrations.store": 3,
    "services.storage.checksums": 3,
    "services.storage.files": 3,
    "services.distributed.failures": 3,
    "services.demonstrations.npz": 3,
    "services.storage.checkpoints": 3,
    "services.tracking": 3,
    "services.tracking.__main__": 7,
    "services.cli.colours": 3,
    "services.cli.progress": 3,
    "services.storage.remote": 3,
    "services.storage.replication": 3,
    "services.storage.provenance": 3,
    "services.evaluation.paper_results": 3,
    "services.demonstrations.external": 3,
    "services.evaluation.results": 3,
    "services.cli.live_view": 3,
    "services.distributed.timing": 3,
    "services.rollouts.trials": 4,
    "services.rollouts.verification": 4,
    "services.actors": 5,
    "services.distributed.runner": 6,
    "services.distributed.cluster": 5,
    "services.distributed.node_info": 5,
    "services.distributed.metrics": 5,
    "services.distributed.ray_runner": 6,
    "services.distributed.ray_meta_training": 6,
    "services.demonstrations.collection": 6,
    "services.evaluation.evaluator": 6,
    "services.experiments.experiment": 6,
    "services.experiments.iteration_metrics": 6,
    "services.evaluation.summary": 6,
    "services": 7,
    "benchmarks": 8,
}
PACKAGES = {"dmil_core": 0, "services": 3, "benchmarks": 8}

SIMULATORS = {"gymnasium", "gymnasium_robotics", "metaworld", "minari", "mujoco"}
RAY_FLOOR = 5
PROGRAMS_FLOOR = 7


def floor_of(module: str) -> int | None:
    """Return the floor of a module of ours; None if it has none."""
    if module in PACKAGES:
        return PACKAGES[module]
    parts = module.split(".")
    names = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next((FLOORS[name] for name in names if name in FLOORS), None)


def module_name(path: Path, root: Path) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(source: str, module: str, *, is_package: bool) -> Iterator[tuple[int, str]]:
    """Yield line and dotted name of everything imported, anywhere in the file.

    Of `from a import b` it yields a.b, which is the module b or a name in the module a: its floor is found alike.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = module.split(".") if is_package else module.split(".")[:-1]
                kept = parents[: len(parents) - node.level + 1]
                base = ".".join([*kept, *filter(None, [node.module])])
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)


def complaints(sources: Mapping[str, str], packages: frozenset[str] = frozenset()) -> list[str]:
    """Return what breaks the rules in these sources, which are given by module; `packages` are the __init__ files."""
    found = []
    for module, source in sources.items():
        floor = floor_of(module)
        if floor is None:
            found.append(f"{module}: stands on no floor; give it one in FLOORS and in docs/architecture.md")
            continue
        for line, name in imports(source, module, is_package=module in packages):
            top = name.partition(".")[0]
            where = f"{module}:{line} (floor {floor}) imports {name}"
            if top in PACKAGES:
                above = floor_of(name)
                if above is not None and above > floor:
                    found.append(f"{where}, which is above it on floor {above}")
            elif top in {"ray", "mlflow"} | SIMULATORS and module.partition(".")[0] == "dmil_core":
                found.append(f"{where}; dmil_core does without")
            elif top == "ray" and floor < RAY_FLOOR:
                found.append(f"{where}; only floors {RAY_FLOOR} and above know of it")
            elif top == "mlflow" and floor < PROGRAMS_FLOOR and module.split(".")[:2] != ["services", "tracking"]:
                found.append(f"{where}; only services.tracking and programs know of it")
    return found


def test_no_import_climbs_the_floors():
    files = [path for package in PACKAGES for path in sorted((PROJECT / package).rglob("*.py"))]
    sources = {module_name(path, PROJECT): path.read_text("utf-8") for path in files}
    packages = frozenset(module_name(path, PROJECT) for path in files if path.name == "__init__.py")
    assert packages >= set(PACKAGES)
    assert complaints(sources, packages) == []


def test_the_longest_name_gives_the_floor():
    assert floor_of("services.suites.metaworld") == 3
    assert floor_of("services.meta_train") == PROGRAMS_FLOOR
    assert floor_of("dmil_core.methods.base") == 2


@pytest.mark.parametrize(
    ("module", "source", "word"),
    [
        ("dmil_core.losses", "from dmil_core.methods.base import Policy", "floor 2"),
        ("dmil_core.losses", "from dmil_core import methods", "floor 2"),
        ("dmil_core.losses", "import dmil_core.methods.base", "floor 2"),
        ("dmil_core.losses", "from .methods import base", "floor 2"),
        ("dmil_core.methods.base", "from .. import outer_loop; from ...services import rollouts", "floor 4"),
        ("dmil_core.losses", "def late():\n    from services.rollouts.trials import roll_out", "floor 4"),
        ("services.rollouts.trials", "from services.distributed.actor_pool import Pool", "floor 5"),
        ("services.distributed.actor_pool", "from services import runners", "floor 6"),
        ("services.distributed.runner", "import services.meta_train", "floor 7"),
        ("services.meta_train", "import benchmarks", "floor 8"),
        ("dmil_core", "from dmil_core.networks import mlp", "floor 1"),
        ("dmil_core.methods.dmil", "import ray", "dmil_core does without"),
        ("dmil_core.statistics", "from mlflow import log_metric", "dmil_core does without"),
        ("dmil_core.demonstrations", "import minari.dataset", "dmil_core does without"),
        ("services.rollouts.trials", "import ray", "only floors 5"),
        ("services.distributed.learner", "import mlflow", "only services.tracking"),
        ("services.tracking.delivery", "import services.meta_train", "floor 7"),
        ("dmil_core.helpful", "", "no floor"),
    ],
)
def test_a_fault_is_found(module: str, source: str, word: str):
    (found,) = complaints({module: source})
    assert found.startswith(module)
    assert word in found


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("dmil_core.methods.dmil", "from dmil_core.methods.base import Policy"),
        ("dmil_core.methods", "from .base import Policy"),
        ("services.distributed.actor_pool", "import ray"),
        ("services.tracking", "import mlflow"),
        ("services.tracking.delivery", "import mlflow"),
        ("services.tracking.__main__", "from services.cli.arguments import parse"),
        ("services.report", "import mlflow, ray, matplotlib"),
        ("services.suites.kitchen", "from dmil_core import __doc__"),
        ("services.suites.kitchen", "import gymnasium"),
        ("benchmarks.physics", "from services.evaluate import main"),
    ],
)
def test_a_sound_import_is_let_through(module: str, source: str):
    assert complaints({module: source}, frozenset({"dmil_core.methods"})) == []
