"""Show a data set's episodes, what is wrong with them, and the line or the flag that mends it.

Read are Minari's data sets, HDF5 files as D4RL, robomimic and LIBERO have them, npz files and folders of them, pairs of
npy files, and LeRobot's data sets on disk. For example:

  dmil collect-demos inspect mine.npz --suite ml10
"""

import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

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

LEAVE_OUT = "leave such episodes out where the file is made, as in the six lines of docs/data.md:"
MENDINGS = {
    "acting clips": "actions = np.clip(actions, -1, 1); or, in another unit, actions / np.abs(actions).max(axis=0)",
    "not copied": "where it is recorded: observations.append(observation.copy())",
    "in a robot's units": "in metres and radians: observations / 1000, np.deg2rad(observations)",
    "cuts each step off": "mark last steps only: terminals &= ~np.append(False, terminals[:-1])",
    "its end is not marked": "timeouts[-1] = True",
    " wants ": "give --suite one that has these numbers, or choose and order them: observations[:, [0, 1, 2]]",
    "wanted the 30 of a state": "give --suite another than the kitchen, or choose the state: observations[:, :30]",
}
"""The lines that mend what is wrong, by words of it; what has none is left out."""


class Problem(NamedTuple):
    """What is wrong with an episode."""

    episode: int
    what: str

    @property
    def words(self) -> str:
        """In words, with the episode's number."""
        return f"episode {self.episode}: {self.what}"


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``collect_demos inspect``."""

    data: Annotated[str, tyro.conf.Positional]
    """minari:ID, hdf5:PATH, npz:PATH, npz:FOLDER, npy:OBS.npy+ACTIONS.npy or lerobot:FOLDER; or an id, a file or
    a folder alone. See docs/data.md."""
    suite: str | None = None
    """Also check that it fits this suite; in the kitchen, replay each episode and show the sub-tasks that it does."""


def run(arguments: Sequence[str]) -> None:
    """Run the program.

    Raises:
        RunError: if something is wrong with the data set.
    """
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    suite = None if args.suite is None else open_suite(suite_settings(args.suite))
    place = _place_of(args.data)
    episodes = read_episodes(place)
    console.print(_table(place, episodes, suite))
    problems = [*_problems(episodes, suite)]
    for problem in problems:
        console.print(problem.words, soft_wrap=True)
    for mending, numbers in _mendings(problems).items():
        console.print(f"to mend it: {mending}", soft_wrap=True)
        if mending == LEAVE_OUT:
            console.print(f"  episodes = [one for n, one in enumerate(episodes) if n not in {sorted(numbers)}]")
    if problems:
        raise RunError(f"{place}: {len(problems)} things are wrong with {len(episodes)} episodes, see above")
    console.print(f"nothing is wrong with it; to use it: --demos {place}", soft_wrap=True)


def _place_of(data: str) -> str:
    """Return a data set by its form and place."""
    file = at_home(data)
    if data.partition(":")[0] in FORMS:
        return data
    if file.is_dir():
        return f"{'lerobot' if (file / 'meta').is_dir() else 'npz'}:{data}"
    if file.is_file() and file.suffix not in SUFFIXES:
        got = "one array of a pair" if file.suffix == ".npy" else looks_like(file)
        raise DemonstrationError(
            f"{data}: got {got}; wanted minari:ID, hdf5:PATH, npz:PATH, npz:FOLDER, npy:OBS.npy+ACTIONS.npy or "
            "lerobot:FOLDER; see docs/data.md"
        )
    return f"{SUFFIXES.get(file.suffix, 'minari')}:{data}"


def _mendings(problems: Sequence[Problem]) -> dict[str, set[int]]:
    """Return what mends them, each once, and the episodes that it is for."""
    episodes: dict[str, set[int]] = defaultdict(set)
    for problem in problems:
        mending = next((line for words, line in MENDINGS.items() if words in problem.words), LEAVE_OUT)
        episodes[mending].add(problem.episode)
    return episodes


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
            reward = "" if one.reward is None else f"{one.reward:g}"
            success = "" if one.success is None else "yes" if one.success else "no"
            row = [str(index), str(len(one.actions)), _range(one.observations), _range(one.actions), reward, success]
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


def _problems(episodes: Sequence[ExternalEpisode], suite: TaskSuite | None) -> Iterator[Problem]:
    """Yield what keeps a data set from being learned from, and what looks like a mistake."""
    odd: dict[int, list[str]] = defaultdict(list)
    for index, oddity in oddities(episodes):
        odd[index].append(oddity)
    for index, one in enumerate(episodes):
        yield from (Problem(index, oddity) for oddity in odd[index])
        if not one.whole:
            yield Problem(index, f"its end is not marked; its {len(one.actions)} steps are left out")
        elif len(one.actions) == 1 and one.problem is None:
            yield Problem(index, "a single step")
        try:
            demonstration = _demonstration(one, index, suite)
        except DemonstrationError as error:
            yield Problem(index, str(error))
            continue
        if suite is not None:
            yield from (Problem(index, misfit) for misfit in misfits(demonstration, suite))
        if (far := np.abs(one.actions).max()) > 1:
            yield Problem(index, f"actions of up to {far:.3g}; wanted -1 to 1: acting clips what lies outside")
        if len(one.actions) > 1 and not one.actions.std(axis=0).any():
            yield Problem(index, "the same action at every step")
        if one.success is False:
            yield Problem(index, "no step is a success")


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
