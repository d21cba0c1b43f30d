"""Signals to stop end a program, wherever they come."""

import signal
import sys
import time
from types import FrameType

import pytest

from services.cli.arguments import exit_code


class Finalised:
    """Something in whose finaliser a stop comes, where Python lets no exception pass."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize("further", [0, 1], ids=["one", "two"])
def test_stops_in_a_finaliser_end_a_program_as_any_do(further: int, capfd: pytest.CaptureFixture[str]):
    signals = [signal.SIGHUP] * further

    def one_more(frame: FrameType, event: str, argument: object) -> None:
        if frame.f_code.co_name == "unraisable" and signals:
            signal.raise_signal(signals.pop())

    def program(arguments: object) -> None:
        sys.setprofile(one_more)
        Finalised()
        sys.setprofile(None)
        time.sleep(5)

    assert exit_code(program, []) == 128 + signal.SIGTERM
    assert not signals
    assert "Traceback" not in capfd.readouterr().err
