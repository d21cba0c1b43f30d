"""Mutation testing by hand: 40 faults put into a copy of the tree, one by one, and whether `make test` notices each.

`make mutants` prints the table of CONTRIBUTING.md. Each fault is tried on the tests that mirror its file, as far as
`make test` runs them; it is caught if one fails. A text no longer in its file is an error: write the fault anew.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

PROJECT = Path(__file__).parents[1]
COPIES = 2
"""Mutations that are tried at a time."""
SECONDS = 900
"""For the tests of one mutation; one that makes them hang is caught too."""


FAULTS: dict[tuple[str, ...], dict[str, str]] = {
    ("dmil_core/losses.py", "dmil_core/test_losses.py"): {
        "errors.argmin(0)": "errors.argmax(0)",
    },
    ("dmil_core/methods/dmil/losses.py", "dmil_core/methods/dmil/test_losses.py"): {
        "(-2 * deviation**2)": "(-(deviation**2))",
        "mass * (weighted - probabilities * weighted.sum(-1, keepdim=True))": "mass * (weighted)",
        "within = trajectory[1:] == trajectory[:-1]": "within = trajectory[1:] >= 0",
    },
    ("dmil_core/loss_gradients.py", "dmil_core/test_loss_gradients.py"): {
        "self.add_to(stepped, -learning_rate)": "self.add_to(stepped, -1.0)",
        "add_product(weight, deltas[index].mT, tangent[index - 1], -learning_rate)": "pass",
    },
    ("dmil_core/methods/dmil/meta_gradient.py", "dmil_core/methods/dmil/test_meta_gradient.py"): {
        "in reversed(path)": "in path",
        "choose(high, query_low.states)": "choose(path[0].adapted.high, query_low.states)",
    },
    ("dmil_core/methods/dmil/adaptation.py", "dmil_core/methods/dmil/test_adaptation.py"): {
        "in_place=not keep and gradient.network is not origin": "in_place=not keep",
    },
    ("dmil_core/networks.py", "dmil_core/methods/dmil/test_adaptation.py"): {
        "[torch.cat(indices).argsort()]": "[torch.cat(indices)]",
    },
    ("dmil_core/outer_loop.py", "dmil_core/test_outer_loop.py"): {
        "draw.permutation(len(tasks))": "draw.integers(len(tasks), size=len(tasks))",
        "there(float(state.iteration))": "there(0.0)",
        "        size *= 2": "        size += 1",
    },
    ("dmil_core/seeding.py", "dmil_core/test_seeding.py"): {
        "repr(part if isinstance(part, str) else int(part))": "str(part)",
        "[seed, *np": "[0, *np",
    },
    ("dmil_core/statistics.py", "dmil_core/test_statistics.py"): {
        "z**2) / whole": "0) / whole",
        "rng.integers(seeds, size=BOOTSTRAP_DRAWS)": "[place] * BOOTSTRAP_DRAWS",
    },
    ("dmil_core/methods/ppo.py", "dmil_core/methods/test_ppo.py"): {
        "ratio.clamp(1 - clip, 1 + clip)": "ratio",
    },
    ("dmil_core/methods/pemirl/losses.py", "dmil_core/methods/pemirl/test_losses.py"): {
        "functional.softplus(pseudo)": "functional.softplus(-pseudo)",
    },
    ("dmil_core/methods/mil/losses.py", "dmil_core/methods/mil/test_losses.py"): {
        "gradient.detach().abs() > limit": "gradient.detach() > limit",
    },
    ("dmil_core/configs.py", "dmil_core/test_configs.py"): {
        "if self.held_out >= self.per_task": "if self.held_out > self.per_task",
    },
    ("services/distributed/actor_pool.py", "services/distributed/test_actor_pool.py"): {
        "suspect = worker.in_flight[0]": "suspect = worker.in_flight[-1]",
        "if suspect.deaths >= MAX_DEATHS": "if suspect.deaths > MAX_DEATHS",
    },
    ("dmil_core/checkpoint.py", "services/storage/test_checkpoints.py"): {
        'exclude={"loss", "mlflow_run_id", ': 'exclude={"loss", ',
        "for path in reversed(checkpoints_in(folder))": "for path in checkpoints_in(folder)",
    },
    ("services/storage/checkpoints.py", "services/storage/test_checkpoints.py"): {
        " and path != best": "",
    },
    ("services/storage/remote.py", "services/storage/test_remote.py"): {
        "key=lambda file: file == marker": "key=lambda file: file != marker",
        "if size > most:": "if size > 2 * most:",
    },
    ("services/tracking/spool.py", "services/tracking/test_spool.py"): {
        "        self._file.truncate(self._size)\n\n": "\n",
    },
    ("services/tracking/delivery.py", "services/tracking/test_delivery.py", "services/tracking/test_tracker.py"): {
        "self._note(delivered=batch[-1].number)": "self._note(delivered=batch[0].number)",
    },
    ("services/rollouts/episodes.py", "services/rollouts"): {
        'config.labels == "noisy"': 'config.labels != "noisy"',
        "end = min(horizon, recorder.solved_at": "end = max(horizon, recorder.solved_at",
    },
    ("services/rollouts/adaptations.py", "services/rollouts"): {
        "range(draw, evaluation.episodes, draws(task, shots))": "range(draw, evaluation.episodes)",
    },
    ("services/demonstrations/npz.py", "services/demonstrations/test_npz.py"): {
        "(lengths < 1).any()": "(lengths < 0).any()",
        "directory > MOST_DIRECTORY": "directory > 10**9",
    },
    ("services/demonstrations/external.py", "services/demonstrations/test_external.py"): {
        "np.flatnonzero(ends) + 1": "np.flatnonzero(ends)",
    },
    ("services/evaluation/summary.py", "services/evaluation/test_summary.py"): {
        "steps.sum(1, keepdims=True) > 0.1": "steps.sum(1, keepdims=True) > 0.5",
    },
    ("services/evaluation/comparison.py", "services/sweeps/test_tables.py"): {
        '"yes, higher" if low > 0': '"yes, higher" if high > 0',
    },
    ("services/cli/composition.py", "services/cli/test_arguments.py"): {
        "suite or named or DEFAULT_SUITE": "named or DEFAULT_SUITE",
    },
    ("services/cli/arguments.py", "services/cli/test_arguments.py"): {
        "2 if isinstance(error, UserError) or": "2 if",
    },
}
"""Of each file, before the tests that mirror it: a text that occurs once in it, and what to put in its place."""


class Mutation(NamedTuple):
    """A fault in a file, and what should notice it."""

    path: str
    old: str
    new: str
    tests: Sequence[str]


MUTATIONS = [
    Mutation(path, old, new, [f"tests/{test}" for test in tests])
    for (path, *tests), faults in FAULTS.items()
    for old, new in faults.items()
]


def environment(tree: Path) -> dict[str, str]:
    """Return the environment in which the copy, and not the installed tree, is what is imported."""
    return os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}


def copy_of_the_tree(folder: Path) -> Path:
    """Copy what git knows of, changed or not."""
    known = subprocess.run(["git", "ls-files", "-z"], cwd=PROJECT, check=True, capture_output=True, text=True).stdout
    for name in filter(None, known.split("\0")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(PROJECT / name, folder / name, follow_symlinks=False)
    return folder


def shown(code: str) -> str:
    """Return code on one line, as a cell of a Markdown table holds it."""
    return " ".join(code.split()).replace("|", r"\|") or "nothing"


def misplaced() -> list[str]:
    """Name the texts that do not occur exactly once in their file."""
    counts = {(path, old): (PROJECT / path).read_text().count(old) for path, old, _, _ in MUTATIONS}
    return [f"{path}: got {count} times, wanted once: {old}" for (path, old), count in counts.items() if count != 1]


def caught_by(mutation: Mutation, tree: Path) -> str | None:
    """Put a fault into a copy of the tree, run its tests, take it out; return the first test that failed."""
    file = tree / mutation.path
    sound = file.read_text()
    file.write_text(sound.replace(mutation.old, mutation.new))
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not thorough"]
    try:
        ran = subprocess.run(
            [*command, *mutation.tests],
            cwd=tree, env=environment(tree), capture_output=True, text=True, timeout=SECONDS,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "the time limit"
    finally:
        file.write_text(sound)
    failed = re.findall(r"^(?:FAILED|ERROR) \S*?(\w+)(?=\[| |$)", ran.stdout, re.MULTILINE)
    assert failed or ran.returncode == 0, ran.stdout[-2000:] + ran.stderr[-2000:]
    return failed[0] if failed else None


def main(copies: int = COPIES) -> None:
    """Try all mutations, print their table, and fail if one survives."""
    if wrong := misplaced():
        sys.exit("\n".join(wrong))
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(copies) as executor:
        trees: SimpleQueue[Path] = SimpleQueue()
        for number in range(copies):
            trees.put(copy_of_the_tree(Path(folder) / str(number)))

        def attempt(mutation: Mutation) -> str | None:
            tree = trees.get()
            try:
                return caught_by(mutation, tree)
            finally:
                trees.put(tree)

        print("| file | fault | caught by |\n|---|---|---|")
        outcomes = []
        for mutation, test in zip(MUTATIONS, executor.map(attempt, MUTATIONS), strict=True):
            fault = f"`{shown(mutation.old)}` → `{shown(mutation.new)}`"
            print(f"| `{mutation.path}` | {fault} | {f'`{test}`' if test else '**nothing**'} |", flush=True)
            outcomes.append(test)
    survivors = outcomes.count(None)
    print(f"\n{len(outcomes) - survivors} of {len(outcomes)} caught")
    sys.exit(bool(survivors))


if __name__ == "__main__":
    main()
