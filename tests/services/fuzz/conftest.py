"""How many mutated inputs the readers are tried on: some in an ordinary run, many with ``-m fuzz``."""

import pytest

SHARES = {"config": 90, "checkpoint": 120, "dataset": 90, "npz": 100, "rows": 60, "metrics": 40}
"""Of 500 inputs in all."""
TIMES_WITH_FUZZ = 20


def is_long(config: pytest.Config) -> bool:
    return config.option.markexpr == "fuzz"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if is_long(config):
        for item in items:
            if item.get_closest_marker("fuzz"):
                item.add_marker(pytest.mark.timeout(3600))


@pytest.fixture(scope="session")
def shares(request: pytest.FixtureRequest) -> dict[str, int]:
    """The number of inputs for each reader."""
    times = TIMES_WITH_FUZZ if is_long(request.config) else 1
    return {name: times * share for name, share in SHARES.items()}
