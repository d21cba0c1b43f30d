"""Films of episodes: which sub-skill acts, how far it is and how it ended stands in the picture; as MP4 or GIF."""

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import imageio.v3 as imageio
import matplotlib
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from dmil_core.files import write_file
from dmil_core.trajectories import Rollout
from services.reporting.drawing import colour_of
from services.reporting.options import FormName
from services.rollouts.recording import Frame, VideoSettings
from services.suites.rendering import View

FONTS = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
PAPER, INK, FAINT, NO_SUB_SKILL = "#16181c", "#ffffff", "#b0b0b0", "#4a4d55"
SOLVED, FAILED = "#00684a", "#9a2a00"
BORDER = 6
"""Around a picture, in pixels."""
STRIP = 8
"""The height of the strip of all sub-skills so far."""
GAP = 10
"""Between two sides."""
LAST_PICTURE_SECONDS = 1.5
"""The last picture stays for so long."""
LONGEST_SECONDS = 7.5
"""Longer films are sped up, by leaving out steps."""


class Form(NamedTuple):
    """What a film is made as."""

    rate: int
    """Pictures a second."""
    height: int
    """Of the camera's picture, in pixels."""
    width: int


FORMS: dict[FormName, Form] = {"mp4": Form(20, 360, 480), "gif": Form(10, 240, 320)}


class Side(NamedTuple):
    """One of the episodes that a film shows beside each other."""

    title: str
    frames: Sequence[Frame]
    steps: int
    sub_skills: Sequence[int] | None
    """The one that acted at each step; none of an expert, or of a method that has but one."""
    success: bool
    ending: str
    """The text on the last picture."""

    def acting(self, step: int) -> int | None:
        """Return the sub-skill whose action led to the state after so many steps."""
        return self.sub_skills[max(step - 1, 0)] if self.sub_skills else None


def filmed(title: str, episode: Rollout, frames: Sequence[Frame], best_score: int, sub_skills: int) -> Side:
    """Return an episode of a policy with K sub-skills as a film shows it, in a suite whose `best_score` is known."""
    score = f": {episode.score} of {best_score} sub-tasks" if best_score > 1 else ""
    ending = f"{'solved' if episode.success else 'not solved'} in {len(episode)} steps{score}"
    acting = episode.sub_skills.tolist() if sub_skills > 1 else None
    return Side(title, frames, len(episode), acting, episode.success, ending)


def video_settings(view: str | View, steps: int, form: Form) -> VideoSettings:
    """Return how to film an episode of so many steps, so that it is no longer than it should be."""
    most = LONGEST_SECONDS * form.rate
    return VideoSettings(view, max(1, int(np.ceil(steps / most))), form.height, form.width)


def compose(sides: Sequence[Side], rate: int) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield the pictures of a film, of even height and width; a side that is at its end waits for the other."""
    length = max(len(side.frames) for side in sides)
    for time in range(length):
        panels = [_panel(side, time) for side in sides]
        whole = np.concatenate([part for panel in panels for part in (_gap(panel), panel)][1:], axis=1)
        height, width = (size + size % 2 for size in whole.shape[:2])
        picture = np.zeros((height, width, 3), np.uint8)
        picture[: whole.shape[0], : whole.shape[1]] = whole
        for _ in range(int(LAST_PICTURE_SECONDS * rate) if time == length - 1 else 1):
            yield picture


def _gap(beside: np.ndarray) -> np.ndarray:
    return np.zeros((len(beside), GAP, 3), np.uint8)


def _panel(side: Side, time: int) -> UInt8[np.ndarray, "height width 3"]:
    """Draw one side at a time: title, sub-skill and step above, the camera's picture with its border, the strip."""
    step, camera = side.frames[min(time, len(side.frames) - 1)]
    line = 20 if camera.shape[0] > 300 else 15
    top = 2 * line + 8
    width, height = camera.shape[1] + 2 * BORDER, top + camera.shape[0] + 2 * BORDER + STRIP
    sub_skill = side.acting(step)
    colour = NO_SUB_SKILL if sub_skill is None else colour_of(sub_skill)
    panel = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(panel)
    draw.text((BORDER, 2), side.title, INK, _fitting(side.title, line - 4, width - 2 * BORDER))
    counted = f"step {step} of {side.steps}"
    font = _font("DejaVuSans.ttf", line - 5)
    draw.text((width - BORDER - font.getlength(counted), 4 + line), counted, FAINT, font)
    if sub_skill is not None:
        draw.rectangle((BORDER, 6 + line, BORDER + line - 6, 2 * line), colour)
        draw.text((BORDER + line, 4 + line), f"sub-skill {sub_skill}", INK, _font("DejaVuSans-Bold.ttf", line - 5))
    draw.rectangle((0, top, width, height - STRIP - 1), colour)
    panel.paste(Image.fromarray(camera), (BORDER, top + BORDER))
    for done in range(step):
        acted = side.acting(done + 1)
        ends = [round(width * position / side.steps) for position in (done, done + 1)]
        shade = FAINT if acted is None else colour_of(acted)
        draw.rectangle((ends[0], height - STRIP + 2, max(ends[0], ends[1] - 1), height - 1), shade)
    if time >= len(side.frames) - 1:
        _mark_end(draw, side, (width, height - STRIP - BORDER), line)
    return np.asarray(panel)


def _mark_end(draw: ImageDraw.ImageDraw, side: Side, corner: tuple[int, int], line: int) -> None:
    """Say how it ended, on a band along the lower edge of the picture."""
    width, bottom = corner
    text = f"{'✓' if side.success else '✗'} {side.ending}"
    font = _fitting(text, line, width - 4 * BORDER)
    band = (BORDER, bottom - int(1.8 * line), width - BORDER - 1, bottom - 1)
    draw.rectangle(band, SOLVED if side.success else FAILED)
    draw.text((width / 2, (band[1] + band[3]) / 2), text, INK, font, anchor="mm")


def _fitting(text: str, size: int, width: float) -> ImageFont.FreeTypeFont:
    """Return the bold font of `size`, or a smaller one in which the text is no wider than `width`."""
    sizes = range(size, 6, -1)
    return next(
        (font for font in (_font("DejaVuSans-Bold.ttf", each) for each in sizes) if font.getlength(text) <= width),
        _font("DejaVuSans-Bold.ttf", 6),
    )


@cache
def _font(name: str, size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(FONTS / name), size)


def write_film(path: Path, sides: Sequence[Side]) -> None:
    """Write a film, by its suffix: MP4 (H.264, yuv420p), which all browsers play, or GIF.

    Raises:
        DiskFullError: for want of space; the file is then what it was.
    """
    form: FormName = "gif" if path.suffix == ".gif" else "mp4"
    rate = FORMS[form].rate
    with TemporaryDirectory() as folder:
        made = Path(folder) / path.name
        if form == "gif":
            _write_gif(made, compose(sides, rate), rate)
        else:
            imageio.imwrite(
                made, np.stack(list(compose(sides, rate))), plugin="FFMPEG", fps=rate, codec="libx264",
                pixelformat="yuv420p", macro_block_size=2, quality=None, ffmpeg_log_level="error",
                output_params=["-crf", "27", "-preset", "slow", "-movflags", "+faststart"],
            )  # fmt: skip
        write_file(path.parent, path.name, made.read_bytes())


def _write_gif(path: Path, pictures: Iterator[np.ndarray], rate: int) -> None:
    """Write all pictures in the colours of those at the beginning, in the middle and at the end."""
    images = [Image.fromarray(picture) for picture in pictures]
    chosen = [np.asarray(images[index]) for index in (0, len(images) // 2, len(images) - 1)]
    palette = Image.fromarray(np.concatenate(chosen)).quantize(128, method=Image.Quantize.MEDIANCUT)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    first.save(path, save_all=True, append_images=others, duration=1000 // rate, loop=0, optimize=True)
