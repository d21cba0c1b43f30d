"""A picture of a suite: each task as its expert solves it."""

from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from dmil_core.configs import DemonstrationConfig
from dmil_core.files import write_file
from services.cli.progress import Bar
from services.rollouts.episodes import demonstrate
from services.suites.base import TaskSuite
from services.suites.rendering import View, picture

HEIGHT, WIDTH = 180, 240
MOMENT = 0.6
"""Each picture is taken after this part of the steps that the expert takes to solve the task."""


def draw_gallery(suite: TaskSuite, camera: str | View, seed: int, path: Path, columns: int) -> None:
    """Draw all tasks of a suite in a grid; those of meta-testing are marked.

    Raises:
        RenderingError: if there is nothing here to draw with.
    """
    tasks = list(dict.fromkeys((*suite.train_tasks, *suite.test_tasks)))
    rows = -(-len(tasks) // columns)
    figure = Figure((2 * columns, 1.75 * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axis in axes:
        axis.set_axis_off()
    with Bar(f"drawing {suite.name}", len(tasks)) as bar:
        for axis, task in zip(axes, tasks, strict=False):
            axis.imshow(_at_work(suite, camera, task, seed))
            tested = task in suite.test_tasks
            title = _in_lines(task) + "\n(meta-testing)" * tested
            axis.set_title(title, fontsize=7, fontweight="bold" if tested else "normal")
            bar.advance(1, task)
    figure.savefig(content := BytesIO(), dpi=110, pil_kwargs={"quality": 85}, format=path.suffix[1:])
    write_file(path.parent, path.name, content.getvalue())


def _in_lines(task: str) -> str:
    """Return a task's name on two lines if it is a long one."""
    words = task.split("-")
    half = (len(words) + 1) // 2
    return task if len(task) <= 24 else "-".join(words[:half]) + "-\n" + "-".join(words[half:])


def _at_work(suite: TaskSuite, camera: str | View, task: str, seed: int) -> UInt8[np.ndarray, "height width 3"]:
    env, expert = suite.make_env(task), suite.expert(task)
    if expert is None:
        env.reset(seed=seed)
    else:
        config = DemonstrationConfig(noise=0, trailing_steps=0)
        attempt = demonstrate(expert, env, seed, suite.horizon, config)
        env.reset(seed=seed)
        for action in attempt.actions[: int(MOMENT * len(attempt.actions))]:
            env.step(action)
    image = picture(env, camera, HEIGHT, WIDTH)
    env.close()
    return image
