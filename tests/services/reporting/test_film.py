"""Films say which sub-skill acts, how far it is and how it ended; the pictures in these are a plain grey."""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image, ImageSequence

from services.cli.colours import colour_of
from services.reporting.film import (
    BORDER,
    FAILED,
    FORMS,
    LAST_PICTURE_SECONDS,
    SOLVED,
    Side,
    compose,
    video_settings,
    write_film,
)
from services.rollouts.recording import Frame

HEIGHT, WIDTH = 60, 200
SUB_SKILLS = [0, 0, 2, 2, 2, 1]


def made_up(success: bool = True, sub_skills: list[int] | None = SUB_SKILLS) -> Side:
    grey = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    steps = len(SUB_SKILLS)
    frames = [Frame(step, grey) for step in range(steps + 1)]
    return Side("reach, 1-shot, episode 3", frames, steps, sub_skills, success, "in 6 steps")


def rgb(colour: str) -> tuple[int, ...]:
    return tuple(round(255 * part) for part in to_rgb(colour))


def border_of(picture: np.ndarray) -> tuple[int, ...]:
    """Return the colour left of the camera's picture, at half its height."""
    return tuple(picture[-HEIGHT // 2 - 20, BORDER // 2].tolist())


def test_the_border_has_the_colour_of_the_sub_skill_that_acted():
    pictures = list(compose([made_up()], rate=10))[: len(SUB_SKILLS) + 1]
    acted = [SUB_SKILLS[0], *SUB_SKILLS]
    assert [border_of(picture) for picture in pictures] == [rgb(colour_of(k)) for k in acted]
    assert pictures[0].dtype == np.uint8


def test_without_sub_skills_the_border_is_none_of_their_colours():
    colours = {border_of(picture) for picture in compose([made_up(sub_skills=None)], rate=10)}
    assert len(colours) == 1
    assert colours.isdisjoint(rgb(colour_of(k)) for k in range(10))


def test_the_strip_below_holds_all_sub_skills_so_far():
    pictures = list(compose([made_up()], rate=10))
    width = pictures[0].shape[1]
    middles = [round(width * (step + 0.5) / len(SUB_SKILLS)) for step in range(len(SUB_SKILLS))]
    seen = [[tuple(picture[-3, middle].tolist()) for middle in middles] for picture in pictures]
    wanted = [rgb(colour_of(k)) for k in SUB_SKILLS]
    assert seen[-1] == wanted
    assert seen[3][:3] == wanted[:3]
    assert set(seen[3][3:]).isdisjoint(wanted)


@pytest.mark.parametrize(("success", "band"), [(True, SOLVED), (False, FAILED)])
def test_the_last_picture_says_whether_it_was_solved_and_stays(success: bool, band: str):
    pictures = list(compose([made_up(success)], rate=10))
    held = int(LAST_PICTURE_SECONDS * 10)
    assert len(pictures) == len(SUB_SKILLS) + held
    marked = [(picture == rgb(band)).all(axis=2).any() for picture in pictures]
    assert marked == [False] * len(SUB_SKILLS) + [True] * held
    assert all(np.array_equal(picture, pictures[-1]) for picture in pictures[-held:])


def test_sides_stand_beside_each_other_and_the_shorter_one_waits():
    one, short = made_up(), made_up()
    short = short._replace(frames=short.frames[:3], steps=2, sub_skills=[1, 1])
    (alone,) = {picture.shape for picture in compose([one], 10)}
    pictures = list(compose([one, short], 10))
    (both,) = {picture.shape for picture in pictures}
    assert both[0] == alone[0]
    assert both[1] >= 2 * alone[1]
    assert [size % 2 for size in both[:2]] == [0, 0], "as H.264 wants it"
    right = [picture[:, alone[1] :] for picture in pictures]
    assert all(np.array_equal(picture, right[2]) for picture in right[2:])


def test_long_episodes_are_sped_up_and_short_ones_are_not():
    for form in FORMS.values():
        assert video_settings("corner2", 20, form).every == 1
        every = video_settings("corner2", 500, form).every
        assert every > 1
        assert 500 / every / form.rate <= 7.5


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # imageio leaves ffmpeg's pipes to the collector
def test_a_film_is_an_mp4_or_a_gif_with_all_its_pictures(tmp_path: Path):
    for name, form in FORMS.items():
        path = tmp_path / "made" / f"film.{name}"
        write_film(path, [made_up()])
        pictures = list(compose([made_up()], form.rate))
        height, width, _ = pictures[0].shape
        if name == "mp4":
            metadata, shown = imageio.immeta(path, plugin="FFMPEG"), imageio.imread(path, plugin="FFMPEG")
            assert (metadata["codec"], metadata["fps"], metadata["size"]) == ("h264", form.rate, (width, height))
            assert metadata["pix_fmt"].startswith("yuv420p")
            assert len(shown) == len(pictures)
            difference = np.subtract(border_of(shown[4]), rgb(colour_of(SUB_SKILLS[3])))
            assert np.abs(difference).max() < 30, "but for the compression"
        else:
            with Image.open(path) as film:
                assert film.size == (width, height)
                lasted = [frame.info["duration"] for frame in ImageSequence.Iterator(film)]
            assert sum(lasted) == len(pictures) * 1000 // form.rate, "equal pictures may have become one that lasts"
