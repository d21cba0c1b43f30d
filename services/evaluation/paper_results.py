"""The paper's figures, from ``paper_results.json``: what its appendix prints, as data."""

import json
from functools import cache
from importlib.resources import files
from typing import Any

from pydantic import BaseModel

from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.settings import MethodConfig
from services.suites.base import Split

BENCHMARKS = {"ml10": "ML10", "ml45": "ML45"}
KITCHENS = ("kitchen-topburner", "kitchen-microwave", "kitchen-kettle", "kitchen-slide")
"""The rows of Table 5; of the last two, which hold the same sub-tasks, the paper does not give which is which."""


ROWS = {"option-gail": "OptionGAIL"}
"""Of Table 4, by method."""
VARIANTS = {"both": "DMIL", "high": "DMIL-High", "low": "DMIL-Low"}
"""Rows of Table 4, by the levels that DMIL adapts."""


class Published(BaseModel):
    """A figure of the paper, with its spread as printed, if one is."""

    value: float
    spread: float | None
    table: str

    def text(self, digits: int) -> str:
        """Return the figure, with its spread if one is printed, to so many digits."""
        spread = "" if self.spread is None else f" ± {self.spread:.{digits}f}"
        return f"{self.value:.{digits}f}{spread}"


@cache
def _tables() -> dict[str, Any]:
    return json.loads((files("services.evaluation") / "paper_results.json").read_text("utf-8"))


def figure(table: str, row: str, suite: str, split: Split, shots: int) -> Published | None:
    """Return the paper's figure, if it has one: a success rate (Tables 4, 6, 7, 8), or a score (Table 5).

    A table is named as table4, a row as the paper has it: a method or a variant, K=4, or a number of fine-tuning steps.
    Table 5 does not give the number of shots: its figures stand beside all.
    """
    rows, title = _tables()[table]["rows"], f"Table {table.removeprefix('table')}"
    if table == "table5":
        if suite not in KITCHENS or split != "meta-testing" or row not in rows[KITCHENS.index(suite)]:
            return None
        value, spread = rows[KITCHENS.index(suite)][row]
        return Published(value=value, spread=spread, table=title)
    key, by_condition = f"{BENCHMARKS.get(suite)}/{split}/{shots}-shot", rows.get(row, {})
    means = by_condition.get("mean", by_condition)
    if key not in means:
        return None
    return Published(value=means[key], spread=by_condition.get("spread", {}).get(key), table=title)


def figure_of(method: MethodConfig, suite: str, split: Split, shots: int) -> Published | None:
    """Return the paper's figure for a method: success rates (Table 4, K = 3), or DMIL's scores (Table 5)."""
    if not isinstance(method, DmilConfig):
        return figure("table4", ROWS.get(method.name, ""), suite, split, shots)
    if suite in KITCHENS:
        return figure("table5", f"K={method.sub_skills}", suite, split, shots)
    return figure("table4", VARIANTS[method.adapted], suite, split, shots)
