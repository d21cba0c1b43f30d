"""Demonstrations as other tools lay them out are read alike, and what is of no such layout is named."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from dmil_core.demonstrations import DemonstrationError
from services.demonstrations.external import places_of, read_episodes

DRAW = np.random.default_rng(0)
EPISODES = [(DRAW.normal(size=(6, 5)), DRAW.uniform(-1, 1, (6, 2))) for _ in range(3)]
OBSERVATIONS, ACTIONS = (np.concatenate(parts) for parts in zip(*EPISODES, strict=True))
STACKED = [np.stack(parts) for parts in zip(*EPISODES, strict=True)]


def robomimic(folder: Path, *, pictures: bool = False) -> str:
    with h5py.File(folder / "low_dim.hdf5", "w") as file:
        for index in (2, 0, 1):
            observations, actions = EPISODES[index]
            demo = file.create_group(f"data/demo_{index}")
            demo["actions"] = actions
            demo["obs/object"], demo["obs/eef"], demo["obs/gripper"] = np.split(observations, [2, 4], axis=1)
            if pictures:
                demo["obs/agentview_image"] = np.zeros((6, 4, 4, 3), np.uint8)
    return f"hdf5:{folder / 'low_dim.hdf5'}#object+eef+gripper"


def robomimic_of_ten(folder: Path) -> str:
    with h5py.File(folder / "ten.hdf5", "w") as file:
        for index in range(11):
            file[f"data/demo_{index}/actions"] = EPISODES[index % 3][1]
            file[f"data/demo_{index}/obs/state"] = EPISODES[index % 3][0] if index < 3 else np.zeros((6, 5))
    return f"hdf5:{folder / 'ten.hdf5'}"


def pair(folder: Path, *, stacked: bool = True) -> str:
    for name, values in zip(("o", "a"), STACKED, strict=True):
        np.save(folder / f"{name}.npy", values if stacked else values[0])
    return f"npy:{folder / 'o.npy'}+{folder / 'a.npy'}"


def stacked(folder: Path) -> str:
    np.savez(folder / "stacked.npz", observations=STACKED[0], actions=STACKED[1])
    return f"npz:{folder / 'stacked.npz'}"


def folder_of_episodes(folder: Path) -> str:
    (folder / "episodes").mkdir()
    for index, (observations, actions) in enumerate(EPISODES):
        last = np.concatenate([observations, observations[:1]])
        np.savez(folder / "episodes" / f"{index}.npz", observations=last, actions=actions)
    return f"npz:{folder / 'episodes'}"


def lerobot(folder: Path, names: tuple[str, str] = ("observation.state", "action")) -> str:
    for chunk, numbers in enumerate(([0, 1], [1, 2])):  # an episode may go on in the next file
        rows = [(number, step) for number in numbers for step in range(6) if number != 1 or (step < 2) == (chunk == 0)]
        columns = {
            "episode_index": [number for number, _ in rows],
            names[0]: [EPISODES[number][0][step].tolist() for number, step in rows],
            names[1]: [EPISODES[number][1][step].tolist() for number, step in rows],
        }
        (folder / "set" / "data" / f"chunk-{chunk:03d}").mkdir(parents=True)
        pyarrow.parquet.write_table(pyarrow.table(columns), folder / f"set/data/chunk-{chunk:03d}/file-000.parquet")
    return f"lerobot:{folder / 'set'}"


@pytest.mark.parametrize("write", [robomimic, pair, stacked, folder_of_episodes, lerobot])
def test_each_layout_has_the_same_episodes(tmp_path: Path, write: Callable[[Path], str]):
    episodes = read_episodes(write(tmp_path))
    for episode, (observations, actions) in zip(episodes, EPISODES, strict=True):
        np.testing.assert_array_equal(episode.observations, observations.astype(np.float32))
        np.testing.assert_array_equal(episode.actions, actions.astype(np.float32))


def test_demos_are_in_the_order_of_their_numbers_and_keys_in_that_of_the_alphabet(tmp_path: Path):
    assert [bool(one.observations.any()) for one in read_episodes(robomimic_of_ten(tmp_path))] == [True] * 3 + [
        False
    ] * 8
    (first, *_) = read_episodes(robomimic(tmp_path).partition("#")[0])
    np.testing.assert_array_equal(first.observations, EPISODES[0][0][:, [2, 3, 4, 0, 1]].astype(np.float32))


def test_a_pair_may_be_one_episode_and_a_task_is_named_by_the_file(tmp_path: Path):
    (episode,) = read_episodes(pair(tmp_path, stacked=False))
    assert episode.actions.shape == (6, 2)
    names = {"npy:a/peg.npy+a/acts.npy": "peg", "hdf5:a/lift.hdf5#x+y": "lift", "lerobot:a/fold": "fold"}
    assert [list(places_of(source)) for source in names] == [[task] for task in names.values()]


def renamed(folder: Path) -> str:
    np.savez(folder / "a.npz", obs=OBSERVATIONS, acts=ACTIONS)
    return f"npz:{folder / 'a.npz'}"


def three_of_two(folder: Path) -> str:
    np.savez(folder / "b.npz", observations=STACKED[0], actions=STACKED[1][:2])
    return f"npz:{folder / 'b.npz'}"


def no_lengths(folder: Path) -> str:
    np.savez(folder / "c.npz", observations=OBSERVATIONS, actions=ACTIONS[:-4])
    return f"npz:{folder / 'c.npz'}"


def other_keys(folder: Path) -> str:
    with h5py.File(folder / "other.hdf5", "w") as file:
        file["states"] = OBSERVATIONS
    return f"hdf5:{folder / 'other.hdf5'}"


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (lambda at: robomimic(at, pictures=True).partition("#")[0], r"image \(pictures\); .*PATH#eef\+gripper\+object"),
        (lambda at: robomimic(at) + "+camera", r"data/demo_0/obs: got camera; wanted keys of vectors"),
        (lambda at: pair(at).partition("+")[0], "got 1 files; wanted two: npy:OBS"),
        (lambda at: lerobot(at, ("observation.image", "action")), r"wanted observation\.state too"),
        (lambda at: f"lerobot:{at}", "got no data/.*parquet in"),
        (lambda at: f"npz:{at}", r"got no \.npz file in it; it looks like a file"),
        (renamed, r'numpy.savez\("NEW.npz", observations=a\["obs"\], actions=a\["acts"\]\)'),
        (three_of_two, "got 3 stacked episodes of observations and 2 of actions"),
        (no_lengths, "got 18 observations for 14 actions; wanted .* episode_lengths too"),
        (other_keys, r"got \['states'\]; wanted observations, actions and terminals .* data/demo_0/obs"),
    ],
)  # fmt: skip
def test_what_is_of_no_such_layout_is_named(tmp_path: Path, write: Callable[[Path], str], says: str):
    with pytest.raises(DemonstrationError, match=says):
        read_episodes(write(tmp_path))


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("a.npz", r"got .*a\.npz; wanted npz:.*a\.npz"),
        ("a.pkl", "it looks like a pickle, which can run any code when it is read; save its arrays by numpy.savez"),
        ("a.parquet", "lerobot:FOLDER"),
        ("a.xyz", r"a file of the kind \.xyz"),
    ],
)
def test_a_file_without_its_form_is_answered_with_what_it_looks_like(tmp_path: Path, name: str, says: str):
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(DemonstrationError, match=says):
        places_of(str(tmp_path / name))
