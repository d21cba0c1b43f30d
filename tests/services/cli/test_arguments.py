"""Settings from preset, file and flags, and mistakes that are answered with what is allowed."""

import json
import os
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

import services
from dmil_core.configs import PRESETS
from dmil_core.errors import UserError
from dmil_core.files import open_file
from services.cli.arguments import PROGRAMS, exit_code, parse
from services.cli.composition import config_from
from services.cli.help_texts import COMMANDS
from services.meta_train import Arguments, run

SERVICES = Path(services.__path__[0])


def settings(*flags: str, preset: str = "ml10-smoke", file: Path | None = None) -> Any:
    return parse(Arguments, "", flags, Arguments(config_from(preset, file))).experiment


@pytest.fixture
def yaml_file(tmp_path: Path):
    def write(text: str) -> Path:
        path = tmp_path / "settings.yaml"
        path.write_text(text)
        return path

    return write


def test_the_paper_preset_is_table_9_to_the_letter():
    paper = PRESETS["ml10-paper"]
    method: Any
    method, training = paper.method, paper.training
    assert (method.inner_learning_rate, training.learning_rate) == (5e-4, 1e-4)
    assert (method.inner_steps, method.trajectories, method.continuity_weight) == (3, 16, 0.1)
    assert (method.sub_skills, method.hidden_layers, method.hidden_units) == (3, 4, 512)
    assert (method.order, method.window, training.gradient_clip) == ("second", None, None)
    assert (paper.evaluation.shots, paper.evaluation.episodes) == ((1, 3), 20)
    assert (paper.suite.name, paper.suite.train_tasks, paper.suite.test_tasks) == ("ml10", None, None)


def test_a_file_overrides_the_preset_and_a_flag_overrides_the_file(yaml_file):
    file = yaml_file("seed: 3\nmethod: {sub_skills: 5, window: null}\nsuite: {train_tasks: [reach, push]}\n")
    found = settings("--method.sub-skills", "7", "--evaluation.shots", "2", file=file)
    preset: Any = PRESETS["ml10-smoke"]
    assert (found.seed, found.method.sub_skills, found.method.window) == (3, 7, None)
    assert found.suite.train_tasks == ("reach", "push")
    assert found.evaluation.shots == (2,)
    assert found.method.inner_learning_rate == preset.method.inner_learning_rate
    assert found.training == preset.training
    assert settings(file=file).method.sub_skills == 5
    assert config_from("smoke", None, suite="ml45").suite.name == "ml45"
    with pytest.raises(UserError, match=r"--suite: got ml45 with --preset ml10-smoke, .*; give --preset smoke"):
        config_from("ml10-smoke", None, suite="ml45")
    assert settings() == preset


def test_a_setting_that_may_be_none_can_be_given_and_taken_back():
    assert settings("--method.window", "None").method.window is None
    assert settings("--method.window", "9", preset="ml10-paper").method.window == 9
    assert settings("--training.gradient-clip", "2.5").training.gradient_clip == 2.5


MISTAKES = {
    "unknown flag": (("--method.sub-skill-count", "5"), ("--method.sub-skill-count",)),
    "no number": (("--method.sub-skills", "many"), ("--method.sub-skills", "many")),
    "impossible number": (
        ("--method.sub-skills", "0"),
        ("error: --method.sub-skills: got 0; input should be greater",),
    ),
    "negative rate": (("--training.learning-rate", "-1"), ("error: --training.learning-rate: got -1.0; input",)),
    "not a choice": (("--method.order", "third"), ("--method.order", "third", "first", "second")),
    "more held out than there are": (
        ("--demonstrations.held-out", "12"),
        ("error: --demonstrations.held-out: got 12",),
    ),
    "more support than is held out": (
        ("--evaluation.shots", "9"),
        ("error: --demonstrations.held-out: got 4; wanted at least 9",),
    ),
    "unknown task": (
        ("--suite.train-tasks", "reech"),
        ("suite.train_tasks: got reech; wanted", "; the nearest are reach, "),
    ),
    "no task": (("--suite.train-tasks",), ("error: --suite.train-tasks: got (); tuple should have at least 1",)),
    "no workers": (("--workers", "0"), ("--workers", "got 0", "at least 1")),
    "unknown preset": (
        ("--preset", "ml10-quik"),
        ("--preset: got 'ml10-quik'; wanted", "; the nearest are ml10-quick, "),
    ),
    "unknown suite": (
        ("--preset", "smoke", "--suite", "ml1O"),
        ("suite.name: got ml1O; wanted", "; the nearest are ml10, "),
    ),
    "unknown method": (("--method", "dmill"), ("method.name: got 'dmill'; wanted", "; the nearest are dmil, mil")),
    "two suites": (
        ("--preset", "ml10-quick", "--suite", "kitchen"),
        ("--suite: got kitchen with --preset ml10-quick",),
    ),
    "no preset": (("--preset",), ("--preset",)),
}
LAUGHS = "a: &a [x, x]\n" + "".join(f"{b}: &{b} [*{a}, *{a}, *{a}, *{a}]\n" for a, b in pairwise("abcdefghijklmnop"))
FILES = {
    "unknown key": (
        "method: {sub_skill: 5}",
        ("method.sub_skill;", "; the nearest are sub_skills", "continuity_weight"),
    ),
    "unknown section": ("methods: {}", ("methods", "method", "training")),
    "wrong type": ("training: {iterations: soon}", ("training.iterations", "'soon'", "integer")),
    "half a number": ("training: {iterations: 2.5}", ("training.iterations", "2.5", "integer")),
    "value for a section": ("method: 5", ("method", "got 5", "sub_skills")),
    "not a number": ("method: {continuity_weight: .nan}", ("method.continuity_weight", "nan")),
    "list": ("- seed", ("with no keys but ['seed'] in it", "wanted keys")),
    "empty": ("# seed: 1", ("settings.yaml with nothing in it", "wanted keys")),
    "empty section": ("training:", ("settings.yaml: training: got nothing; wanted keys",)),
    "alias": ("seed: &s 1\ntraining: {iterations: *s}", ("found an alias", 'settings.yaml", line 2')),
    "billion laughs": (LAUGHS, ("settings.yaml", "found an alias")),
    "deep": ("method: " + "[" * 500, ("settings.yaml", "deep nesting")),
    "large": ("seed: " + "1" * 70_000, ("settings.yaml", "70006 bytes, of which at most 65536 are read")),
    "no day": ("seed: 2001-99-99", ("settings.yaml", "seed: got '2001-99-99'")),
    "huge number": ("seed: 0x" + "f" * 9000, ("settings.yaml: seed: got an integer of 36000 bits", "less than")),
    "long value": ("method: {order: " + "x" * 9000 + "}", ("settings.yaml: method.order: got 'xxx",)),
    "code": ("seed: !!python/object/apply:os.system [ls]", ("settings.yaml", "could not determine a constructor")),
    "too many": ("method: {hidden_units: 1000000}", ("method.hidden_units: got 1000000", "10000")),
    "no text": ("seed: \0", ("settings.yaml", "unacceptable character")),
    "no YAML": ("seed: [1", ("settings.yaml", "wanted a readable YAML file")),
}


@pytest.mark.usefixtures("workplace")
@pytest.mark.parametrize(("flags", "words"), MISTAKES.values(), ids=MISTAKES)
def test_a_wrong_flag_is_answered_with_what_is_allowed(complaint, flags, words):
    printed = complaint(run, "--runner", "local", *([] if "--preset" in flags else ["--preset", "ml10-smoke"]), *flags)
    assert all(word in printed for word in words), printed
    assert not list(Path().glob("runs/*/checkpoints"))


@pytest.mark.usefixtures("workplace")
@pytest.mark.parametrize(("text", "words"), FILES.values(), ids=FILES)
def test_a_wrong_file_is_answered_with_what_is_allowed(complaint, yaml_file, text, words):
    printed = complaint(run, "--runner", "local", "--preset", "ml10-smoke", "--config", str(yaml_file(text)))
    assert all(word in printed for word in words), printed
    assert len(printed) < 1000, "a message is to be read"


@pytest.mark.parametrize("file", ["nowhere.yaml", "."])
def test_a_file_that_cannot_be_read_is_named(file: str):
    with pytest.raises(UserError, match=r"--config: got .*; wanted a readable YAML file"):
        config_from("ml10-smoke", Path(file))


def test_a_mistake_ends_the_program_with_exit_code_2(programs):
    code, printed = programs("meta_train", "--method.order", "third")
    assert code == 2
    assert "third" in printed
    assert "Traceback" not in printed


@pytest.mark.parametrize("name", ["x" * 300, "file/below"])
def test_a_path_that_there_cannot_be_is_a_mistake_too(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "file").touch()
    assert exit_code(lambda arguments: open_file(tmp_path, name).close(), []) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"error: {tmp_path}/{name[:4]}")
    assert printed.count("\n") == 1


EXPLAINED = [path.stem for path in sorted(SERVICES.glob("[a-z]*.py")) if path.stem != "checkpoints"]
EXPLAINED.append("tracking.__main__")
EXPLAIN = """
import io, json, sys
from contextlib import redirect_stdout
from importlib import import_module

told = {}
for name in sys.argv[1:]:
    run = import_module(f"services.{name}").run
    for called in ("python", "dmil"):
        sys.argv[0] = f"/x/{called}"
        with redirect_stdout(io.StringIO()) as text:
            try:
                run(["--help"])
            except SystemExit as end:
                assert not end.code, text.getvalue()
        told[f"{called} {name}"] = text.getvalue()
    slow = sys.modules.keys() & {"torch", "ray", "mlflow"}
    assert not slow, f"{name} imports {slow} for --help"
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def explanations() -> dict[str, str]:
    """What each program prints on --help, as called by python or dmil; all in one process, without what is slow."""
    command = [sys.executable, "-c", EXPLAIN, *EXPLAINED]
    asked = subprocess.run(command, env=os.environ | {"COLUMNS": "100"}, capture_output=True, text=True)
    assert asked.returncode == 0, asked.stderr
    return json.loads(asked.stdout)


@pytest.mark.parametrize("name", EXPLAINED)
def test_each_program_explains_itself(name: str, explanations: dict[str, str]):
    words = COMMANDS.get(f"services.{name}", f"services.{name}").removeprefix("services.")
    program, _, rest = words.partition(" ")
    assert f"usage: python -m services.{words} " in explanations[f"python {name}"]
    usage = f"usage: dmil {program.replace('_', '-')} {rest}"
    assert f"{usage.rstrip()} " in explanations[f"dmil {name}"]


def test_help_is_in_paragraphs_with_an_example(explanations: dict[str, str]):
    lines = [line.strip(" │") for line in explanations["dmil meta_train"].splitlines()]
    assert "dmil meta-train --preset ml10-quick" in lines
    assert any("smoke (a minute); also with" in line for line in lines), "a docstring's own line ends there"


SHADOWED = (
    "argparse", "colorsys", "gymnasium", "h5py", "imageio", "metaworld", "minari", "mujoco", "numpy", "ray", "services",
    "sklearn", "torch", "tyro", "yaml",
)  # fmt: skip


@pytest.fixture
def foreign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Somebody else's folder, as the working directory: modules in it write their names into the file that ran."""
    folder, ran = tmp_path / "foreign", tmp_path / "ran"
    information = folder / "foreign-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[dmil.suites]\nml10 = colorsys:Suite\n")
    for name in SHADOWED:
        (folder / f"{name}.py").write_text(f"open({str(ran)!r}, 'a').write('{name} ')")
    monkeypatch.chdir(folder)
    return ran


def dmil(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([Path(sys.executable).with_name("dmil"), *arguments], capture_output=True, text=True)


def test_the_console_script_lists_the_programs(foreign: Path):
    listed = dmil("--help")
    assert listed.returncode == 0
    assert all(name in listed.stdout for name in PROGRAMS)
    unknown = dmil("fly")
    assert unknown.returncode == 2
    assert "got the program 'fly'; wanted one of meta-train" in unknown.stderr
    assert not foreign.exists()


@pytest.mark.thorough
def test_the_console_script_runs_nothing_of_the_folder_it_is_called_in(foreign: Path, finished):
    shutil.copytree(finished.folder, ".", dirs_exist_ok=True)
    drawn = dmil("report", "run", ".")
    assert drawn.returncode == 0, drawn.stderr
    verified = dmil("collect-demos", "verify", "--tasks", "reach", "--seeds", "1", "--workers", "1")  # by Ray's workers
    assert verified.returncode == 0, verified.stderr
    checked = dmil("doctor")
    assert checked.returncode in (0, 1), checked.stderr
    assert not foreign.exists(), foreign.read_text()
