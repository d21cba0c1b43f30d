"""Digests of what smoke runs come to, to tell whether a change of the code changes what it computes.

`python -m tests.services.experiments.same_bits FOLDER` trains every run of `RUNS` in a folder and prints their digests,
to be put into ``same_bits.json`` beside, under the kind of processor that they hold for.
"""

import hashlib
import json
import re
import sys
from pathlib import Path

import torch

from services import meta_train

METHODS = (
    "dmil", "option-gail", "option-gail-offline", "mil", "mlsh", "pemirl", "behaviour-cloning", "per-task",
    "nearest-neighbour",
)  # fmt: skip
RUNS: dict[str, tuple[tuple[str, ...], ...]] = {
    **{f"{method}-0": (("--method", method, "--preset", "ml10-smoke"),) for method in METHODS},
    "dmil-1": (("--preset", "ml10-smoke", "--seed", "1"),),
    "kitchen-0": (("--preset", "kitchen-smoke"),),
    "resumed": (
        ("--preset", "ml10-smoke", "--training.iterations", "7"),
        ("--resume", "resumed", "--training.iterations", "20"),
    ),
}
"""The commands of each run, one after the other."""
NEWER = ("diverged", "sub_skill_switches")
"""Fields of rows that came after the digests were written down."""


def processor() -> str:
    """Return what bits depend on besides the code: the kind of processor, and the instructions torch takes."""
    facts = dict(re.findall(r"^(vendor_id|cpu family|model)\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.M))
    return " ".join([*facts.values(), torch.backends.cpu.get_cpu_capability()])


def train(name: str, runs: Path) -> dict[str, str]:
    """Do a run in this process, and return the digests of its last parameters and of its rows."""
    for command in RUNS[name]:
        begin = () if "--resume" in command else ("--name", name)
        meta_train.run([*command, *begin, "--runner", "local", "--quiet", "--runs", str(runs)])
    return digests(runs / name)


def digests(folder: Path) -> dict[str, str]:
    """Return the digests of a run's last parameters, and of its rows without what names the code and its versions."""
    last = max((folder / "checkpoints").iterdir())
    found = {"parameters": hashlib.sha256((last / "parameters.safetensors").read_bytes()).hexdigest()}
    for name in ("episodes", "adaptations"):
        rows = [json.loads(line) for line in (folder / f"{name}.jsonl").read_text().splitlines()]
        left_out = ("versions", "checkpoint", *NEWER)
        kept = [{key: value for key, value in row.items() if key not in left_out} for row in rows]
        found[name] = hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()
    return found


if __name__ == "__main__":
    print(json.dumps({processor(): {name: train(name, Path(sys.argv[1])) for name in RUNS}}, indent=1))
