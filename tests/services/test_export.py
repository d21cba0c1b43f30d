"""A model to ship: made from a run by one command, small, loaded by name wherever the project is installed."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import dmil_core as dmil
from dmil_core.checkpoint import MANIFEST, OPTIMISER, Checkpoint, CheckpointError
from dmil_core.errors import UserError
from dmil_core.model import SHIPPED
from services import export
from services.evaluation.expectation import expected_rows, verdicts
from services.evaluation.summary import Summary

PROJECT = Path(__file__).parents[2]
MODELS = sorted(path.parent for path in (PROJECT / "models").glob(f"*/{MANIFEST}"))


def test_a_run_becomes_a_model_that_adapts_alike_and_cannot_be_trained_on(copied_run, data, complaint):
    run = copied_run(3)
    export.run(["run", "mine"])
    assert sorted(path.name for path in Path("mine").iterdir()) == [
        "README.md", "constants.safetensors", "manifest.json", "manifest.sha256", "parameters.safetensors",
        "summary.json",
    ]  # fmt: skip
    before, after = dmil.load(run), dmil.load("mine")
    demonstrations = data["reach"].demonstrations[:1]
    one, other = (model.adapt(demonstrations, steps=2)(demonstrations[0].observations[3]) for model in (before, after))
    np.testing.assert_array_equal(one, other)
    with pytest.raises(CheckpointError, match=f"{OPTIMISER}: got none, as of a model to adapt"):
        _ = after.checkpoint.state
    card = Path("mine/README.md").read_text()
    assert "| ml10-part | meta-testing | 1 | " in card
    assert "--suite ml10 --preset smoke" in card
    assert "FOLDER: got mine, which is there already" in complaint(export.run, "run", "mine")
    (run / "summary.json").unlink()
    assert "got no summary.json" in complaint(export.run, "run", "other")
    assert not Path("other").exists()


def test_an_optimiser_that_the_manifest_names_and_is_gone_is_damage(copied_run: Callable[[int], Path]):
    checkpoint = copied_run(3) / "checkpoints" / "iteration-0000003"
    (checkpoint / OPTIMISER).unlink()
    with pytest.raises(CheckpointError, match=f"{OPTIMISER}: got 0 bytes"):
        Checkpoint(checkpoint)


def test_models_are_found_by_name_and_are_what_their_cards_tell_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert {path.name for path in MODELS} >= {"ml10", "ml45"}
    assert sum(file.stat().st_size for path in MODELS for file in path.iterdir()) < 20e6
    monkeypatch.chdir(tmp_path)
    for path in MODELS:
        checkpoint = dmil.load(path.name).checkpoint
        assert checkpoint.path == SHIPPED / path.name
        summary = Summary.model_validate_json((path / "summary.json").read_text())
        assert summary.checkpoint_digest == checkpoint.digest
        rows = [row for row in summary.rows if row.split == "meta-testing"]
        assert expected_rows(checkpoint, list(rows[0].per_task)) == rows
        for row in rows:
            successes = f"{round(row.success_rate * row.episodes)}/{row.episodes}"
            assert f"| {row.shots} | {successes} | {row.success_rate:.3f} |" in (path / "README.md").read_text()
    with pytest.raises(UserError, match=r"got 'ml46'.*\(ml10, ml45.*; the nearest are ml45, ml10"):
        dmil.load("ml46")


def test_a_rate_outside_the_interval_is_told():
    summary = Summary.model_validate_json((MODELS[0] / "summary.json").read_text())
    (expected,) = [row for row in summary.rows if row.split == "meta-testing" and row.shots == 1]
    for rate, met in ((expected.low, True), (expected.high, True), (expected.low - 0.01, False)):
        found = summary.model_copy(update={"rows": [expected.model_copy(update={"success_rate": rate})]})
        (verdict,) = verdicts(found, [expected])
        assert verdict.met is met
        assert verdict.words.endswith("within" if met else "outside")
    with pytest.raises(UserError, match="--expect: got the tasks reach; wanted those of the model's figures"):
        expected_rows(Checkpoint(MODELS[0]), ["reach"])


@pytest.mark.thorough
def test_a_plain_install_has_all_that_the_programs_need(tmp_path: Path):
    wheels, place, source = tmp_path / "wheels", tmp_path / "venv", tmp_path / "source"
    others = shutil.ignore_patterns(".*", "data", "runs", "build", "tests", "*.egg-info", "__pycache__")
    shutil.copytree(PROJECT, source, symlinks=True, ignore=others)  # a build leaves folders behind
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(wheels), str(source)]
    subprocess.run([*pip, *build], check=True)
    venv.create(place, with_pip=False)
    python, packages = place / "bin" / "python", next(place.glob("lib/python*/site-packages"))
    (wheel,) = wheels.glob("*.whl")
    subprocess.run([*pip, "--python", str(python), "install", "--no-deps", str(wheel)], check=True)
    (packages / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(*arguments: str) -> str:
        return subprocess.check_output(arguments, cwd=tmp_path, env=environment, text=True, stderr=subprocess.STDOUT)

    assert "meta-train" in run(str(place / "bin" / "dmil"), "--help")
    assert "bilevel" in run(str(place / "bin" / "dmil"), "tune-sweep", "--help")
    code = (
        "import dmil_core as dmil, services, services.sweeps.settings; from pathlib import Path\n"
        "from services.reporting.page import write_page\n"
        "write_page(Path('page.html'), 'title', [], [])\n"
        "from services.tune_sweep import CONFIGS; print(sorted(path.stem for path in CONFIGS.iterdir()))\n"
        "print(dmil.load('ml10').checkpoint.path, services.__file__)"
    )
    printed = run(str(python), "-c", code)
    assert "'bilevel'" in printed
    assert printed.count(str(packages)) == 2, "neither from this checkout"
    assert "<title>title" in (tmp_path / "page.html").read_text()
