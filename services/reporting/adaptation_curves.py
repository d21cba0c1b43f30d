"""Success and loss over fine-tuning steps, for several sizes of the support set: measured once, kept, and drawn."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict

from dmil_core.configs import EvaluationConfig
from dmil_core.demonstrations import Demonstration, DemonstrationError
from dmil_core.errors import UserError
from dmil_core.files import inside, read_json, remove_file, write_file
from dmil_core.statistics import Mean, interval_text, success_rate
from services.cli.composition import with_evaluation
from services.cli.progress import Bar, console
from services.distributed.runner import Runner
from services.distributed.work_items import AdaptationImitation
from services.evaluation.evaluator import Evaluator
from services.evaluation.results import EpisodeResult, ImitationResult, read_rows, write_rows
from services.experiments.experiment import Experiment
from services.experiments.finished_run import FinishedRun
from services.reporting.drawing import (
    Picture,
    colour_of,
    legend_of_markers,
    marker_of,
    panels,
    scale_by_logarithms,
    to_picture,
)
from services.reporting.page import DataTable, Part, Prose, Section
from services.reporting.run_group import MOST_TASKS, policy_after

FOLDER, PLAN, IMITATION = "adaptation", "plan.json", "imitation.jsonl"
SHOTS = (1, 3, 5, 10)
PARTS = (0.0, 0.1, 0.3, 1.0, 2.0)
"""The fine-tuning steps that are measured, in parts of those of the run's evaluation."""
EPISODES, DRAWS = 10, 2
"""Of each task, for each number of shots and steps; and the support sets that these are spread over."""
APART = 0.08
"""How far lines stand from each other, where a number of steps takes 1."""
MOST_BYTES = 2**20


class CurvePlan(BaseModel):
    """What is measured: ``adaptation/plan.json`` in the run's folder."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    checkpoint: str
    """Its digest."""
    tasks: tuple[str, ...]
    steps: tuple[int, ...]
    evaluation: EvaluationConfig
    """All else; its fine-tuning steps are the run's own."""

    def at(self, steps: int) -> EvaluationConfig:
        """Return the evaluation after so many fine-tuning steps."""
        return self.evaluation.model_copy(update={"fine_tuning_steps": steps})


class Point(NamedTuple):
    """What came of so many shots and fine-tuning steps, in all tasks together."""

    shots: int
    steps: int
    success: Mean
    held_out_error: float | None
    """Mean ‖π(s) − a‖² over support sets; none where a policy has diverged, or no demonstration is left."""
    support_error: float | None


def measure(
    run: FinishedRun,
    runner: Runner,
    *,
    tasks: Sequence[str] | None = None,
    shots: Sequence[int] = SHOTS,
    steps: Sequence[int] | None = None,
    episodes: int = EPISODES,
) -> CurvePlan:
    """Measure success and imitation error over fine-tuning steps, and keep the rows in the run's folder.

    What was measured before with the same settings is not measured again, so it goes on where it was stopped.

    Args:
        run: whose newest checkpoint is adapted.
        runner: of the run's suite; does the work.
        tasks: of the run; its meta-testing tasks, at most `MOST_TASKS`, if none are given.
        shots: sizes of the support set; those that the held-out demonstrations or the method do not allow are left out.
        steps: of fine-tuning; `PARTS` of those of the run's evaluation if none are given.
        episodes: of each task, the same ones for all sizes and steps.

    Raises:
        UserError: for a task that the run does not have, or if no size of the support set is left.
    """
    plan = _planned(run, tasks, shots, steps, episodes)
    write_file(run.folder, f"{FOLDER}/{PLAN}", plan.model_dump_json(indent=1) + "\n")
    for number, count in enumerate(plan.steps, start=1):
        experiment = Experiment(with_evaluation(run.config, plan.at(count)), run.experiment.store)
        evaluator = experiment.evaluator(runner, run.demonstrations, plan.tasks)
        rows_folder = _folder_of(run, count)
        if not _is_measured(rows_folder, evaluator, plan, count):
            console.print(f"{count} fine-tuning steps, {number} of {len(plan.steps)}")
            remove_file(rows_folder, IMITATION)
            experiment.evaluate(runner, run.demonstrations, run.checkpoint, rows_folder, plan.tasks)
            _measure_imitation(run, runner, evaluator, rows_folder)
    return plan


def _planned(
    run: FinishedRun, tasks: Sequence[str] | None, shots: Sequence[int], steps: Sequence[int] | None, episodes: int
) -> CurvePlan:
    known, evaluation_of_run = [task for _, task in run.experiment.tasks], run.config.evaluation
    wanted = tuple(dict.fromkeys(tasks or run.experiment.suite.test_tasks[:MOST_TASKS]))
    if unknown := [task for task in wanted if task not in known]:
        raise UserError(f"tasks: got {', '.join(unknown)}; wanted some of the run's, {', '.join(known)}")
    sizes = _possible(run, wanted, shots)
    draws = DRAWS if DRAWS * max(sizes) <= run.config.demonstrations.held_out else 1
    evaluation = evaluation_of_run.model_copy(
        update={"shots": sizes, "episodes": episodes, "support_draws": min(draws, episodes), "every": None}
    )
    counts = steps or [max(round(part * evaluation_of_run.fine_tuning_steps), int(part > 0)) for part in PARTS]
    return CurvePlan(
        checkpoint=run.checkpoint.digest, tasks=wanted, steps=tuple(sorted(set(counts))), evaluation=evaluation
    )


def _possible(run: FinishedRun, tasks: Sequence[str], shots: Sequence[int]) -> tuple[int, ...]:
    """Return those sizes of a support set that leave a demonstration to judge by, and that the method takes."""
    held_out = run.experiment.held_out_sets(run.demonstrations)
    few = min((held_out[task] for task in tasks), key=len)
    possible = tuple(sorted({size for size in shots if size < len(few) and _takes(run, few[:size])}))
    if not possible:
        raise UserError(
            f"shots: got {', '.join(map(str, shots))}; wanted a size below the {len(few)} held-out demonstrations that "
            f"{run.config.method.name} can adapt to"
        )
    return possible


def _takes(run: FinishedRun, support: Sequence[Demonstration]) -> bool:
    """Tell whether a method adapts to so many demonstrations, which MIL does only up to a number set in training."""
    try:
        policy_after(run, support, 0)
    except DemonstrationError:
        return False
    return True


def _folder_of(run: FinishedRun, steps: int) -> Path:
    return inside(run.folder, f"{FOLDER}/{steps:07d}")


def _rows(folder: Path) -> tuple[list[EpisodeResult], list[ImitationResult]]:
    """Return what is in a folder: nothing unless it is complete, for the errors are written last."""
    errors = folder / IMITATION
    if not errors.exists():
        return [], []
    return read_rows(folder / "episodes.jsonl", EpisodeResult), read_rows(errors, ImitationResult)


def _is_measured(folder: Path, evaluator: Evaluator, plan: CurvePlan, steps: int) -> bool:
    """Tell whether a folder has all rows of an evaluation, and no others."""
    episodes, errors = _rows(folder)
    adaptations = [(adaptation.task, adaptation.shots, adaptation.draw) for adaptation in evaluator.adaptations]
    settings = {(row.checkpoint, row.fine_tuning_steps, row.learning_rate) for row in (*episodes, *errors)}
    return (
        [(row.task, row.shots, row.draw) for row in errors] == adaptations
        and [row.episode for row in episodes]
        == [number for adaptation in evaluator.adaptations for number in adaptation.episodes]
        and settings == {(plan.checkpoint, steps, plan.evaluation.learning_rate)}
    )


def _measure_imitation(run: FinishedRun, runner: Runner, evaluator: Evaluator, folder: Path) -> None:
    """Compare the adapted policies with demonstrations, and write a row for each."""
    outcomes = {}
    with Bar("comparing with demonstrations", len(evaluator.adaptations)) as bar:
        for index, outcome in runner.simulate(evaluator.items(run.checkpoint, AdaptationImitation)):
            outcomes[index] = outcome
            bar.advance(1, evaluator.adaptations[index].task)
    in_order = [outcomes[index] for index in range(len(outcomes))]
    write_rows(folder / IMITATION, evaluator.imitation(run.checkpoint, in_order))


def _plan_of(run: FinishedRun) -> CurvePlan | None:
    """Return what was measured of the run's newest checkpoint, if anything was."""
    name = f"{FOLDER}/{PLAN}"
    if not (run.folder / name).exists():
        return None
    advice = "wanted what measuring adaptation writes; remove it and measure again"
    plan = read_json(run.folder, name, CurvePlan, MOST_BYTES, advice)
    return plan if plan.checkpoint == run.checkpoint.digest else None


def points(run: FinishedRun) -> list[Point]:
    """Return what was measured of the run's newest checkpoint, by shots and steps; none if nothing was."""
    plan, measured = _plan_of(run), []
    for steps in plan.steps if plan else ():
        episodes, errors = _rows(_folder_of(run, steps))
        for shots in dict.fromkeys(row.shots for row in errors):
            of_shots = [row for row in errors if row.shots == shots]
            rate = success_rate([row.success for row in episodes if row.shots == shots])
            held_out = _mean([row.held_out_error for row in of_shots])
            measured.append(Point(shots, steps, rate, held_out, _mean([row.support_error for row in of_shots])))
    return sorted(measured, key=lambda point: (point.shots, point.steps))


def _mean(errors: Sequence[float | None]) -> float | None:
    finite = [error for error in errors if error is not None]
    return float(np.mean(finite)) if len(finite) == len(errors) else None


def adaptation_section(run: FinishedRun) -> Section:
    """Return the curves and the table of what `measure` has found; without parts if it was not called."""
    title, plan, measured = "Adaptation", _plan_of(run), points(run)
    if plan is None or not measured:
        return Section(title, [])
    lacking = [str(steps) for steps in plan.steps if steps not in {point.steps for point in measured}]
    wanted = [str(size) for size in SHOTS if size not in plan.evaluation.shots]
    parts: list[Part] = [
        Prose(
            f"Success and loss over fine-tuning steps on {', '.join(plan.tasks)}: {plan.evaluation.episodes} episodes "
            f"of each task for each number of shots and steps, over {plan.evaluation.support_draws} support set"
            f"{'s' if plan.evaluation.support_draws > 1 else ''}, at the learning rate "
            f"{plan.evaluation.learning_rate:g}. The run's own evaluation takes {plan.evaluation.fine_tuning_steps} "
            "steps. The loss is the squared error of the policy's actions in the states of demonstrations, with the "
            "sub-skills that the high level takes: on held-out ones that it was not adapted to, and on the support set."
            + (f" Not measured for {', '.join(wanted)} shots." if wanted else "")
            + (f" Measuring was stopped before {', '.join(lacking)} steps." if lacking else "")
        ),
        _draw(measured),
        _table(measured),
    ]
    return Section(title, parts)


def _draw(measured: Sequence[Point]) -> Picture:
    """Draw a line for each number of shots, at places side by side for each number of steps."""
    sizes = list(dict.fromkeys(point.shots for point in measured))
    steps = sorted({point.steps for point in measured})
    with panels(1, 3, width=10.0, height=3.4) as (figure, axes):
        success, held_out, support = axes
        for index, size in enumerate(sizes):
            of_size = [point for point in measured if point.shots == size]
            at = np.array([steps.index(point.steps) for point in of_size]) + APART * (index - (len(sizes) - 1) / 2)
            style = {"color": colour_of(index), "marker": marker_of(index), "markersize": 4, "label": f"{size}-shot"}
            reach = np.transpose([point.success.reach for point in of_size])
            rates = [point.success.mean for point in of_size]
            success.errorbar(at, rates, yerr=reach, elinewidth=0.8, capsize=2, **style)
            held_out.plot(at, np.array([point.held_out_error for point in of_size], float), **style)
            support.plot(at, np.array([point.support_error for point in of_size], float), **style)
        success.set(title="success", ylabel="success rate", ylim=(-0.02, 1.02))
        for axis, title in ((held_out, "loss on held-out demonstrations"), (support, "loss on the support set")):
            axis.set(title=title, ylabel="squared error of actions")
            scale_by_logarithms(axis)
        for axis in axes:
            axis.set_xticks(range(len(steps)), map(str, steps))
            axis.set_xlabel("fine-tuning steps, not to scale")
        legend_of_markers(figure, [f"{size}-shot" for size in sizes], "solid")
        text = "; ".join(f"{size}-shot {_course(measured, size)}" for size in sizes)
        return to_picture(figure, "Success and loss over fine-tuning steps", f"Bars are 95% Wilson intervals. {text}.")


def _course(measured: Sequence[Point], shots: int) -> str:
    of_shots = [point for point in measured if point.shots == shots]
    return "success " + ", ".join(f"{point.success.mean:.2f} after {point.steps} steps" for point in of_shots)


def _table(measured: Sequence[Point]) -> DataTable:
    rows = []
    for shots, steps, rate, *errors in measured:
        success = [f"{rate.mean:.3f}", interval_text(rate.low, rate.high, 3)]
        losses = ["" if error is None else f"{error:.4f}" for error in errors]
        rows.append([shots, steps, *success, f"{round(rate.mean * rate.episodes)} of {rate.episodes}", *losses])
    head = ["shots", "fine-tuning steps", "success rate", "95% interval", "episodes"]
    head += ["loss on held-out demonstrations", "loss on the support set"]
    return DataTable("Success and loss over fine-tuning steps, all tasks together", head, rows)
