"""Input that says two things, or is of another type, is refused; a path and a name are text, whatever is in them."""

import json
import unicodedata
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

from dmil_core.adapted_policy import Source
from dmil_core.checkpoint import Manifest
from dmil_core.configs import ExperimentConfig
from dmil_core.errors import UserError
from dmil_core.methods.configs import OURS, config_type
from services import evaluate, inspect_demos, meta_train
from services.cli.arguments import parse, peek
from services.cli.composition import EARLY, config_from
from services.demonstrations.external import places_of
from services.demonstrations.store import data_root
from services.storage.run_folders import find_folder, new_name
from services.sweeps.settings import Sweep
from tests.faults.conftest import SHORT, TOY


def config_of(tmp_path: Path, text: str) -> ExperimentConfig:
    file = tmp_path / "settings.yaml"
    file.write_text(text)
    return config_from("smoke", file)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("method: {sub_skills: 2}\nseed: 1\nmethod: {sub_skills: 3}\n", "found the key method twice"),
        ("training:\n  iterations: 2\n  iterations: 2\n", "found the key iterations twice"),
        ("seed: on\n", "seed: got 'on'"),
        ("method: {continuity_weight: yes}\n", "continuity_weight: got 'yes'"),
        ("seed: 1:30\n", "seed: got '1:30'"),
        ("seed: 010\n", "seed: got '010'"),
        ("seed: 1_0\n", "seed: got '1_0'"),
        ('seed: "7"\n', "seed: got '7'"),
        ("seed: 2024-01-01\n", "seed: got '2024-01-01'"),
        ("seed: true\n", "seed: got True"),
        ("method: {continuity_weight: true}\n", "continuity_weight: got True"),
        ("suite: {goal_visible: 1}\n", "goal_visible: got 1"),
        ("suite: {goal_visible: no}\n", "goal_visible: got 'no'"),
        ("training: {iterations: 3.0}\n", "training.iterations: got 3.0"),
        ('method: {labels_until: "5"}\n', "labels_until: got '5'"),
        ('suite: {points: {size: "4", hand: [0, 1]}}\n', "suite.points.size: got '4'"),
        ("suite: {points: {size: 4, hand: [false, 1]}}\n", "suite.points.hand.0: got False"),
        ("<<: {seed: 3}\n", "unknown key <<"),
        ("evaluation: {shots: [1, 3, 1]}\n", "evaluation.shots: got [1, 3, 1]; wanted each once"),
        ("suite: {test_tasks: [push, push]}\n", "suite.test_tasks: got ['push', 'push']; wanted each once"),
    ],
)
def test_yaml_that_may_mean_something_else_is_refused(tmp_path: Path, text: str, words: str):
    with pytest.raises(UserError) as refused:
        config_of(tmp_path, text)
    assert words in str(refused.value)


def test_yaml_that_says_one_thing_is_taken(tmp_path: Path):
    config = config_of(
        tmp_path,
        "training: {learning_rate: 1e-3, gradient_clip: 5}\nmethod: {continuity_weight: .5}\nseed: 0x10\n"
        "demonstrations: {source: 'off'}\nsuite: {goal_visible: false}\n",
    )
    assert (config.training.learning_rate, config.training.gradient_clip) == (0.001, 5.0)
    assert (config.seed, config.suite.goal_visible, config.demonstrations.source) == (16, False, "off")


@dataclass(frozen=True)
class Numbers:
    """Arguments of a program."""

    whole: int | None = None
    real: float = 0.0
    several: tuple[int, ...] = ()


@pytest.mark.parametrize("flag", ["--whole", "--real", "--several"])
@pytest.mark.parametrize("text", ["010", "1_0", "١٢", " 3 ", "1:30", "true"])
def test_a_flag_refuses_what_is_no_number_in_yaml(flag: str, text: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit, match="2"):
        parse(Numbers, "", [flag, text], Numbers())
    assert flag in capsys.readouterr().err


def test_a_flag_takes_what_is_a_number_in_yaml():
    arguments = ["--whole", "0x10", "--real", "-1.5e-3", "--several", "1", "+3"]
    assert parse(Numbers, "", arguments, Numbers()) == Numbers(16, -0.0015, (1, 3))


@pytest.mark.parametrize("seed", ["7", True, 3.0])
def test_json_refuses_what_yaml_does(seed: object):
    settings = json.dumps({"seed": seed})
    with pytest.raises(ValueError, match="seed"):
        ExperimentConfig.model_validate_json(settings)


def lenient(schema: object, place: str) -> Iterator[str]:
    """Yield the places of a schema of pydantic's where a number may stand as text, or true for a number."""
    if isinstance(schema, Mapping):
        if schema.get("type") in ("int", "float", "bool") and not schema.get("strict"):
            yield place
        for key, value in schema.items():
            yield from lenient(value, f"{place}.{key}")
    elif isinstance(schema, list | tuple):
        for value in schema:
            yield from lenient(value, place)


@pytest.mark.parametrize(
    "model",
    [ExperimentConfig, Manifest, Source, Sweep, *(config_type(name) for name in OURS)],
    ids=lambda model: model.__name__,
)
def test_no_number_is_taken_as_text(model: type[BaseModel]):
    assert not list(lenient(model.__pydantic_core_schema__, ""))


@pytest.mark.parametrize(
    ("source", "places"),
    [
        ("npz:a=/x/lr=0.1/d.npz", {"a": "npz:/x/lr=0.1/d.npz"}),
        ("npz:/x/lr=0.1/d.npz", {"d": "npz:/x/lr=0.1/d.npz"}),
        (r"hdf5:a=/x\,y/d.h5,b=/z.h5", {"a": "hdf5:/x,y/d.h5", "b": "hdf5:/z.h5"}),
        ("hdf5:reach.h5", {"reach": "hdf5:reach.h5"}),
        ("minari:lab/push/mine-v3,npz:a=b.npz", {"mine": "minari:lab/push/mine-v3", "a": "npz:b.npz"}),
    ],
)
def test_paths_of_data_sets_have_one_reading(source: str, places: dict[str, str]):
    assert places_of(source) == places


@pytest.mark.parametrize("source", ["npz:", "npz:a=", "a=b.npz", "npz:a=x,", "npz:a=x,a=y"])
def test_what_has_no_reading_is_refused(source: str):
    with pytest.raises(UserError, match=r"demonstrations\.source: got"):
        places_of(source)


@dataclass(frozen=True)
class Named:
    name: str | None = None
    """A text."""
    count: int | None = 3
    """A number."""


def test_none_is_a_name_and_no_number():
    assert parse(Named, "", ["--name", "None", "--count", "None"], Named()) == Named("None", None)
    assert parse(Named, "", [], Named()) == Named()


def test_a_list_is_given_by_repeating_the_flag():
    early = peek(["--demos", "npz:a=x.npz", "--seed", "1", "--demos", "minari:b=lab/b-v1"], **EARLY)
    assert places_of(early.demos) == {"a": "npz:x.npz", "b": "minari:lab/b-v1"}
    assert peek(["--suite", "a", "--suite", "b"], **EARLY).suite == "b"


def test_a_tilde_is_the_home_in_flags_variables_and_sources(train, workplace: Path, monkeypatch):
    monkeypatch.setenv("HOME", str(workplace / "home"))
    (workplace / "home").mkdir()
    draw = np.random.default_rng(0)
    observations, actions = draw.normal(size=(240, 4)).astype("f4"), draw.uniform(-1, 1, (240, 2)).astype("f4")
    np.savez("home/a.npz", observations=observations, actions=actions, episode_lengths=np.full(12, 20))
    nothing = ("--training.iterations", "0", "--evaluation.fine-tuning-steps", "0", "--demos", "npz:a=~/a.npz")
    train("run", "--runs=~/runs", *nothing)
    assert (workplace / "home" / "runs" / "run" / "summary.json").exists()
    assert not (workplace / "~").exists()
    assert find_folder("~/runs/run", Path("runs"), "summary.json") == workplace / "home" / "runs" / "run"
    monkeypatch.setenv("DMIL_DATA", "~/data")
    assert data_root() == workplace / "home" / "data"
    monkeypatch.setenv("DMIL_DATA", "~nobody-of-this-name/data")
    assert data_root() == Path("~nobody-of-this-name/data")


@pytest.mark.parametrize(
    "name", ["x" * 256, "ü" * 200, "...", "..", "", "a/b", "a\nerror: all is lost", "\x1b[31mred", "caf\udce9"]
)
def test_a_name_that_no_folder_should_have_is_refused(tmp_path: Path, name: str):
    with pytest.raises(UserError, match="--name: got") as refused:
        new_name(name, tmp_path)
    assert str(refused.value).isprintable()
    with pytest.raises(UserError, match="RUN: got"):
        find_folder(name or "x", tmp_path, "config.json", "RUN")


def test_both_forms_of_a_name_are_one(tmp_path: Path):
    composed, decomposed = (unicodedata.normalize(form, "naïve über") for form in ("NFC", "NFD"))
    assert composed != decomposed
    assert new_name(decomposed, tmp_path).name == composed
    for made, asked in ((composed, decomposed), (decomposed, composed)):
        runs = tmp_path / f"runs of {len(made)}"
        (runs / made).mkdir(parents=True)
        (runs / made / "config.json").touch()
        with pytest.raises(UserError, match="which is taken"):
            new_name(asked, runs)
        assert find_folder(asked, runs, "config.json") == runs / made


@pytest.mark.parametrize("name", [r"$\frac$ [red]x[/y] <b>&amp; | `a` \input{x} %s {0} =1+1"])
def test_a_name_is_text_wherever_it_is_shown(train, capsys, name: str):
    folder = train("run")
    odd = folder.rename(folder.with_name(name.replace("/", "∕")))
    train(odd.name, "--training.iterations", "5", resume=True)
    (odd / "report" / "report.html").unlink()
    from services import report_run

    report_run.run([str(odd)])
    assert (odd / "report" / "report.html").read_text().count("<b>&amp;") == 0
    draw = np.random.default_rng(0)
    Path("a[").mkdir()
    np.savez(
        "a[/x] $y$.npz",
        observations=draw.normal(size=(4, 4)),
        actions=draw.uniform(-1, 1, (4, 2)),
        episode_lengths=np.full(2, 2),
    )
    capsys.readouterr()
    inspect_demos.run(["a[/x] $y$.npz"])
    assert "a[/x] $y$.npz: 2 episodes" in " ".join(capsys.readouterr().out.split())


def test_tasks_given_twice_are_refused(train, complaint):
    train("run")
    arguments = ("--checkpoint", "runs/run", "--runner", "local", "--tasks", "d", "d")
    assert "--tasks: got d, d; wanted each once" in complaint(evaluate.run, *arguments)
    printed = complaint(meta_train.run, *TOY, *SHORT, "--suite.train-tasks", "a", "a")
    assert "wanted each once" in printed
