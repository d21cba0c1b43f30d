"""An expert is verified by its own demonstrations."""

from dmil_core.configs import DemonstrationConfig, SuiteConfig
from services.rollouts.episodes import demonstrate
from services.rollouts.verification import verify
from services.suites.metaworld import MetaWorldSuite


def test_a_row_says_what_the_demonstration_of_its_seed_does():
    suite = MetaWorldSuite(SuiteConfig())
    env, expert = suite.make_env("soccer"), suite.expert("soccer")
    rows = verify(suite, "soccer", range(8), noise=0.1)
    assert [(row.task, row.seed, row.noise) for row in rows] == [("soccer", seed, 0.1) for seed in range(8)]
    for row in rows:
        attempt = demonstrate(expert, env, row.seed, 300, DemonstrationConfig(trailing_steps=0))
        assert (row.success, row.score) == (attempt.solved_at is not None, int(attempt.solved_at is not None))
        assert row.steps == len(attempt.actions) == (300 if attempt.solved_at is None else attempt.solved_at + 1)
    assert {row.success for row in rows} == {True, False}
