"""Finished runs whose rows are made up, so that every figure of them is known; their checkpoints are real."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dmil_core.checkpoint import Checkpoint, Manifest
from dmil_core.configs import ExperimentConfig
from dmil_core.outer_loop import OuterState
from services.evaluation.results import AdaptationResult, EpisodeResult, write_rows
from services.evaluation.summary import Evaluation, summarise, write_summary
from services.storage.checkpoints import Checkpoints

SPLITS = ("meta-training", "meta-testing")
TASKS = ("reach", "push", "window-open")


def make_run(
    folder: Path,
    solved: Callable[[str, int], bool],
    *,
    seed: int = 0,
    settings: Mapping[str, Mapping[str, Any]] = {},
    protocol: str = "p",
    tasks: Sequence[str] = TASKS,
    episodes: int = 20,
    first_seed: int = 0,
    best: int = 1,
    metrics: Sequence[Mapping[str, float]] = (),
) -> None:
    """Write the folder of a run.

    Args:
        folder: of the run.
        solved: whether the episode of a task and number is a success.
        seed: of the run.
        settings: of its experiment, by section, where they are not the default.
        protocol: of its episodes.
        tasks: of both splits.
        episodes: of each.
        first_seed: of the environment.
        best: score of an episode, which counts where it is more than one.
        metrics: of each iteration from the first.
    """
    folder.mkdir(parents=True, exist_ok=True)
    config = ExperimentConfig.model_validate({"seed": seed, **settings})
    manifest = Manifest(
        iteration=len(metrics), loss=None, config=config, shapes={"one": (1,)}, data={}, versions={}, mlflow_run_id=None
    )
    state = OuterState.start(np.zeros(1, np.float32))._replace(iteration=len(metrics))
    checkpoint = Checkpoint(Checkpoints(folder / "checkpoints", 1).save(state, {}, manifest))
    common = {
        "suite": config.suite.name, "protocol": protocol, "method": config.method.name, "draw": 0, "support": ("d",),
        "checkpoint": checkpoint.digest, "data": "s", "fine_tuning_steps": 1, "learning_rate": 0.1, "versions": {},
    }  # fmt: skip
    found: list[EpisodeResult] = []
    adaptations: list[AdaptationResult] = []
    for split in SPLITS:
        for task in tasks:
            row = {**common, "split": split, "task": task, "shots": 1}
            for number in range(episodes):
                success = solved(task, number)
                own = {"episode": number, "seed": first_seed + 100 * seed + number, "goal": (), "success": success}
                own |= {"score": best * success, "steps": 3, "sub_skill_steps": (3,)}
                found.append(EpisodeResult.model_validate({**row, **own}))
            use = {"steps": 100, "agreeing": 5, "sub_skill_steps": (60, 40, 0)}
            adaptations.append(AdaptationResult.model_validate({**row, **use}))
    write_rows(folder / "episodes.jsonl", found)
    write_rows(folder / "adaptations.jsonl", adaptations)
    evaluation = Evaluation(checkpoint, protocol, best, {}, {}, found, adaptations)
    write_summary(summarise(evaluation, seconds={}, folder=folder), folder)
    records = [["metrics", {"step": i, "time": 0, "values": dict(own)}] for i, own in enumerate(metrics, 1)]
    (folder / "tracking.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
