"""Readers of YAML and JSON lines."""

import json
import math
from pathlib import Path
from random import Random
from typing import Any

import yaml
from mutations import Odd, json_bytes, mutated_bytes, mutated_value

from dmil_core.configs import PRESETS, ExperimentConfig
from services.cli.composition import config_from
from services.evaluation.results import AdaptationResult, EpisodeResult, read_rows, write_rows
from services.tracking.history import read_metrics


def settings_yaml(settings: Any) -> bytes:
    return yaml.safe_dump(settings, allow_unicode=True, sort_keys=False).encode()


class ConfigReader:
    """Settings in YAML."""

    TEXTS = (
        "a: &a [x, x]\nb: &b [*a, *a, *a, *a]\nc: &c [*b, *b, *b, *b]\nseed: [*c, *c]", "seed: &s [*s]",
        "seed: 2001-99-99", "seed: 2001-01-01 25:61:61", "seed: 1:1:1" + ":59" * 9000, "seed: " + "9" * 9000,
        "seed: 0x" + "f" * 9000, "seed: !!python/object/apply:os.system ['touch x']", "seed: !!int ''",
        "seed: !!timestamp x", "seed: !!bool x", "seed: !!float ''", "seed: !!binary '===='", "<<: [seed, 1]",
        "<<: {seed: 4}", "? [1, 2]\n: 3", "? {a: b}\n: 3", "[" * 30000, "{a: " * 9000, "- " * 9000, "seed: 1\nseed: 2",
        "seed: \"\\ud800\"", "---\nseed: 1\n---\nseed: 2", "%YAML 9.9\n---\nseed: 1", "\ufeffseed: 5", "seed: 1\0",
        "x: " + "a" * 70000, "training: {iterations: 1e3}", "? " * 3000, "!<tag:yaml.org,2002:python/name:os> x",
    )  # fmt: skip

    def __init__(self, folder: Path) -> None:
        self.path, self.named = folder / "settings.yaml", "settings.yaml"
        self.real = json.loads(PRESETS["ml10-quick"].model_dump_json())

    def mutate(self, draw: Random, odd: Odd) -> None:
        match draw.randrange(4):
            case 0 | 1:
                content = settings_yaml(mutated_value(self.real, draw, odd))
            case 2:
                content = mutated_bytes(settings_yaml(self.real), draw)
            case _:
                content = draw.choice(self.TEXTS).encode("utf-8", "surrogatepass")
        self.path.write_bytes(content)

    def read(self) -> ExperimentConfig:
        return config_from("ml10-smoke", self.path)

    def right(self, value: ExperimentConfig) -> bool:
        def over(settings: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
            merged = {key: over(settings[key], v) if isinstance(v, dict) else v for key, v in given.items()}
            return settings | merged

        given = yaml.safe_load(self.path.read_bytes())
        return value == ExperimentConfig.model_validate(over(PRESETS["ml10-smoke"].model_dump(), given))


class RowsReader:
    """Rows of results."""

    def __init__(self, folder: Path) -> None:
        self.path, self.named = folder / "episodes.jsonl", "episodes.jsonl"
        common = {
            "suite": "ml10", "protocol": "p", "method": "dmil", "checkpoint": "0" * 64, "split": "meta-testing",
            "task": "reach", "shots": 1, "draw": 0, "support": ["008"], "data": "1" * 64, "fine_tuning_steps": 5,
            "learning_rate": 0.003, "versions": {"torch": "2.13.0"}, "steps": 30, "sub_skill_steps": [10, 20],
        }  # fmt: skip
        self.kinds: dict[type[EpisodeResult | AdaptationResult], bytes] = {}
        own = {"episode": 0, "seed": 2**62, "goal": [0.1, -0.25], "success": True, "score": 1}
        for kind, row in ((EpisodeResult, common | own), (AdaptationResult, common | {"agreeing": 3})):
            write_rows(self.path, [kind.model_validate(row | {"draw": draw}) for draw in range(3)])
            self.kinds[kind] = self.path.read_bytes()
        self.kind: type[EpisodeResult | AdaptationResult] = EpisodeResult

    def mutate(self, draw: Random, odd: Odd) -> None:
        self.kind = draw.choice(list(self.kinds))
        self.path.write_bytes(mutated_lines(self.kinds[self.kind], draw, odd))

    def read(self) -> Any:
        return read_rows(self.path, self.kind)

    def right(self, value: Any) -> bool:
        usual = {name: of.default for name, of in self.kind.model_fields.items() if not of.is_required()}
        rows = [json.loads(line) for line in lines(self.path)]
        wanted = [{name: of for name, of in row.items() if name not in usual or of != usual[name]} for row in rows]
        return [json.loads(row.model_dump_json(exclude_defaults=True)) for row in value] == wanted


class MetricsReader:
    """The metrics of a run's iterations."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.named = folder, "tracking.jsonl"
        records: list[Any] = [["parameters", {"seed": "0"}], ["tags", {"suite": "ml10"}]]
        values = {"agreement": 0.5, "gradient_norm": math.nan, "high_loss_after": 1e-30}
        records += [["metrics", {"step": step, "time": 1, "values": values}] for step in (1, 2, 3, 2)]
        records += [["artifact", {"path": "x", "folder": None}], ["end", {"status": "FINISHED", "time": 2}]]
        self.real = b"".join(json.dumps(record).encode() + b"\n" for record in records)

    def mutate(self, draw: Random, odd: Odd) -> None:
        (self.folder / self.named).write_bytes(mutated_lines(self.real, draw, odd))

    def read(self) -> list[dict[str, float]]:
        return read_metrics(self.folder)

    def right(self, value: list[dict[str, float]]) -> bool:
        found: dict[int, dict[str, float]] = {}
        whole = (self.folder / self.named).read_bytes().split(b"\n")[:-1]  # half a line is no record yet
        for kind, record in map(json.loads, whole):
            if kind == "metrics":
                row = found.setdefault(record["step"], {"iteration": record["step"]})
                row.update({name: as_float(number) for name, number in record["values"].items()})
        return repr(value) == repr([found[step] for step in sorted(found)])


def as_float(number: float) -> float:
    """Return a number of JSON as the reader has it: an integer that is too large is infinite."""
    try:
        return float(number)
    except OverflowError:
        return math.inf if number > 0 else -math.inf


def lines(path: Path) -> list[bytes]:
    """Return a file's lines, and half a line at its end where there is one."""
    whole = path.read_bytes().split(b"\n")
    return whole if whole[-1] else whole[:-1]


def mutated_lines(content: bytes, draw: Random, odd: Odd) -> bytes:
    """Return JSON lines of which one is mutated as JSON, or all as bytes."""
    if draw.random() < 0.4:
        return mutated_bytes(content, draw)
    rows = content.splitlines(keepends=True)
    which = draw.randrange(len(rows))
    rows[which] = json_bytes(mutated_value(json.loads(rows[which]), draw, odd)) + draw.choice(
        [b"\n", b"\n", b"", b"\n\n"]
    )
    return b"".join(rows)
