"""Film one episode of a finished run, as it was evaluated: which sub-skill acts at each step, and whether it succeeds.

The episode is run again from its row of results. With --demonstration, one that was adapted to is shown beside it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dmil_core.errors import UserError, shorten
from services.cli.arguments import parse
from services.cli.places import announce
from services.cli.progress import console
from services.evaluation.results import EpisodeResult
from services.reporting.options import FormName

if TYPE_CHECKING:
    from services.experiments.finished_run import FinishedRun
    from services.experiments.replay import Replay, ReplayedEpisode
    from services.reporting.film import Form, Side


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``report video``."""

    run: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """Name or folder of a finished run."""
    task: str
    """One of the run's tasks."""
    shots: int = 1
    """Demonstrations adapted to, as in the run's evaluation."""
    episode: int | None = None
    """Number of the episode, the first if not given."""
    format: FormName = "mp4"
    """mp4, which all browsers play, or gif."""
    output: Path | None = None
    """File to write, in the run's folder report/videos if not given."""
    demonstration: bool = False
    """Show beside it the first demonstration of its support set, which the expert gives once more from its seed."""
    runs: Path = Path("runs")
    """The folder that runs are in."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING, tyro.MISSING))
    from services.experiments.finished_run import FinishedRun
    from services.experiments.replay import replaying
    from services.reporting.film import FORMS, write_film
    from services.reporting.video import name_of

    finished = FinishedRun.find(args.run, args.runs)
    row = _row_of(finished, args)
    path = args.output or finished.folder / "report" / "videos" / f"{name_of(row)}.{args.format}"
    if path.suffix != f".{args.format}":
        raise UserError(f"--output: got {path}; wanted a name that ends in .{args.format}, or another --format")
    announce(film=(path, "--output FILE"))
    with replaying(finished) as replay:
        sides, replayed = _sides(replay, row, FORMS[args.format], demonstration=args.demonstration)
    if replayed.difference is not None:
        console.print(f"warning: {replayed.difference}; the film shows what came of it here")
    write_film(path, sides)
    console.print(f"{sides[-1].title}: {sides[-1].ending}")
    console.print(f"{path}, {path.stat().st_size // 1024} KB")


def _row_of(finished: "FinishedRun", args: Arguments) -> EpisodeResult:
    """Return the row of the episode that is asked for."""
    rows = finished.episodes
    tasks = dict.fromkeys(row.task for row in rows)
    if args.task not in tasks:
        raise UserError(f"--task: got {shorten(args.task)}; wanted one of {finished.name}'s: {', '.join(tasks)}")
    rows = [row for row in rows if row.task == args.task]
    shots = sorted({row.shots for row in rows})
    if args.shots not in shots:
        raise UserError(
            f"--shots: got {args.shots}; {finished.name} was evaluated with {', '.join(map(str, shots))}; wanted one "
            "of these, or a run with others: --evaluation.shots"
        )
    by_number = {row.episode: row for row in rows if row.shots == args.shots}
    number = min(by_number) if args.episode is None else args.episode
    if number not in by_number:
        raise UserError(f"--episode: got {number}; wanted one from {min(by_number)} to {max(by_number)}")
    return by_number[number]


def _sides(
    replay: "Replay", row: EpisodeResult, form: "Form", *, demonstration: bool
) -> "tuple[list[Side], ReplayedEpisode]":
    """Return what the film shows from left to right, and the episode that it is about."""
    from services.reporting.film import Side, video_settings
    from services.reporting.video import camera_of, side_of

    camera = camera_of(replay.run)
    video = video_settings(camera, row.steps, form)
    sides = []
    if demonstration:
        shown_first, recording = replay.demonstration(row, video)
        steps = len(shown_first)
        title = f"demonstration {shown_first.id} of {row.task}"
        sides.append(Side(title, recording.frames, steps, None, True, f"demonstrated in {steps} steps"))
    episodes = replay.rerun(row, video, [row.episode])
    replayed = next(episode for episode in episodes if episode.row.episode == row.episode)
    return [*sides, side_of(replay.run, replayed)], replayed
