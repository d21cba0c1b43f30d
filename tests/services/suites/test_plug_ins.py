"""A package's suite of tasks, from its installation to the table; and what is said of one that has a fault."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dmil_core.configs import SuiteConfig
from dmil_core.demonstrations import digest
from services import collect_demos, meta_train
from services.cli.arguments import exit_code
from services.demonstrations.store import DemoStore
from services.evaluation.results import EpisodeResult, read_rows
from services.storage.checkpoints import Checkpoints
from services.suites import kitchen, metaworld
from services.suites.registry import OUR_NAMES, open_suite

PROJECT = Path(__file__).parents[3]
EXAMPLE = PROJECT / "docs" / "examples" / "planar_visits"
TRAIN = ("red-green-blue", "red-blue-green", "green-red-blue", "green-blue-red", "blue-red-green")
SMOKE = ("--suite", "planar-visits", "--preset", "smoke", "--runner", "local")
SHORT = ("--training.iterations", "1", "--evaluation.episodes", "1", "--evaluation.shots", "1")


@pytest.fixture(scope="session")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, installed without network into a folder of its own."""
    folder = tmp_path_factory.mktemp("example")
    shutil.copytree(EXAMPLE, folder / "source", ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--no-build-isolation", "--no-index", "--target", str(folder / "lib"), str(folder / "source")]
    subprocess.run(command, check=True)
    return folder / "lib"


@pytest.fixture
def plug_in(package: Path, tmp_path: Path, mlflow_file: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The example as this process finds it, in a working directory of the test's own."""
    monkeypatch.syspath_prepend(package)
    monkeypatch.delitem(sys.modules, "planar_visits", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DMIL_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    return package


@pytest.fixture
def register(plug_in: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Installs one more package: its module, and the name of its suite."""

    def install(code: str, name: str = "faulty") -> None:
        folder = tmp_path / "more"
        information = folder / "more-1.0.dist-info"
        information.mkdir(parents=True)
        (information / "METADATA").write_text("Metadata-Version: 2.1\nName: more\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(f"[dmil.suites]\n{name} = more_tasks:Faulty\n")
        (folder / "more_tasks.py").write_text(code)
        monkeypatch.syspath_prepend(folder)
        monkeypatch.delitem(sys.modules, "more_tasks", raising=False)

    return install


def faulty(*lines: str) -> str:
    """Return a module whose suite is the example's with other lines in its class."""
    return "\n".join(("from planar_visits import *", "class Faulty(PlanarVisits):", *(f"    {line}" for line in lines)))


def write_npz(path: Path, dims: tuple[int, int] = (9, 2), demonstrations: int = 8) -> str:
    """Write demonstrations of five steps each, which show nothing in particular."""
    draw, steps = np.random.default_rng(0), 5 * demonstrations
    np.savez(
        path,
        observations=draw.normal(size=(steps, dims[0])).astype(np.float32),
        actions=draw.uniform(-1, 1, (steps, dims[1])).astype(np.float32),
        episode_lengths=np.full(demonstrations, 5),
    )
    return f"npz:{path}"


@pytest.mark.thorough
@pytest.mark.usefixtures("plug_in", "plain_pages")
def test_an_installed_suite_is_meta_trained_to_its_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    short = ("--training.iterations", "2", "--training.checkpoint-every", "2", "--evaluation.fine-tuning-steps", "1")
    meta_train.run([*SMOKE, *short, "--name", "visits"])
    printed = capsys.readouterr().out
    assert "all visits in turn within 80 steps, each from 0.1 m; seed 0" in printed
    assert len(re.findall(r"│ planar-visits +│ meta-t", printed)) == 4
    summary = json.loads((tmp_path / "runs/visits/summary.json").read_text())
    found = [
        (row["suite"], row["split"], row["shots"], row["episodes"], list(row["per_task"])) for row in summary["rows"]
    ]
    assert found == [
        ("planar-visits", "meta-training", 1, 10, list(TRAIN)),
        ("planar-visits", "meta-training", 3, 10, list(TRAIN)),
        ("planar-visits", "meta-testing", 1, 2, ["blue-green-red"]),
        ("planar-visits", "meta-testing", 3, 2, ["blue-green-red"]),
    ]


@pytest.mark.usefixtures("plug_in")
def test_a_run_learns_a_task_from_a_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    mine = write_npz(tmp_path / "mine.npz")
    collect_demos.run(["record", "--suite", "planar-visits", "--task", "blue-green-red", "--from", mine])
    flag = capsys.readouterr().out.split("--demos ")[1].split()[0]
    assert flag.startswith("minari:blue-green-red=planar-visits/blue-green-red/recorded-")
    recorded = DemoStore(tmp_path / "data").load(flag.partition("=")[2], "blue-green-red")
    assert recorded is not None
    meta_train.run([*SMOKE, *SHORT, "--demos", flag, "--name", "mine"])
    manifest = Checkpoints(tmp_path / "runs/mine/checkpoints", kept=1).newest().manifest
    assert manifest.data["blue-green-red"] == recorded.digest == digest(recorded.demonstrations)
    assert set(manifest.data) == {*TRAIN, "blue-green-red"}
    rows = read_rows(tmp_path / "runs/mine/episodes.jsonl", EpisodeResult)
    assert {row.task for row in rows if row.data == recorded.digest} == {"blue-green-red"}
    assert {row.task for row in rows if row.data != recorded.digest} == set(TRAIN)


@pytest.mark.usefixtures("plug_in")
def test_settings_choose_tasks_and_horizon():
    whole = open_suite(SuiteConfig(name="planar-visits"))
    assert (whole.name, whole.horizon) == ("planar-visits", 80)
    part = open_suite(SuiteConfig(name="planar-visits", test_tasks=("red-green-blue",), horizon=50))
    assert (part.name, part.train_tasks, part.test_tasks) == ("planar-visits-part", TRAIN, ("red-green-blue",))
    assert part.horizon == 50
    assert part.protocol != whole.protocol
    assert open_suite(SuiteConfig(name="planar-visits", horizon=80)).protocol == whole.protocol


@pytest.mark.usefixtures("plug_in")
def test_the_experts_do_their_tasks_and_every_visit_counts_in_turn():
    suite = open_suite(SuiteConfig(name="planar-visits"))
    for task in (*suite.train_tasks, *suite.test_tasks):
        env, expert = suite.make_env(task), suite.expert(task)
        assert expert is not None
        observation, info = env.reset(seed=3)
        visits: list[str] = []
        while not info.get("success"):
            before = observation[6:]
            observation, reward, _, _, info = env.step(expert.get_action(observation))
            visits += [("red", "green", "blue")[index] for index in np.flatnonzero(observation[6:] - before)]
            assert float(reward) == np.sum(observation[6:] - before)
        assert "-".join(visits) == task


FAULTS = {
    "imports nothing": ("import nowhere", "cannot be imported: ModuleNotFoundError: No module named 'nowhere' (more_"),
    "no such name": ("", "cannot be imported: AttributeError: module 'more_tasks' has no attribute 'Faulty'; wanted"),
    "ends": (
        "raise SystemExit(0)",
        "more_tasks:Faulty of the package more, which cannot be imported: SystemExit: 0 (mo",
    ),
    "ends later": (
        faulty("def __init__(self, config):", "    raise SystemExit"),
        "more_tasks:Faulty: got SystemExit:  (more_tasks.py, line 4); wanted",
    ),
    "no Python": ("class", "cannot be imported: SyntaxError: invalid syntax (more_tasks.py, line 1); wanted"),
    "raises": (
        faulty("def __init__(self, config):", "    {}['x']"),
        "got KeyError: 'x' (more_tasks.py, line 4); wanted",
    ),
    "no suite": ("Faulty = 3", "got TypeError: 'int' object is not callable; wanted a suite for SuiteConfig("),
    "no dimensions": (faulty("obs_dim = None"), "obs_dim: got None; wanted an integer of at least 1; see docs/your-"),
    "no action": (faulty("action_dim = 0"), "action_dim: got 0; wanted an integer of at least 1"),
    "no expert": (faulty("expert = None"), "expert: got None; wanted a method; see docs/your-own-task.md"),
    "odd family": (faulty("family = '../x'"), "family: got '../x'; wanted letters, digits, dots and hyphens"),
    "odd task": (
        faulty("def __init__(self, config):", "    super().__init__(config)", "    self.test_tasks = ('a/b',)"),
        "tasks: got 'a/b'; wanted letters, digits, dots and hyphens",
    ),
    "no task": (
        faulty("def __init__(self, config):", "    super().__init__(config)", "    self.test_tasks = ()"),
        "test_tasks: got (); wanted tuple, not empty",
    ),
    "list of tasks": (
        faulty("def __init__(self, config):", "    super().__init__(config)", "    self.test_tasks = ['a']"),
        "test_tasks: got ['a']; wanted tuple, not empty",
    ),
    "own settings": (
        faulty("def __init__(self, config):", "    super().__init__(SuiteConfig(horizon=9))"),
        "train_tasks: got ('red-green-blue', 'red-blue-green', 'green-red-blue', 'green-blue-red', 'blue-red-green'); "
        "wanted the ('red-green-blue',) of the settings",
    ),
    "other actions": (faulty("action_dim = 3"), "action_space: got Box(-1.0, 1.0, (2,), float64); wanted a Box of the"),
    "other observations": (faulty("obs_dim = 8"), "observation_space: got Box(-inf, inf, (9,), float64); wanted a Box"),
}


@pytest.mark.parametrize(("code", "said"), FAULTS.values(), ids=FAULTS)
def test_a_fault_of_a_package_is_reported_in_words(register, complaint, code: str, said: str):
    register(code)
    flags = ("--suite", "faulty", "--suite.train-tasks", "red-green-blue", "--preset", "smoke", "--runner", "local")
    printed = complaint(meta_train.run, *flags)
    assert said in printed, printed
    assert "Traceback" not in printed


def test_two_packages_of_one_name_are_distinguished(register, complaint):
    register(faulty("pass"), name="planar-visits")
    printed = complaint(meta_train.run, *SMOKE)
    assert "got planar-visits twice" in printed
    assert "planar_visits:PlanarVisits" in printed
    assert "more_tasks:Faulty" in printed


@pytest.mark.parametrize("name", ["ML45", "ML1-reach", "kitchen", "push-around-wall"])
def test_a_package_s_suite_does_not_pass_for_one_of_ours(register, complaint, name: str):
    register(faulty("pass"), name)
    printed = complaint(meta_train.run, *SMOKE)  # whatever is asked for
    assert (
        f"error: entry points dmil.suites: got {name} twice, a suite of our own and more_tasks:Faulty of the" in printed
    )


def test_our_suites_names_are_kept_for_them():
    assert [name for name in (*metaworld.SPLITS, *kitchen.SPLITS) if not OUR_NAMES.fullmatch(name)] == []


MISTAKES = {
    "no such suite": (
        ("--suite", "planar-visit"),
        ("suite.name: got planar-visit; wanted ml10", "packages, planar-visits"),
    ),
    "no name": (("--suite", "planar_visits"), ("--suite: got 'planar_visits'; wanted a name of letters",)),
    "no such task": (
        ("--suite.test-tasks", "red-red-red"),
        ("suite.test_tasks: got red-red-red; wanted some of red-green-blue, red-blue-green",),
    ),
    "not heeded": (
        ("--suite.start-noise", "2"),
        ("suite.start_noise: got 2.0; without it planar-visits has the same protocol", "leave it out"),
    ),
    "data of no task": (
        ("--demos", "minari:red=mine/red-v0"),
        ("demonstrations.source: got data sets of red; planar-visits has the tasks red-green-blue",),
    ),
    "no data": (
        ("--demos", "minari:blue-green-red=mine/b-v0"),
        ("minari:mine/b-v0: got nothing at", "wanted a data set"),
    ),
}


@pytest.mark.parametrize(("flags", "said"), MISTAKES.values(), ids=MISTAKES)
@pytest.mark.usefixtures("plug_in")
def test_a_mistake_is_reported_in_words(complaint, flags: tuple[str, ...], said: tuple[str, ...]):
    suite = () if "--suite" in flags else SMOKE[:2]
    printed = complaint(meta_train.run, *SMOKE[2:], *suite, *flags)
    for words in said:
        assert words in printed, printed
    assert "Traceback" not in printed


@pytest.mark.usefixtures("plug_in")
def test_a_data_set_of_other_dimensions_is_refused(complaint, tmp_path: Path):
    for dims, said in (
        ((5, 2), "episode 0: observations: got 5 numbers a step; planar-visits wants 9"),
        ((9, 3), "episode 0: actions: got 3 numbers a step; planar-visits wants 2"),
    ):
        place = write_npz(tmp_path / "other.npz", dims)
        printed = complaint(
            meta_train.run, *SMOKE, "--name", str(dims[0]), "--demos", place.replace(":", ":blue-green-red=")
        )
        assert f"{place}: {said}" in printed, printed


def test_what_no_expert_demonstrates_needs_a_data_set(register, complaint, tmp_path: Path):
    register(faulty("def expert(self, task):", "    return None if task == 'blue-green-red' else super().expert(task)"))
    flags = ("--suite", "faulty", "--preset", "smoke", "--runner", "local")
    printed = complaint(meta_train.run, *flags)
    assert (
        "demonstrations.source: got nothing for blue-green-red, which has no scripted expert; wanted a data" in printed
    )
    assert "--demos minari:blue-green-red=ID" in printed
    printed = complaint(
        collect_demos.run, "verify", "--suite", "faulty", "--tasks", "blue-green-red", "--runner", "local"
    )
    assert "--tasks: got none that has a scripted expert in planar-visits-part" in printed
    demos = write_npz(tmp_path / "mine.npz").replace(":", ":blue-green-red=")
    meta_train.run([*flags, *SHORT, "--demos", demos, "--name", "mine"])
    assert (tmp_path / "runs/mine/summary.json").exists()


def test_demonstrations_that_the_suite_has_outgrown_are_reported_by_their_folder(register, complaint, tmp_path: Path):
    collect_demos.run([*SMOKE])
    (stored,) = (tmp_path / "data/planar-visits/red-green-blue").iterdir()
    register(
        faulty("obs_dim = 8", "def make_env(self, task):", "    return Narrow(super().make_env(task))")
        + "\nclass Narrow(gymnasium.ObservationWrapper):\n    observation_space = Box(-9, 9, (8,))\n"
        + "    def observation(self, observation):\n        return observation[:8]\n"
    )
    printed = complaint(collect_demos.run, "--suite", "faulty", "--preset", "smoke", "--runner", "local")
    assert f"{stored}: observations: got 9 numbers a step; planar-visits wants 8; remove it, or name" in printed


UNLIKE = {
    "reset": (
        "    def reset(self, *, seed=None, options=None):\n        return super().reset()\n",
        "reset(seed=7): got another episode than the first time, at the reset; wanted the same",
    ),
    "steps": (
        "    slips = 0\n    def step(self, action):\n"
        "        self.slips += 1e-4\n        return super().step(action + self.slips)\n",
        "reset(seed=7): got another episode than the first time, after step 1; wanted the same",
    ),
}


@pytest.mark.parametrize(("methods", "said"), UNLIKE.values(), ids=UNLIKE)
def test_verify_finds_episodes_that_do_not_follow_from_their_seed(register, complaint, methods: str, said: str):
    register(
        faulty("def make_env(self, task):", "    return Unlike([0, 1, 2])") + f"\nclass Unlike(VisitTask):\n{methods}"
    )
    printed = complaint(collect_demos.run, "verify", "--suite", "faulty", "--first-seed", "7", "--runner", "local")
    assert said in printed, printed
    assert "draw all that is random from self.np_random" in printed


BROKEN = {
    "tells nothing": (
        "    def step(self, action):\n        return (*super().step(action)[:4], {})\n",
        2,
        "planar-visits: info of a step: got no success; wanted success or is_success, whether the task is solved",
    ),
    "raises": (
        "    def step(self, action):\n        return 1 / 0\n",
        1,
        "task red-green-blue, seeds 0 to 4: ZeroDivisionError: division by zero\nTraceback",
    ),
}


@pytest.mark.parametrize(("methods", "code", "said"), BROKEN.values(), ids=BROKEN)
def test_verify_says_what_is_wrong_with_an_environment(register, capsys, methods: str, code: int, said: str):
    register(
        faulty("def make_env(self, task):", "    return Broken([0, 1, 2])") + f"\nclass Broken(VisitTask):\n{methods}"
    )
    assert exit_code(collect_demos.run, ["verify", "--suite", "faulty", "--runner", "local"]) == code
    assert f"error: {said}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("verify", "--suite", "a_b"), "--suite: got 'a_b'; wanted a name of letters, digits and hyphens"),
        (("inspect", "a.npz", "--suite", "a_b"), "--suite: got 'a_b'"),
        (("record", "--suite", "a_b", "--task", "x", "--from", "npz:a.npz"), "--suite: got 'a_b'"),
        (("verify", "--suite", "planar-visits", "--tasks"), "--tasks: got none; wanted at least one"),
        (("verify", "--suite", "planar-visits", "--seeds", "0"), "--seeds, --first-seed: got 0 from 0 on; wanted"),
    ],
)
@pytest.mark.usefixtures("plug_in")
def test_what_names_no_suite_or_task_is_reported_in_words(complaint, flags: tuple[str, ...], said: str):
    assert said in complaint(collect_demos.run, *flags)


def test_the_page_shows_the_end_of_the_example():
    page = (PROJECT / "docs" / "your-own-task.md").read_text("utf-8")
    for name, begin in (("planar_visits.py", "python\nclass PlanarVisits:"), ("pyproject.toml", "toml\n[project")):
        (block,) = re.findall(rf"```{re.escape(begin)}.*?```", page, re.DOTALL)
        assert (EXAMPLE / name).read_text("utf-8").endswith(block.partition("\n")[2].removesuffix("```"))


def test_an_environment_of_gymnasium_robotics_is_a_suite_in_30_lines(register, capsys):
    page = (PROJECT / "docs" / "your-own-task.md").read_text("utf-8")
    (block,) = [each for each in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "FetchReach" in each]
    assert block.count("\n") <= 30
    register(f"{block}\nFaulty = FetchReach\n", "fetch-reach")
    verify = ["verify", "--suite", "fetch-reach", "--seeds", "2", "--runner", "local"]
    assert exit_code(collect_demos.run, verify) == 0
    assert "2/2" in capsys.readouterr().out
    run = ["--suite", "fetch-reach", "--method", "tracking", "--preset", "smoke", "--runner", "local", *SHORT[2:]]
    assert exit_code(meta_train.run, run) == 0
    assert "fetch-reach" in capsys.readouterr().out
