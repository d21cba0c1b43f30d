"""Where a run's figures come from: demonstrations, versions, time; and how to have them again, to the episode."""

import shlex

from dmil_core.configs import DEFAULT_METHOD, ExperimentConfig
from services.experiments.finished_run import FinishedRun
from services.reporting.page import Commands, DataTable, Part, Prose, Section
from services.reporting.settings import flags, nearest_preset

DIGITS = 16
"""Of a data set's digest."""
MOST_ROWS = 6000
"""Of episodes in a page, some 2 MB."""


def origin_of_run(finished: FinishedRun) -> Section:
    """Return the section with commands, demonstrations, the commit, versions and seconds."""
    manifest, commits = finished.checkpoint.manifest, ", then ".join(finished.origin.commits)
    parts: list[Part] = [
        Commands(
            "To add to this page what failed, films of it, sub-skills in rollouts, and success over fine-tuning steps",
            [f"dmil report run {shlex.quote(str(finished.folder))} --videos --adaptation"],
        ),
        Commands("To train and evaluate it again", [training_command(finished.checkpoint.manifest.config)]),
        Commands(
            "To evaluate the checkpoint again, and to write this page again",
            [_evaluating(finished), f"dmil report run {shlex.quote(str(finished.folder))}"],
        ),
        Prose(
            f"Commit of the code: {commits or 'unknown'}. Digest of the checkpoint: "
            f"{finished.summary.checkpoint_digest}. Equal settings, data and versions give equal bits on the same kind "
            "of processor, with any number of workers."
        ),
        _data_sets(finished),
        DataTable("Versions", ["library", "version"], list(manifest.versions.items())),
        *_devices(finished),
        DataTable("Time", ["phase", "seconds"], list(finished.summary.seconds.items())),
    ]
    return Section("Where it comes from", parts)


def _devices(finished: FinishedRun) -> list[Part]:
    """Return what adapted, if that was not the CPU."""
    devices = sorted({row.device for row in finished.episodes} - {"cpu"})
    return [Prose(f"Adapted on {', '.join(devices)}; the episodes are the CPU's.")] if devices else []


def _evaluating(finished: FinishedRun) -> str:
    trained, now = finished.checkpoint.manifest.config, finished.config
    other = {
        f"evaluation.{name}": value for name, value in now.evaluation if value != getattr(trained.evaluation, name)
    }
    if now.suite.test_tasks != trained.suite.test_tasks:
        other["tasks"] = now.suite.test_tasks
    if now.demonstrations.source != trained.demonstrations.source:
        other["demos"] = now.demonstrations.source
    return f"dmil evaluate {shlex.quote(str(finished.checkpoint.path))} {flags(other)}".rstrip()


def training_command(config: ExperimentConfig) -> str:
    """Return the line that trains and evaluates with these settings."""
    nearest = nearest_preset(config)
    method = config.method.name
    named = "" if method == DEFAULT_METHOD else f" --method {method}"
    command = f"python -m services.meta_train --suite {config.suite.name} --preset {nearest.size}{named}"
    return f"{command} {flags(nearest.differing)}".rstrip()


def _data_sets(finished: FinishedRun) -> DataTable:
    summary, ids = finished.summary, {digest: name for name, digest in finished.origin.data_sets.items()}
    rows = [
        [
            *(task, ids.get(digest, "")),
            *(counts.get(task, "") for counts in (summary.demonstrations, summary.failed_attempts)),
            digest[:DIGITS],
        ]
        for task, digest in finished.checkpoint.manifest.data.items()
    ]
    head = ["task", "data set", "demonstrations", "failed attempts", f"SHA-256, first {DIGITS} digits"]
    return DataTable("Demonstrations", head, rows)


def episodes_of_run(finished: FinishedRun) -> Section:
    """Return the section with a row for each episode, and how to see one."""
    rows, scored = finished.episodes, finished.best_score > 1
    folder = shlex.quote(str(finished.folder))
    head = ["task", "split", "shots", "episode", "draw", "support", "success", "steps", "seed"]
    fields = [
        [
            *(row.task, row.split, row.shots, row.episode, row.draw, " ".join(row.support)),
            *("yes" if row.success else "no", row.steps, row.seed),
            *([row.score] if scored else []),
        ]
        for row in rows[:MOST_ROWS]
    ]
    pattern = f"dmil report video {folder} --task TASK --shots SHOTS --episode EPISODE"
    parts: list[Part] = [Commands("To see one", [pattern])]
    if len(rows) > MOST_ROWS:
        path = finished.folder / "episodes.jsonl"
        parts.append(Prose(f"The first {MOST_ROWS:,} of {len(rows):,} episodes; all are in {path}."))
    caption = "Each episode; a draw is which of the support sets was adapted to, the seed is the environment's"
    return Section("Episodes", [*parts, DataTable(caption, head + (["score"] if scored else []), fields, True)])
