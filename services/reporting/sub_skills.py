"""What the two levels of a policy do on a task: timelines, usage and transitions of its sub-skills (Figure 4b)."""

import math
from collections.abc import Sequence

from services.cli.progress import Bar
from services.reporting.choices import DEMONSTRATIONS, ROLLOUTS, Choices, choices_on
from services.reporting.page import DataTable, Part, Prose, Section
from services.reporting.run_group import RunGroup, has_sub_skills
from services.reporting.sub_skill_pictures import draw_timelines, draw_transitions, draw_usage

MOST_TIMELINES = 3
"""So many demonstrations are drawn; the statistics are of all."""


def sub_skill_sections(group: RunGroup, shots: int = 1, rollouts: int = 3) -> list[Section]:
    """Return a section for each task, with all runs whose methods have sub-skills; none if there is no such run.

    Raises:
        UserError: if no demonstration is left besides the support set.
    """
    if not any(map(has_sub_skills, group.runs.values())):
        return []
    sections = []
    with Bar("looking at sub-skills", len(group.held_out)) as bar:
        for task in group.held_out:
            choices = choices_on(group, task, shots, rollouts)
            sections.append(Section(f"Sub-skills on {task}", _parts(task, shots, choices)))
            bar.advance(1, task)
    return sections


def _parts(task: str, shots: int, choices: Sequence[Choices]) -> list[Part]:
    kinds = [on for on in (DEMONSTRATIONS, ROLLOUTS) if any(choice.timelines[on] for choice in choices)]
    count = min(MOST_TIMELINES, len(choices[0].timelines[DEMONSTRATIONS]))
    support = "one held-out demonstration" if shots == 1 else f"{shots} held-out demonstrations"
    return [
        Prose(
            f"Which sub-skill the high level takes at each step of {task}: before adaptation, which is after no step "
            f"of fine-tuning, and after the fine-tuning of the run's evaluation, to {support}. Drawn are "
            f"{count} of the {len(choices[0].timelines[DEMONSTRATIONS])} held-out demonstrations that were not adapted "
            "to, with their numbers in the data set, and the first episodes of the evaluation with this support set. "
            "An episode ends when the task is solved. Statistics are of all that was not adapted to."
        ),
        *(draw_timelines(f"{task}: sub-skills in {on}", choices, on, MOST_TIMELINES) for on in kinds),
        draw_usage(f"{task}: how sub-skills are used", choices, kinds),
        _usage_table(task, choices, kinds),
        draw_transitions(f"{task}: which sub-skill follows which in {DEMONSTRATIONS}", choices, DEMONSTRATIONS),
        _transition_table(task, choices, kinds),
    ]


def _usage_table(task: str, choices: Sequence[Choices], kinds: Sequence[str]) -> DataTable:
    numbers = range(max(choice.sub_skills for choice in choices))
    rows = []
    for choice in choices:
        for on in kinds:
            use = choice.statistics(on)
            shares = [f"{share:.3f}" for share in use.shares]
            dwell = ["" if math.isnan(steps) else f"{steps:.1f}" for steps in use.dwell]
            lacking = [""] * (len(numbers) - choice.sub_skills)
            counts = [choice.run, choice.adaptation, on, use.episodes, use.steps, f"{use.switches:.2f}"]
            rows.append([*counts, *shares, *lacking, *dwell, *lacking])
    head = ["run", "adaptation", "on", "episodes", "steps", "switches per episode"]
    head += [f"share of {k}" for k in numbers] + [f"dwell time of {k}" for k in numbers]
    caption = f"{task}: shares of steps, and mean steps for which a sub-skill is kept once it is taken"
    return DataTable(caption, head, rows)


def _transition_table(task: str, choices: Sequence[Choices], kinds: Sequence[str]) -> DataTable:
    numbers = range(max(choice.sub_skills for choice in choices))
    rows = [
        [choice.run, choice.adaptation, on, before, *counts.tolist(), *[""] * (len(numbers) - choice.sub_skills)]
        for choice in choices
        for on in kinds
        for before, counts in enumerate(choice.statistics(on).transitions)
        if counts.any()
    ]
    caption = f"{task}: how often a sub-skill is followed by each at the next step"
    return DataTable(caption, ["run", "adaptation", "on", "sub-skill", *(f"then {k}" for k in numbers)], rows)
