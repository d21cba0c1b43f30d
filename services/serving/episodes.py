"""An episode of a policy in a built-in suite, filmed where the machine can draw."""

import base64
import tempfile
from pathlib import Path
from typing import Any

import torch

from dmil_core.configs import SuiteConfig
from dmil_core.files import read_file
from dmil_core.seeding import named_seed
from dmil_core.settings import sub_skills_of
from services.reporting.film import FORMS, filmed, video_settings, write_film
from services.rollouts.recording import record_rollouts
from services.serving.packing import unpacked
from services.suites.base import build_env
from services.suites.registry import open_suite
from services.suites.rendering import RenderingError

MOST_BYTES = 2**26
"""Of a film."""


def played(content: bytes, suite: SuiteConfig, task: str, episode: int, seed: int) -> dict[str, Any]:
    """Let a policy, as `packed` makes it, act in an episode of its model's run; a process of its own can do that.

    The episode is named as in an evaluation, by the run's seed, the task and its number.

    Returns:
        The fields of `bodies.Episode`; the film is MP4 in base64, or none, with a note why.
    """
    torch.set_num_threads(1)
    policy, opened = unpacked(content), open_suite(suite)
    seeds, note = [named_seed(seed, "evaluation", task, episode)], None
    camera = getattr(opened, "camera", None)
    films = {} if camera is None else {0: video_settings(camera, opened.horizon, FORMS["mp4"])}
    try:
        [(rollout, recording)] = record_rollouts(policy.policy, [build_env(opened, task)], seeds, opened.horizon, films)
    except RenderingError as error:
        note = str(error)
        [(rollout, recording)] = record_rollouts(policy.policy, [build_env(opened, task)], seeds, opened.horizon, {})
    sub_skills = rollout.sub_skills.tolist()
    answer = {"success": rollout.success, "steps": len(rollout), "sub_skills": sub_skills, "video": None, "note": note}
    if recording.frames:
        count = sub_skills_of(policy.origin.model.config.method)
        side = filmed(f"{task}, episode {episode}", rollout, recording.frames, opened.best_score, count)
        with tempfile.TemporaryDirectory() as made:
            write_film(Path(made) / "film.mp4", [side])
            answer["video"] = base64.b64encode(read_file(Path(made), "film.mp4", MOST_BYTES)).decode()
    return answer
