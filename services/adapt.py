"""Adapt a model to demonstrations of your own, show what came of it, and save the policy to a folder.

With two or more demonstrations each is left out in turn: the error on the one left out chooses the number of steps.
For example:

  dmil adapt ml45 --demos npz:mine.npz --output peg
  dmil adapt ml45 --demos npz:mine.npz --output lock --suite ml45 --task door-lock
"""

import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from dmil_core.demonstrations import Demonstration
from dmil_core.errors import UserError
from dmil_core.seeding import named_seed
from dmil_core.settings import sub_skills_of
from dmil_core.statistics import interval_text, success_rate
from services.cli.arguments import exit_code, parse
from services.cli.composition import suite_settings
from services.cli.progress import Bar, console
from services.demonstrations.external import places_of, read_episodes
from services.suites.base import TaskSuite, build_env
from services.suites.registry import open_suite

if TYPE_CHECKING:
    from dmil_core.adapted_policy import AdaptedPolicy
    from dmil_core.model import Model

FACTORS = (0, 0.5, 1, 2, 4)
"""Numbers of steps to choose from, as multiples of the model's own."""
MOST_LEFT_OUT = 5
"""Of so many demonstrations each is left out in turn; more would only take longer."""


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``adapt``."""

    model: Annotated[str, tyro.conf.Positional]
    """A model that comes with the project, as ml10; a run's name, its folder or that of a checkpoint; or
    models:/NAME@champion."""
    demos: str
    """Demonstrations of one task, as npz:mine.npz; see docs/data.md."""
    output: Path = Path("policy")
    """New folder for the policy."""
    steps: int | None = None
    """Gradient steps of adaptation, in place of those that the demonstration left out chooses."""
    learning_rate: float | None = None
    """Learning rate of adaptation; the run's own if not given."""
    device: str = "cpu"
    """Where it is adapted: cpu, or a GPU as cuda or cuda:N; the policy acts on the CPU."""
    suite: str | None = None
    """Also let the policy act in a task of this suite, and measure its success rate."""
    task: str | None = None
    """The task of --suite that the demonstrations are of."""
    episodes: int = 20
    """Episodes in which success is measured."""
    runs: Path = Path("runs")
    """The folder that runs' own folders are in."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING, tyro.MISSING))
    if args.output.exists():
        raise UserError(f"--output: got {args.output}, which is there already; wanted the name of a new folder")
    if (args.suite is None) != (args.task is None):
        raise UserError("--suite: got --suite or --task alone; wanted both: --suite ml45 --task door-lock")
    if args.episodes < 1:
        raise UserError(f"--episodes: got {args.episodes}; wanted at least 1")
    from dmil_core.model import UnlikeTrainingWarning, load
    from services.rollouts.adaptations import imitation_error

    suite = None if args.suite is None else open_suite(suite_settings(args.suite, (str(args.task),)))
    model = load(args.model, args.runs, args.device)
    recorded = _recorded(args.demos, suite)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UnlikeTrainingWarning)
        support = model.adapt(recorded, steps=0, learning_rate=args.learning_rate).support
    for warning in caught:
        console.print(f"warning: {warning.message}", soft_wrap=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnlikeTrainingWarning)
        steps = _chosen_steps(model, support, args)
        before, policy = (model.adapt(support, steps=count, learning_rate=args.learning_rate) for count in (0, steps))
    errors = [imitation_error(one.policy, support) for one in (before, policy)]
    console.print(f"error on what was demonstrated: {errors[0]:.4g} before adaptation, {errors[1]:.4g} after")
    _show_sub_skills(policy, support)
    if suite is not None:
        _measure(policy, suite, str(args.task), args.episodes, model.checkpoint.manifest.config.seed)
    policy.save(args.output)
    console.print(_guide(args.output, policy), soft_wrap=True)


def _recorded(source: str, suite: TaskSuite | None) -> list[tuple[np.ndarray, np.ndarray]]:
    """Read the one data set that a source names, with the suite's states where it has a form of its own."""
    places = list(places_of(source).values())
    if len(places) != 1:
        raise UserError(f"--demos: got {len(places)} data sets; wanted one, of one task")
    state_of = getattr(suite, "state_of", lambda observations: observations)
    return [(state_of(episode.observations), episode.actions) for episode in read_episodes(places[0])]


def _chosen_steps(model: "Model", support: Sequence[Demonstration], args: Arguments) -> int:
    """Return the number of steps with the least mean error on the demonstrations left out, and print all errors."""
    usual = model.fine_tuning.steps
    candidates = sorted({round(usual * factor) for factor in FACTORS}) if args.steps is None else [args.steps]
    if len(support) < 2:
        console.print("one demonstration: none can be left out to choose the number of steps; the run's own are taken")
        return usual if args.steps is None else args.steps
    folds = range(min(len(support), MOST_LEFT_OUT))
    errors: dict[int, float] = {}
    with Bar("leaving one out", len(candidates) * len(folds)) as bar:
        for steps in candidates:
            of_folds = []
            for fold in folds:
                others = [one for index, one in enumerate(support) if index != fold]
                of_folds.append(_error(model, others, support[fold], steps, args.learning_rate))
                bar.advance(1)
            errors[steps] = float(np.mean(of_folds))
    best = min(candidates, key=lambda steps: (errors[steps], abs(steps - usual)))
    shown = ", ".join(f"{error:.4g} after {steps}" for steps, error in errors.items())
    console.print(f"error on the demonstration left out, by steps: {shown}; taking {best}", soft_wrap=True)
    return best


def _error(
    model: "Model", support: Sequence[Demonstration], left_out: Demonstration, steps: int, rate: float | None
) -> float:
    """Return the error on a demonstration that was not adapted to; infinite where adaptation diverges."""
    from dmil_core.model import DivergedError
    from services.rollouts.adaptations import imitation_error

    try:
        return imitation_error(model.adapt(support, steps=steps, learning_rate=rate).policy, [left_out])
    except DivergedError:
        return float("inf")


def _show_sub_skills(policy: "AdaptedPolicy", support: Sequence[Demonstration]) -> None:
    count = sub_skills_of(policy.origin.model.config.method)
    if count > 1:
        chosen = np.concatenate([policy.policy.sub_skill_use(one).chosen for one in support])
        shares = np.bincount(chosen, minlength=count) / len(chosen)
        shown = ", ".join(f"{share:.2f}" for share in shares)
        console.print(f"sub-skills in use: {np.count_nonzero(shares)} of {count}, with {shown} of the steps")


def _measure(policy: "AdaptedPolicy", suite: TaskSuite, task: str, episodes: int, seed: int) -> None:
    """Let the policy act in so many episodes, the first ones of an evaluation, and print how many are successes."""
    from services.rollouts.episodes import rollout

    seeds = [named_seed(seed, "evaluation", task, episode) for episode in range(episodes)]
    rollouts = []
    with Bar("acting", episodes) as bar:
        env = build_env(suite, task)
        for episode_seed in seeds:
            rollouts += rollout(policy.policy, [env], [episode_seed], suite.horizon)
            bar.advance(1)
    rate = success_rate([one.success for one in rollouts])
    interval = interval_text(rate.low, rate.high, 2)
    console.print(
        f"success in {task} of {suite.name} ({suite.protocol}): {sum(one.success for one in rollouts)} of {episodes}, "
        f"{rate.mean:.2f}, 95% interval {interval}",
        soft_wrap=True,
    )


def _guide(folder: Path, policy: "AdaptedPolicy") -> str:
    interface = policy.origin.interface
    return (
        f"policy: {folder} ({policy.nbytes / 1e6:.1f} MB; {policy.origin.fine_tuning.steps} steps at "
        f"{policy.origin.fine_tuning.learning_rate:g}). In Python, see docs/use-a-policy.md:\n\n"
        f"  import dmil_core as dmil\n\n"
        f'  policy = dmil.load_policy("{folder}")\n'
        f"  policy.reset()\n"
        f"  action = policy(observation)  # {interface.obs_dim} numbers in, {interface.action_dim} out, at each step\n"
    )


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
