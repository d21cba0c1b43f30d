"""Show a data set's episodes, and what is wrong with them: a Minari data set, an HDF5 file as D4RL's, an npz file."""

import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import tyro
from rich.table import Table

from dmil_core.demonstrations import Demonstration, DemonstrationError
from dmil_core.errors import RunError
from dmil_core.files import at_home
from services.cli.arguments import exit_code, parse
from services.cli.composition import suite_settings
from services.cli.progress import Bar, console
from services.demonstrations.external import FORMS, SUFFIXES, ExternalEpisode, misfits, oddities, read_episodes
from services.demonstrations.layouts import looks_like
from services.suites.base import TaskSuite
from services.suites.registry import open_suite


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``collect_demos inspect``."""

    data: Annotated[str, tyro.conf.Positional]
    """An id of Minari's, an HDF5 file or an npz file; see docs/data.md."""
    suite: str | None = None
    """Also check that it fits this suite; in the kitchen, replay each episode and show the sub-tasks that it does."""


def run(arguments: Sequence[str]) -> None:
    """Run the program.

    Raises:
        RunError: if something is wrong with the data set.
    """
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    suite = None if args.suite is None else open_suite(suite_settings(args.suite))
    form = args.data.partition(":")[0]
    file = at_home(args.data)
    if form not in FORMS and file.suffix not in SUFFIXES and file.is_file():
        raise DemonstrationError(
            f"{args.data}: got {looks_like(file)}; wanted one of {', '.join(SUFFIXES)}, or the id of a Minari data "
            "set, see docs/data.md"
        )
    place = args.data if form in FORMS else f"{SUFFIXES.get(file.suffix, 'minari')}:{args.data}"
    episodes = read_episodes(place)
    console.print(_table(place, episodes, suite))
    problems = [*_problems(episodes, suite)]
    for problem in problems:
        console.print(problem)
    if problems:
        raise RunError(f"{place}: {len(problems)} things are wrong with {len(episodes)} episodes, see above")
    console.print("nothing is wrong with it")


def _table(place: str, episodes: Sequence[ExternalEpisode], suite: TaskSuite | None) -> Table:
    shapes = {(one.observations.shape[1], one.actions.shape[1]) for one in episodes}
    numbers = " and ".join(f"{obs_dim} observed, {action_dim} done" for obs_dim, action_dim in sorted(shapes))
    view = Table(title=f"{place}: {len(episodes)} episodes; numbers a step: {numbers}")
    replay = getattr(suite, "replay", None)
    columns = ["episode", "steps", "observations", "actions", "reward", "success"]
    for column in columns + ["replayed"] * (replay is not None):
        view.add_column(column, justify="left" if column == "replayed" else "right")
    with Bar("reading", len(episodes)) as bar:
        for index, one in enumerate(episodes):
            row = [
                str(index),
                str(len(one.actions)),
                _range(one.observations),
                _range(one.actions),
                "" if one.reward is None else f"{one.reward:g}",
                "" if one.success is None else ("yes" if one.success else "no"),
            ]
            view.add_row(*row, *([] if replay is None or suite is None else [_replayed(one, suite)]))
            bar.advance(1)
    return view


def _range(values: np.ndarray) -> str:
    return f"{values.min():.3g} to {values.max():.3g}" if values.size else "none"


def _replayed(episode: ExternalEpisode, suite: TaskSuite) -> str:
    try:
        return suite.replay(_demonstration(episode, 0, suite))  # type: ignore[attr-defined]
    except DemonstrationError:
        return "not possible"


def _demonstration(episode: ExternalEpisode, index: int, suite: TaskSuite | None) -> Demonstration:
    state_of = getattr(suite, "state_of", lambda observations: observations)
    return Demonstration(f"{index:03d}", "recorded", state_of(episode.observations), episode.actions)


def _problems(episodes: Sequence[ExternalEpisode], suite: TaskSuite | None) -> Iterator[str]:
    """Yield what keeps a data set from being learned from, and what looks like a mistake."""
    odd: dict[int, list[str]] = defaultdict(list)
    for index, oddity in oddities(episodes):
        odd[index].append(oddity)
    for index, one in enumerate(episodes):
        yield from (f"episode {index}: {oddity}" for oddity in odd[index])
        if not one.whole:
            yield f"episode {index}: its end is not marked; its {len(one.actions)} steps are left out"
        elif len(one.actions) == 1 and one.problem is None:
            yield f"episode {index}: a single step"
        try:
            demonstration = _demonstration(one, index, suite)
        except DemonstrationError as error:
            yield f"episode {index}: {error}"
            continue
        if suite is not None:
            yield from (f"episode {index}: {misfit}" for misfit in misfits(demonstration, suite))
        if (far := np.abs(one.actions).max()) > 1:
            yield f"episode {index}: actions of up to {far:.3g}; wanted -1 to 1: acting clips what lies outside"
        if len(one.actions) > 1 and not one.actions.std(axis=0).any():
            yield f"episode {index}: the same action at every step"
        if one.success is False:
            yield f"episode {index}: no step is a success"


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
