"""Other people's data sets: read as they are, split where their episodes end, refused in words."""

import json
from collections.abc import Callable
from pathlib import Path

import gymnasium
import h5py
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer

from dmil_core.configs import SuiteConfig
from dmil_core.demonstrations import DemonstrationError
from services.demonstrations.external import demonstrations, places_of, read_episodes
from services.suites.registry import open_suite

LENGTHS = (4, 7, 5)
DRAW = np.random.default_rng(0)
EPISODES = [
    (DRAW.normal(size=(length, 60)).astype(np.float32), DRAW.uniform(-1, 1, (length, 9)).astype(np.float32))
    for length in LENGTHS
]
OBSERVATIONS, ACTIONS = (np.concatenate(parts) for parts in zip(*EPISODES, strict=True))
KITCHEN = open_suite(SuiteConfig(name="kitchen"))


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("DMIL_DATA", str(tmp_path / "data"))
    return tmp_path


def hdf5(path: Path, **arrays: np.ndarray) -> str:
    marks = np.zeros(len(ACTIONS), bool)
    marks[np.cumsum(LENGTHS)[:-1] - 1] = True
    last = np.zeros(len(ACTIONS), np.uint8)
    last[-1] = 1
    given = {"observations": OBSERVATIONS, "actions": ACTIONS, "terminals": marks, "timeouts": last}
    with h5py.File(path, "w") as file:
        for name, array in {**given, "rewards": np.ones(len(ACTIONS), np.float32), **arrays}.items():
            file[name] = array
    return f"hdf5:{path}"


def npz(path: Path) -> str:
    np.savez(path, observations=OBSERVATIONS, actions=ACTIONS, episode_lengths=np.array(LENGTHS))
    return f"npz:{path}"


def minari_set(dataset_id: str, *, nested: bool = False) -> str:
    def seen(observations: np.ndarray) -> dict[str, object] | np.ndarray:
        whole = np.concatenate((observations, observations[-1:]))
        if not nested:
            return whole
        return {"z": whole[:, 40:], "a": {"inner": whole[:, 1:40], "b": whole[:, :1]}}

    def box(size: int) -> gymnasium.spaces.Box:
        return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)

    space = gymnasium.spaces.Dict(
        {"z": box(20), "a": gymnasium.spaces.Dict({"inner": box(39), "b": box(1)})}
    )  # fmt: skip
    buffers = [
        EpisodeBuffer(
            observations=seen(observations),  # type: ignore[arg-type]
            actions=actions,  # type: ignore[arg-type]
            rewards=[1.0] * len(actions),
            terminations=[False] * len(actions),
            truncations=[False] * (len(actions) - 1) + [True],
            infos={"is_success" if nested else "success": np.array([False] * len(actions) + [index == 1])},
        )
        for index, (observations, actions) in enumerate(EPISODES)
    ]
    minari.create_dataset_from_buffers(
        dataset_id, buffers, observation_space=space if nested else box(60), action_space=box(9)
    )
    return f"minari:{dataset_id}"


MAKERS: dict[str, Callable[[Path], str]] = {
    "hdf5": lambda root: hdf5(root / "slide.hdf5"),
    "npz": lambda root: npz(root / "slide.npz"),
    "minari": lambda root: minari_set("kitchen/slide-v2"),
    "dictionaries": lambda root: minari_set("kitchen/slide-v2", nested=True),
}


@pytest.mark.filterwarnings("ignore::UserWarning")  # Minari would like to know the author, the code and the algorithm
@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_the_episodes_are_those_that_were_recorded(root: Path, make: Callable[[Path], str]):
    place = make(root)
    found = read_episodes(place)
    assert len(found) == len(EPISODES)
    for episode, (observations, actions) in zip(found, EPISODES, strict=True):
        assert np.array_equal(episode.actions, actions)
        assert np.array_equal(episode.observations, observations)
    assert {episode.reward for episode in found} == ({None} if place.startswith("npz") else set(map(float, LENGTHS)))
    assert [episode.success for episode in found] == (
        [False, True, False] if place.startswith("minari") else [None] * 3
    )
    learned = demonstrations("slide", place, KITCHEN, most=2)
    assert [one.id for one in learned.demonstrations] == ["000", "001"]
    assert np.array_equal(learned.demonstrations[1].observations, EPISODES[1][0][:, :30])
    assert places_of(place) == {"slide": place}


def test_each_data_set_is_that_of_one_task():
    assert places_of("minari:D4RL/kitchen/complete-v2,push=mine/poke-v0") == {
        "complete": "minari:D4RL/kitchen/complete-v2",
        "push": "minari:mine/poke-v0",
    }
    assert places_of("npz:a/slide.npz,hinge=b/c.npz") == {"slide": "npz:a/slide.npz", "hinge": "npz:b/c.npz"}
    with pytest.raises(DemonstrationError, match=r"got the task a twice; .* a comma in a path is written \\,"):
        places_of("npz:a.npz,b/a.npz")
    for source in ("experts", "npz:", "npz:a.npz,", "csv:a.csv"):
        with pytest.raises(
            DemonstrationError, match=r"demonstrations\.source: got .*; wanted expert, or one of minari"
        ):
            places_of(source)


ODD = {
    "no such file": (lambda root: f"hdf5:{root / 'none.hdf5'}", "none.hdf5; wanted a data set"),
    "no such npz": (lambda root: f"npz:{root / 'none.npz'}", "No such file"),
    "no such id": (lambda root: "minari:no/such-v0", "minari download no/such-v0"),
    "elsewhere": (lambda root: "minari:../../etc", "lies outside"),
    "no HDF5": (lambda root: f"hdf5:{npz(root / 'a.npz')[4:]}", "OSError"),
    "unequal": (lambda root: hdf5(root / "a.hdf5", actions=ACTIONS[1:]), "16 observations and 15 actions"),
    "no ends": (
        lambda root: hdf5(root / "a.hdf5", terminals=np.zeros(16, bool), timeouts=np.zeros(16, bool)),
        "got neither terminals nor timeouts",
    ),
    "short ends": (lambda root: hdf5(root / "a.hdf5", terminals=np.zeros(3, bool)), "terminals: got 3 for 16 actions"),
    "wrong axes": (lambda root: hdf5(root / "a.hdf5", actions=ACTIONS[0]), "actions: got float32 of the shape (9,)"),
    "words": (lambda root: hdf5(root / "a.hdf5", rewards=np.array([b"x"] * 16)), "rewards: got |S1"),
}


@pytest.mark.parametrize(("make", "said"), ODD.values(), ids=ODD)
def test_what_cannot_be_read_is_reported_in_words(root: Path, make: Callable[[Path], str], said: str):
    place = make(root)
    with pytest.raises(DemonstrationError) as error:
        read_episodes(place)
    assert said in str(error.value)
    assert place.partition(":")[2] in str(error.value)


def test_what_does_not_fit_the_suite_is_reported_with_its_episode(root: Path):
    metaworld = open_suite(SuiteConfig())
    with pytest.raises(DemonstrationError, match=r"slide\.npz: episode 0: observations: got 60 numbers a step; ml10 w"):
        demonstrations("reach", npz(root / "slide.npz"), metaworld, 10)
    not_finite = OBSERVATIONS.copy()
    not_finite[5, 3] = np.nan
    place = hdf5(root / "a.hdf5", observations=not_finite)
    with pytest.raises(DemonstrationError, match=r"a\.hdf5: episode 1: .*observations at step 1 is not finite"):
        demonstrations("slide", place, KITCHEN, 10)
    assert len(demonstrations("slide", place, KITCHEN, 1).demonstrations) == 1, "what is not used may be spoilt"


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("entry_point", ["os:mkdir", "gymnasium.envs.registration:make", "nowhere:at_all"])
def test_what_a_minari_data_set_names_is_not_run(root: Path, entry_point: str):
    """With and without its spaces, for want of which Minari makes the environment."""
    place = minari_set("kitchen/slide-v2")
    metadata = root / "minari/kitchen/slide-v2/data/metadata.json"
    spec = {"id": "Seen-v0", "entry_point": entry_point, "kwargs": {"path": str(root / "made")}}
    for without in ((), ("observation_space", "action_space")):
        content = json.loads(metadata.read_text()) | {"env_spec": json.dumps(spec)}
        metadata.write_text(json.dumps({key: value for key, value in content.items() if key not in without}))
        assert len(read_episodes(place)) == len(EPISODES)
    assert not (root / "made").exists()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_private_file_is_not_read_as_observations(root: Path):
    place = minari_set("kitchen/slide-v2")
    (root / "secret").write_bytes(bytes(1000))
    with h5py.File(root / "minari/kitchen/slide-v2/data/main_data.hdf5", "a") as file:
        del file["episode_1/observations"]
        file.create_dataset("episode_1/observations", (8, 60), "u1", external=[(str(root / "secret"), 0, 480)])
    with pytest.raises(DemonstrationError, match="episode_1/observations: got numbers that lie in another file"):
        read_episodes(place)
