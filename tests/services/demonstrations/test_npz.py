"""Demonstrations in npz files: read as numpy wrote them, refused by name, and never unpacked when they are bombs."""

import io
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dmil_core.demonstrations import Demonstration, DemonstrationError
from services.demonstrations.npz import read_arrays

KITCHEN = Path(__file__).parents[3].parent / "shared" / "data" / "kitchen"
Arrays = dict[str, np.ndarray]


def read_npz(path: Path) -> list[Demonstration]:
    """Read demonstrations, as learning has them: real numbers only."""
    try:
        return [Demonstration(f"{index:03d}", "kettle", *arrays) for index, arrays in enumerate(read_arrays(path))]
    except DemonstrationError as error:
        raise DemonstrationError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error


@pytest.fixture
def arrays() -> Arrays:
    draw = np.random.default_rng(0)
    return {
        "observations": draw.normal(size=(9, 6)).astype(np.float32),
        "actions": draw.uniform(-1, 1, (9, 2)).astype(np.float32),
        "episode_lengths": np.array([4, 1, 4]),
        "tasks": np.array(["microwave", "kettle"]),
    }


@pytest.fixture
def write(tmp_path: Path) -> Callable[[Arrays], Path]:
    def save(arrays: Arrays) -> Path:
        path = tmp_path / "demonstrations.npz"
        np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
        return path

    return save


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_what_numpy_wrote_is_read(tmp_path: Path, arrays: Arrays, save, dtype):
    arrays["observations"] = np.asfortranarray(arrays["observations"].astype(dtype))
    path = tmp_path / "demonstrations.npz"
    save(path, **arrays)
    found = read_npz(path)
    assert [(d.id, d.task, len(d)) for d in found] == [("000", "kettle", 4), ("001", "kettle", 1), ("002", "kettle", 4)]
    for demonstration, steps in zip(found, (slice(0, 4), slice(4, 5), slice(5, 9)), strict=True):
        assert np.array_equal(demonstration.observations, arrays["observations"][steps].astype(np.float32))
        assert np.array_equal(demonstration.actions, arrays["actions"][steps])
        assert demonstration.observations.dtype == np.float32


def test_names_of_tasks_may_be_missing(write, arrays: Arrays):
    del arrays["tasks"]
    assert len(read_npz(write(arrays))) == 3


@pytest.mark.skipif(not KITCHEN.is_dir(), reason="the recorded kitchen demonstrations are not here")
@pytest.mark.parametrize(("number", "episodes"), [(0, 20), (1, 24)])
def test_recorded_demonstrations_are_read(number: int, episodes: int):
    path = sorted(KITCHEN.glob("*.npz"))[number]
    found = read_npz(path)
    with np.load(path, allow_pickle=False) as recorded:
        assert np.array_equal(np.concatenate([d.observations for d in found]), recorded["observations"])
        assert np.array_equal(np.concatenate([d.actions for d in found]), recorded["actions"])
        assert [len(demonstration) for demonstration in found] == recorded["episode_lengths"].tolist()
    assert len(found) == episodes


def test_an_observation_after_the_last_action_of_each_is_left_out(write, arrays: Arrays):
    alike = read_npz(write(arrays))
    arrays["observations"] = np.insert(arrays["observations"], [4, 5, 9], 7, axis=0)
    assert [d.observations.tobytes() for d in read_npz(write(arrays))] == [d.observations.tobytes() for d in alike]


def changed(name: str, array: object) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.update({name: np.asarray(array)})


def with_value(name: str, value: float) -> Callable[[Arrays], None]:
    return lambda arrays: arrays[name].__setitem__((4, 1), value)


MISTAKES: dict[str, tuple[Callable[[Arrays], object], str]] = {
    "NaN in a state": (with_value("observations", np.nan), "demonstration 001 of kettle: observations at step 0"),
    "infinite action": (with_value("actions", -np.inf), "demonstration 001 of kettle: actions at step 0"),
    "beyond float32": (changed("observations", np.full((9, 6), 1e300)), "observations at step 0 is not finite"),
    "one axis": (
        changed("actions", np.zeros(9)),
        "actions: got float64 of the shape (9,); wanted floating-point numbers along",
    ),
    "three axes": (
        changed("observations", np.zeros((9, 2, 3))),
        "got observations of the shape (9, 2, 3) and actions of",
    ),
    "integers": (changed("actions", np.zeros((9, 2), int)), "actions: got int64"),
    "big-endian": (changed("actions", np.zeros((9, 2), ">f4")), "actions: got the byte order of >f4"),
    "complex": (changed("actions", np.zeros((9, 2), complex)), "actions: got complex128"),
    "fewer actions": (changed("actions", np.zeros((8, 2))), "episode_lengths: got [4, 1, 4] for 9 observations and 8"),
    "an empty demonstration": (changed("episode_lengths", [4, 0, 5]), "episode_lengths: got [4, 0, 5]"),
    "a negative length": (changed("episode_lengths", [10, -1]), "episode_lengths: got [10, -1]"),
    "lengths that overflow": (changed("episode_lengths", [2**62] * 4 + [9]), "episode_lengths: got [46"),
    "names that are no text": (
        changed("tasks", [1, 2]),
        "tasks: got int64 of the shape (2,); wanted text along 1 axis",
    ),
    "no demonstration": (changed("episode_lengths", np.zeros(0, int)), "episode_lengths: got []"),
    "lengths that are no counts": (changed("episode_lengths", [4.0, 5.0]), "episode_lengths: got float64"),
    "nothing in it": (lambda arrays: arrays.clear(), "got the members []"),
    "no actions": (lambda arrays: arrays.pop("actions"), "wanted actions.npy"),
    "one array too many": (changed("goals", np.zeros(3)), "goals.npy"),
    "a name that leads out": (changed("../goals", np.zeros(3)), "../goals.npy"),
}


@pytest.mark.parametrize(("change", "words"), MISTAKES.values(), ids=MISTAKES)
def test_what_cannot_be_learned_from_is_refused_by_name(write, arrays: Arrays, change, words: str):
    change(arrays)
    path = write(arrays)
    with pytest.raises(DemonstrationError) as error:
        read_npz(path)
    assert str(error.value).startswith(f"{path}: ")
    assert words in str(error.value)


def test_pickled_objects_are_never_loaded(tmp_path: Path, arrays: Arrays):
    path = tmp_path / "demonstrations.npz"
    np.savez(path, **arrays | {"actions": np.array([[print]], object)})  # type: ignore[arg-type]
    with pytest.raises(DemonstrationError, match=r"actions: got object of the shape"):
        read_npz(path)


def bomb(megabytes: int) -> bytes:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f4", "fortran_order": False, "shape": (megabytes * 250_000, 1)}
    )
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("observations.npy", "w") as member:
            member.write(header.getvalue())
            for _ in range(megabytes):
                member.write(bytes(10**6))
        for name in ("actions", "episode_lengths"):
            archive.writestr(f"{name}.npy", b"")
    return file.getvalue()


def as_declared(content: bytes, size: int) -> bytes:
    """Have the directory say that the first member has another size."""
    place = content.index(b"PK\x01\x02") + 24
    return content[:place] + size.to_bytes(4, "little") + content[place + 4 :]


@pytest.mark.parametrize("declared", [None, 128, 2**32 - 2])
def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, declared: int | None):
    path = tmp_path / "bomb.npz"
    content = bomb(100)
    path.write_bytes(content if declared is None else as_declared(content, declared))
    tracemalloc.start()
    try:
        with pytest.raises(DemonstrationError, match=r"bomb.npz: .*(packed into|BadZipFile|bytes for)"):
            read_npz(path)
        assert tracemalloc.get_traced_memory()[1] < 2 * 10**7
    finally:
        tracemalloc.stop()


def test_a_directory_of_a_million_members_is_not_read(tmp_path: Path):
    path = tmp_path / "many.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(200):
            archive.writestr(f"{number}.npy", b"")
    with pytest.raises(DemonstrationError, match=r"many.npz: got no archive of a few arrays"):
        read_npz(path)


@pytest.mark.parametrize(
    "content", [b"", b"PK", b"PK\x05\x06" + bytes(18), bytes(5000)], ids=["none", "PK", "end", "0"]
)
def test_what_is_no_archive_is_refused(tmp_path: Path, content: bytes):
    path = tmp_path / "some.npz"
    path.write_bytes(content)
    with pytest.raises(DemonstrationError, match=r"some.npz: got"):
        read_npz(path)


@pytest.mark.parametrize("path", ["/dev/zero", "nowhere.npz", "."])
def test_a_path_that_is_no_file_is_refused(path: str):
    with pytest.raises(DemonstrationError, match=r": got .*; wanted an npz file"):
        read_npz(Path(path))
