"""Where in a task each sub-skill is chosen: t-SNE of demonstrated states, coloured by sub-skill (Figure 4a)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.settings import sub_skills_of
from services.cli.progress import Bar
from services.reporting.choices import describe_shares, statistics
from services.reporting.drawing import Picture, colour_of, legend_of_markers, marker_of, panels, to_picture
from services.reporting.options import EMBEDDING_SHOTS, PERPLEXITY, SEED
from services.reporting.page import Part, Prose, Section
from services.reporting.run_group import RunGroup, has_sub_skills, policies

OTHERS = 16
"""Demonstrations whose states the paper draws, besides those that it adapts to."""
MOST_STATES, MOST_POINTS = 800, 2000
"""So many states are embedded, a few seconds' work, and so many points drawn in all panels together."""
IN_USE = 0.01
"""A sub-skill counts as used from this part of the states on."""


class Thinned(NamedTuple):
    """Every so many-th state of some demonstrations."""

    every: int
    states: Float32[np.ndarray, "states obs_dim"]
    of: Int64[np.ndarray, " states"]
    """Which of all steps of all demonstrations, one after the other, these are."""


class _Panel(NamedTuple):
    title: str
    sub_skills: int
    chosen: Int64[np.ndarray, " states"]


def thin_out(demonstrations: Sequence[Demonstration], most: int) -> Thinned:
    """Keep every n-th state of each demonstration, its first one among them, with the least n that leaves few enough.

    Where there are more demonstrations than that, the first state of each is left.
    """
    lengths = [len(demonstration) for demonstration in demonstrations]
    every = next(n for n in range(1, max(lengths) + 1) if n == max(lengths) or sum(-(-x // n) for x in lengths) <= most)
    starts = np.cumsum([0, *lengths[:-1]])
    of = np.concatenate([start + np.arange(0, length, every) for start, length in zip(starts, lengths, strict=True)])
    return Thinned(every, np.concatenate([d.observations for d in demonstrations])[of], of)


def embed(states: Float[np.ndarray, "states obs_dim"], perplexity: float, seed: int) -> Float32[np.ndarray, "states 2"]:
    """Return t-SNE's places of states (van der Maaten and Hinton 2008): near states lie near each other.

    The perplexity is about how many neighbours count as near: fewer than there are states.
    """
    from sklearn.manifold import TSNE  # takes a second to import: not for each program that can draw

    tsne = TSNE(perplexity=perplexity, init="pca", learning_rate="auto", random_state=seed, n_jobs=1)
    return tsne.fit_transform(states).astype(np.float32)


def embedding_section(
    group: RunGroup, shots: int = EMBEDDING_SHOTS, perplexity: float = PERPLEXITY, seed: int = SEED
) -> Section:
    """Return a section with a picture for each task, of all runs whose methods have sub-skills.

    The perplexity of t-SNE is a third of the states where there are few.

    Raises:
        UserError: if no demonstration is left besides the support set.
    """
    title = "t-SNE of states by sub-skill"
    if not any(map(has_sub_skills, group.runs.values())):
        return Section(title, [])
    parts: list[Part] = [
        Prose(
            f"States of held-out demonstrations, laid out so that near states lie near each other, and coloured by the "
            f"sub-skill that the high level takes in them: before adaptation and after that to {shots} other "
            "demonstrations. All panels of a task show the same states in the same places; distances between clusters "
            "and their sizes mean nothing. The paper reads fewer, connected regions as more meaningful sub-skills."
        )
    ]
    with Bar("embedding states", len(group.held_out)) as bar:
        for task in group.held_out:
            parts.append(_draw(group, task, shots, perplexity, seed))
            bar.advance(1, task)
    return Section(title, parts)


def _draw(group: RunGroup, task: str, shots: int, perplexity: float, seed: int) -> Picture:
    support, others = group.shots(task, shots, OTHERS)
    runs = {label: run for label, run in group.runs.items() if has_sub_skills(run)}
    kept = thin_out(others, min(MOST_STATES, MOST_POINTS // (2 * len(runs))))
    perplexity = min(perplexity, max(1.0, (len(kept.states) - 1) / 3))
    places = embed(Normalisation.of(others)(kept.states), perplexity, seed)
    policy_panels = [
        _Panel(
            f"{label}, {adaptation} adaptation",
            sub_skills_of(run.config.method),
            np.concatenate([policy.sub_skill_use(other).chosen for other in others])[kept.of],
        )
        for label, run in runs.items()
        for adaptation, policy in policies(run, support).items()
    ]
    rows, columns = (1, 2) if len(runs) == 1 else (2, len(runs))
    # All before adaptation above all after it.
    in_order = policy_panels if rows == 1 else [*policy_panels[::2], *policy_panels[1::2]]
    width, height = max(7.5, 2.5 * columns), 3.6 if rows == 1 else 6.0
    with panels(rows, columns, width=width, height=height) as (figure, axes):
        for axis, panel in zip(axes, in_order, strict=True):
            for k in range(panel.sub_skills):
                x, y = places[panel.chosen == k].T
                axis.plot(x, y, marker_of(k), color=colour_of(k), markersize=3, markeredgewidth=0, alpha=0.85)
            axis.set(title=panel.title, xticks=[], yticks=[], xlabel="t-SNE 1", ylabel="t-SNE 2")
        most = max(panel.sub_skills for panel in policy_panels)
        legend_of_markers(figure, [f"sub-skill {k}" for k in range(most)])
        description = _describe(policy_panels, kept, len(support), len(others), perplexity, seed)
        return to_picture(figure, f"t-SNE of {task}", description)


def _describe(panels: Sequence[_Panel], kept: Thinned, support: int, others: int, perplexity: float, seed: int) -> str:
    thinned = "all" if kept.every == 1 else f"one in {kept.every}"
    few = f", of which the paper draws {OTHERS}; no more are held out" if others < OTHERS else ""
    use = "; ".join(f"{panel.title}: {_shares(panel)}" for panel in panels)
    return (
        f"{len(kept.states)} states, {thinned} of those in {others} held-out demonstrations{few}; adapted to {support} "
        f"others; perplexity {perplexity:g}, seed {seed}. {use}."
    )


def _shares(panel: _Panel) -> str:
    shares = statistics([panel.chosen], panel.sub_skills).shares
    return f"{(shares >= IN_USE).sum()} of {panel.sub_skills} sub-skills in use, {describe_shares(shares)}"
