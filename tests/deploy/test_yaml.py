"""The YAML in `deploy/` is written in one way."""

from pathlib import Path

import pytest

from tests.deploy.manifests import DEPLOY, PROJECT, ask

pytestmark = pytest.mark.thorough

RULES = PROJECT / ".yamllint"


def test_yamllint_has_nothing_to_say():
    assert ask("yamllint", "--strict", "-c", RULES, DEPLOY, Path(__file__).parent) == (0, "")


def test_yamllint_finds_a_fault(tmp_path: Path):
    broken = tmp_path / "broken.yaml"
    broken.write_text("a: 1\na: 2\nb:   3\n")
    code, output = ask("yamllint", "--strict", "-c", RULES, broken)
    assert code != 0
    assert "duplication of key" in output
