"""The readers under test: what is real input to each, how it is mutated, and what a right answer is."""

from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any, Protocol

from mutations import Odd
from npz_reader import NpzReader
from stored_readers import CheckpointReader, DatasetReader
from text_readers import ConfigReader, MetricsReader, RowsReader


class Reader(Protocol):
    """A reader, and the files that it is tried on."""

    named: str
    """What an error must name."""

    def __init__(self, folder: Path) -> None:
        """Make real input in an empty folder."""
        ...

    def mutate(self, draw: Random, odd: Odd) -> None:
        """Put a mutation of the real input in its place."""
        ...

    def read(self) -> Any:
        """Read the input."""
        ...

    def right(self, value: Any) -> bool:
        """Tell whether this is what stands in the input."""
        ...


READERS: dict[str, Callable[[Path], Reader]] = {
    "config": ConfigReader,
    "checkpoint": CheckpointReader,
    "dataset": DatasetReader,
    "npz": NpzReader,
    "rows": RowsReader,
    "metrics": MetricsReader,
}
