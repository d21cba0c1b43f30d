"""The paper's figures, from ``published.json``: what its appendix prints, as data."""

import json
from functools import cache
from importlib.resources import files
from typing import Any

from pydantic import BaseModel

from services.results import Split

__all__ = ["Published", "dmil_figure"]

BENCHMARKS = {"ml10": "ML10", "ml45": "ML45"}
KITCHENS = ("kitchen-topburner", "kitchen-microwave", "kitchen-kettle", "kitchen-slide")
"""The rows of Table 5; of the last two, which hold the same sub-tasks, the paper does not say which is which."""


class Published(BaseModel):
    """A figure of the paper, with its spread as printed."""

    value: float
    spread: float
    table: str


@cache
def _tables() -> dict[str, Any]:
    return json.loads((files("services") / "published.json").read_text("utf-8"))


def dmil_figure(suite: str, split: Split, shots: int, sub_skills: int) -> Published | None:
    """Return the paper's figure for DMIL, if it has one: success rates (Table 4, K = 3), or scores (Table 5).

    Table 5 does not tell how many demonstrations were adapted to: its figures stand beside all.
    """
    if suite in BENCHMARKS:
        row, key = _tables()["table4"]["rows"]["DMIL"], f"{BENCHMARKS[suite]}/{split}/{shots}-shot"
        found = row["mean"].get(key)
        return None if found is None else Published(value=found, spread=row["spread"][key], table="Table 4")
    if suite in KITCHENS and split == "meta-testing":
        figure = _tables()["table5"]["rows"][KITCHENS.index(suite)].get(f"K={sub_skills}")
        return None if figure is None else Published(value=figure[0], spread=figure[1], table="Table 5")
    return None
