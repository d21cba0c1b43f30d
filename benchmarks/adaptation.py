"""Few-shot adaptation and acting on one core: ours against the masked reference, at paper size.

One demonstration of 100 steps, K = 3, width 512. An action reads the weights of the high level and of one sub-skill,
which do not fit a core's own cache: the time that reading as many bytes takes, and nothing else, is its floor. MIL's
action reads the decoder's weights and the encoder's view of the demonstration; it has no reference here.

What somebody does in Python is timed too, with the model ml10 that comes with the project (K = 3, width 256): the
import of `dmil_core` in a process of its own, `load`, an action, and adaptation by 50 steps to one demonstration. These
are the least times of the rounds: promises of a machine that does nothing else.
"""

import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.harness import BenchmarkArguments, Ratio, Row, alternate, lay_out, main
from benchmarks.masked_reference import MaskedReference
from benchmarks.workload import ACTION_DIM, OBS_DIM, as_in_a_run, draw_parameters, draw_steps, settings
from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.methods.base import FineTuning
from dmil_core.methods.dmil.adaptation import Hierarchy, adapt
from dmil_core.methods.dmil.policy import DmilPolicy
from dmil_core.methods.mil.config import MilConfig
from dmil_core.methods.mil.method import Mil
from dmil_core.model import SHIPPED, load
from dmil_core.seeding import named_rng
from services.cli.progress import console

CALLS = 200
"""Actions are timed by the hundred: one alone is too short."""


@dataclass(frozen=True)
class Arguments(BenchmarkArguments):
    """Arguments of ``benchmarks.adaptation``."""

    sub_skills: int = 3
    """K."""
    shots: int = 1
    """Demonstrations of 100 steps to adapt to."""
    fine_tuning_steps: int = 50
    """Steps of adaptation."""
    rounds: int = 9
    """How often each is timed; the table shows medians."""


class Comparison(NamedTuple):
    """What is timed, how often in one call, and the most seconds that ours may take once."""

    name: str
    rivals: dict[str, Callable[[], object]]
    times: int
    target: float


def run(args: Arguments) -> Sequence[Row]:
    """Run the benchmark."""
    torch.set_num_threads(1)
    rows = [_measure(comparison, args.rounds) for comparison in (*_dmil(args), _mil(args))]
    rows += [_measure(comparison, args.rounds, min) for comparison in _in_python(args)]
    console.print(lay_out("adaptation and acting on one core", [_cells(row) for row in rows]))
    return rows


def _in_python(args: Arguments) -> list[Comparison]:
    model, importing = load(SHIPPED / "ml10"), [sys.executable, "-c", "import dmil_core; dmil_core.load"]
    rng, observed = named_rng(0, "benchmark demonstration"), model.checkpoint.manifest.observed
    assert observed is not None
    states = rng.uniform(observed.low, observed.high, (100, len(observed)))  # as meta-training has seen them
    demonstrations = [(states, draw_steps(0, 1, 100).actions.numpy().clip(-1, 1))]
    policy = model.adapt(demonstrations, steps=0)

    def adapting() -> object:
        return model.adapt(demonstrations, steps=args.fine_tuning_steps)

    return [
        Comparison("import dmil_core", {"ours": lambda: subprocess.run(importing, check=True)}, 1, 1.5),
        Comparison("load ml10", {"ours": lambda: load(SHIPPED / "ml10")}, 1, 0.2),
        Comparison("ml10: policy(observation)", {"ours": lambda: policy(states[0])}, CALLS, 150e-6),
        Comparison(f"ml10: adapt, 1 shot, {args.fine_tuning_steps} steps", {"ours": adapting}, 1, 0.5),
    ]


def _mil(args: Arguments) -> Comparison:
    config = MilConfig()
    method = Mil(config, ACTION_DIM, Normalisation.identity(OBS_DIM))
    parameters = method.initial_parameters(named_rng(0, "benchmark parameters"))
    support = [
        Demonstration(str(number), "drawn", steps.states.numpy(), steps.actions.numpy())
        for number, steps in enumerate(draw_steps(seed, 1, 100) for seed in range(args.shots))
    ]
    policy = method.adapt(parameters, support, FineTuning(config.inner_steps, config.inner_learning_rate))
    used = [
        tensor.numel()
        for name, tensor in parameters.items()
        if name.startswith(("decoder.", "output.")) and not name.endswith(("key.weight", "value.weight"))
    ]
    numbers = torch.randn(sum(used) + sum(view.numel() for layer in policy.cache for view in layer))
    observations, memory = draw_steps(1, 1, 1).states.numpy(), policy.start(1)
    rivals = {"ours": lambda: policy.act(observations, memory), "floor": lambda: numbers.sum()}
    return Comparison("MIL: act in 1 state", rivals, CALLS, 3e-3)


def _dmil(args: Arguments) -> list[Comparison]:
    config = settings("paper", args.sub_skills, "second")
    parameters, support = draw_parameters(config), draw_steps(0, args.shots, 100)
    steps, rate = args.fine_tuning_steps, 1e-3
    config = config.model_copy(update={"inner_learning_rate": rate})
    masked, hierarchy = MaskedReference(config), Hierarchy.of(as_in_a_run(parameters))

    def ours() -> Hierarchy:
        return adapt(hierarchy, support, support, config, steps=steps)

    def of_masked() -> dict[str, Tensor]:
        return {name: tensor.detach() for name, tensor in masked.adapt(parameters, support, steps, rate).items()}

    policy, adapted = DmilPolicy(ours(), Normalisation.identity(OBS_DIM)), of_masked()
    difference = max((policy.hierarchy.parameters[name] - adapted[name]).abs().max().item() for name in adapted)
    assert difference < 1e-3, f"ours and the reference differ by {difference}"
    weights = torch.randn(sum(layer.weight.numel() for layer in (*hierarchy.high, *hierarchy.low[0])))

    def acting(states: int, target: float) -> Comparison:
        observations, memory = draw_steps(1, 1, states).states, policy.start(states)
        rivals = {
            "ours": lambda: policy.act(observations.numpy(), memory),
            "twin": lambda: masked.act(adapted, observations),
            "floor": lambda: weights.sum(),
        }
        return Comparison(f"act in {states} state{'s' * (states > 1)}", rivals, CALLS, target)

    adapting = Comparison(f"adapt, {args.shots} shot, {steps} steps", {"ours": ours, "twin": of_masked}, 1, 1.5)
    return [adapting, acting(1, 150e-6), acting(20, 500e-6)]


def _measure(
    comparison: Comparison, rounds: int, middle: Callable[[Sequence[float]], float] = median
) -> dict[str, Any]:
    """Return the row of one comparison; seconds are those of one adaptation or one action, the `middle` of rounds."""

    def repeated(function: Callable[[], object]) -> Callable[[], object]:
        return lambda: [function() for _ in range(comparison.times)]

    timed = alternate({name: repeated(function) for name, function in comparison.rivals.items()}, rounds)
    seconds = {name: middle(spent) / comparison.times for name, spent in timed.items()}
    ratio = Ratio.of(timed["twin"], timed["ours"]) if "twin" in timed else None
    return {
        "what": comparison.name,
        "seconds": seconds["ours"],
        "twin_seconds": seconds.get("twin"),
        "least_seconds": min(timed["ours"]) / comparison.times,
        "most_seconds": max(timed["ours"]) / comparison.times,
        "ratio": ratio and ratio.median,
        "ratio_spread": ratio and [ratio.least, ratio.most],
        "floor_seconds": seconds.get("floor"),
        "target_seconds": comparison.target,
        "rounds": rounds,
    }


def _cells(row: Row) -> dict[str, str]:
    verdict = "met" if row["seconds"] <= row["target_seconds"] else "missed"
    return {
        "what": row["what"],
        "ours": _describe(row["seconds"]),
        "at most": f"{_describe(row['target_seconds'])} ({verdict})",
        "twin": _describe(row["twin_seconds"]),
        "faster": str(Ratio(row["ratio"], *row["ratio_spread"])) if row["ratio_spread"] else "",
        "reading the weights": _describe(row["floor_seconds"]),
    }


def _describe(seconds: float | None) -> str:
    if seconds is None:
        return ""
    return f"{seconds:.2f} s" if seconds >= 0.1 else f"{seconds * 1e6:.0f} µs"


if __name__ == "__main__":
    main(run, Arguments(), __doc__)
