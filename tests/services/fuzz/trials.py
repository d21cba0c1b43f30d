"""Try readers on mutated inputs: ``python trials.py FOLDER config=90 npz=100`` says how many each read and refused.

Each reader has a process of its own, with its limit of memory, and leaves its report or its fault in FOLDER.
"""

import json
import os
import sys
import time
import traceback
from collections import Counter
from pathlib import Path
from random import Random

from guards import guarded, set_up
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.strategies import DataObject, data, randoms
from mutations import Odd, json_values, plain_odd
from readers import READERS, Reader

from dmil_core.errors import UserError

SECONDS = 10.0
"""On a processor, for one input; the slowest honest ones take a tenth of that."""
SPARE_BYTES = 2**28
LONGEST_MESSAGE = 5000


class WrongError(Exception):
    """A reader gave the wrong answer."""


def attempt(reader: Reader, draw: Random, odd: Odd) -> str:
    """Read one mutated input and return what came of it.

    Raises:
        WrongError: if it was read wrongly, or refused without the file's name or in too many words.
        BaseException: whatever else the reader raises.
    """
    reader.mutate(draw, odd)
    try:
        with guarded(SECONDS):
            value = reader.read()
    except UserError as error:
        if reader.named not in str(error) or len(str(error)) > LONGEST_MESSAGE:
            raise WrongError(f"refused in the wrong words: {str(error)[:LONGEST_MESSAGE]}") from error
        return "refused"
    if not reader.right(value):
        raise WrongError(f"read wrongly: {value}")
    return "read"


def try_out(name: str, inputs: int, folder: Path) -> dict[str, float]:
    """Try half the inputs with plain random mutations, the others with Hypothesis's."""
    os.chdir(folder)
    reader = READERS[name](folder)
    set_up(SPARE_BYTES)
    outcomes: Counter[str] = Counter()
    began = time.monotonic()
    for number in range(inputs // 2):
        draw = Random(f"{name} {number}")
        outcomes[attempt(reader, draw, plain_odd(draw))] += 1

    @settings(
        max_examples=inputs - inputs // 2, database=None, derandomize=True, deadline=None, phases=[Phase.generate],
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example],
    )  # fmt: skip
    @given(randoms(use_true_random=False), data())
    def of_hypothesis(draw: Random, drawn: DataObject) -> None:
        outcomes[attempt(reader, draw, lambda: drawn.draw(json_values))] += 1

    of_hypothesis()
    return {"inputs": outcomes.total(), **outcomes, "seconds": round(time.monotonic() - began, 1)}


def start(name: str, inputs: int, folder: Path) -> int:
    """Try a reader in a fork of this process, and return its number."""
    if number := os.fork():
        return number
    code = 1
    try:
        (folder / name).mkdir()
        report = try_out(name, inputs, folder / name)
        (folder / f"{name}.json").write_text(json.dumps(report))
        code = 0
    except BaseException:  # noqa: BLE001  also the guards' errors end here: the other readers are tried all the same
        (folder / f"{name}.fault").write_text(traceback.format_exc())
    finally:
        os._exit(code)


if __name__ == "__main__":
    place = Path(sys.argv[1])
    for argument in sys.argv[2:]:
        reader_name, _, wanted = argument.partition("=")
        start(reader_name, int(wanted), place)
    for _ in sys.argv[2:]:
        os.wait()
