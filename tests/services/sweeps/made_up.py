"""Sweeps whose rows are made up, so that every figure in them is known."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from dmil_core.settings import sub_skills_of
from services.evaluation.results import AdaptationResult, EpisodeResult, write_rows
from services.sweeps.folders import SweepFolder, SweepRecord, TrialResult
from services.sweeps.settings import Sweep

ROW = {
    "suite": "ml10", "protocol": "p", "method": "dmil", "checkpoint": "c", "draw": 0, "support": ("d",), "data": "s",
    "fine_tuning_steps": 1, "learning_rate": 0.1, "versions": {},
}  # fmt: skip
EPISODES = 20
TASKS = ("reach", "push")

Solved = Callable[[str, int, str, int, str, int], float]
"""What an episode of variant, seed, split, shots, task and number comes to."""


def make(runs: Path, solved: Solved, finished: Sequence[str] = (), **changes: object) -> SweepFolder:
    """Write a sweep's folder with trials as if they had run; `finished` names their variants, all if there are none."""
    settings = {
        "what": "a test", "suites": ["ml10"], "seeds": [0, 1, 2], "variants": {"DMIL": {}, "DMIL-High": {}},
        "paper": "table4", **changes,
    }  # fmt: skip
    return make_of(runs, Sweep.model_validate(settings), solved, finished)


def make_of(runs: Path, settings: Sweep, solved: Solved, finished: Sequence[str] = ()) -> SweepFolder:
    """Write the folder of a sweep at preset quick, with trials as if they had run."""
    record = SweepRecord(
        name="made-up", preset="quick", sweep=settings, began=datetime(2026, 1, 2, tzinfo=UTC),
        command="python -m services.tune_sweep made-up", commit="abc", versions={},
    )  # fmt: skip
    sweep = SweepFolder.make(runs / "made-up", record)
    for number, (name, trial) in enumerate(sweep.trials.items()):
        if finished and trial.variant not in finished:
            continue
        sub_skills = sub_skills_of(trial.config.method)
        folder = runs / "trained" / str(number) / "evaluated" / "one"
        folder.mkdir(parents=True)
        episodes, adaptations = [], []
        for split in ("meta-training", "meta-testing"):
            for shots in (1, 3):
                for task in TASKS:
                    common = {**ROW, "split": split, "shots": shots, "task": task}
                    for episode in range(EPISODES):
                        value = solved(trial.variant, trial.seed, split, shots, task, episode)
                        episodes.append(
                            EpisodeResult.model_validate(
                                {**common, "episode": episode, "seed": episode, "goal": (), "success": value > 0}
                                | {"score": int(value), "steps": 3, "sub_skill_steps": (3,)}
                            )
                        )
                    most = (60, 40) if shots == 1 else (97, 3)
                    steps = (*most, *[0] * (sub_skills - 2)) if sub_skills > 1 else (100,)
                    use = {"steps": 100, "agreeing": 5, "sub_skill_steps": steps}
                    adaptations.append(AdaptationResult.model_validate({**common, **use}))
        write_rows(folder / "episodes.jsonl", episodes)
        write_rows(folder / "adaptations.jsonl", adaptations)
        (sweep.of_trial(name)).mkdir(parents=True)
        paths = dict.fromkeys(trial.evaluations, str(folder.relative_to(runs)))
        sweep.finish(name, TrialResult(status="finished", trained=str(number), evaluated=paths, seconds={"total": 2.0}))
    return sweep


def better(variant: str, seed: int, split: str, shots: int, task: str, episode: int) -> float:
    """DMIL solves 15 to 17 of 20 by its seed; DMIL-High two fewer in meta-testing, as many in meta-training."""
    lost = 2 if variant == "DMIL-High" and split == "meta-testing" else 0
    return float(episode < 15 + seed - lost)
