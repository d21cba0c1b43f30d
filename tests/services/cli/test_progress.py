"""How far a run is: on a real pseudo-terminal as a screen, elsewhere and with --quiet as lines."""

import os
import pty
import select
import signal
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from io import StringIO
from typing import NamedTuple

import pytest

from services.cli.live_view import Status
from services.cli.progress import Bar, Output
from tests.services.programs import QUICK_EVALUATION

HIDDEN, SHOWN = "\x1b[?25l", "\x1b[?25h"
"""What a terminal is sent to hide its cursor, and to show it again."""


class Terminal(NamedTuple):
    """Both ends of a pseudo-terminal."""

    screen: int
    program: int

    def resize(self, columns: int, rows: int) -> None:
        termios.tcsetwinsize(self.screen, (rows, columns))

    def read(self, until: Callable[[str], bool]) -> str:
        """Return what is sent, up to where it is what one waits for, or all that there is when its programs ended."""
        sent = b""
        while not until(sent.decode(errors="ignore")):
            if select.select([self.screen], [], [], 0.2)[0]:
                try:
                    sent += os.read(self.screen, 65536)
                except OSError:  # so a terminal ends
                    break
        return sent.decode()

    def start(self, *arguments: str) -> subprocess.Popen[bytes]:
        """Start meta-training in it; this process lets go of the program's end."""
        command = [sys.executable, "-m", "services.meta_train", "--preset", "ml10-smoke", "--runner", "local"]
        environment = {**os.environ, "TERM": "xterm-256color"}
        program = subprocess.Popen(
            [*command, "--name", "run", *arguments],
            stdin=self.program,
            stdout=self.program,
            stderr=self.program,
            start_new_session=True,
            env=environment,
        )
        os.close(self.program)
        return program


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    terminal = Terminal(*pty.openpty())
    terminal.resize(80, 24)
    yield terminal
    os.close(terminal.screen)


@pytest.mark.usefixtures("programs")
def test_a_terminal_shows_one_screen_and_is_left_as_it_was(terminal: Terminal):
    program = terminal.start("--training.iterations", "100000", "--training.checkpoint-every", "20")
    wanted = ("iterations/s", "losses", "sub-skills", "checkpoint: runs/run/checkpoints/iteration-0000020")
    sent = terminal.read(lambda sent: all(words in sent for words in wanted))
    assert HIDDEN in sent
    for columns, rows in ((160, 50), (30, 5), (80, 24)):
        terminal.resize(columns, rows)
        sent += terminal.read(lambda sent: sent.count("meta-training") > 2)
    os.killpg(program.pid, signal.SIGINT)
    sent += terminal.read(lambda sent: False)
    assert program.wait() == 130
    assert "Traceback" not in sent
    assert "stopped; to go on: dmil meta-train --resume runs/run" in sent
    assert sent.rindex(SHOWN) > sent.rindex(HIDDEN)
    after = sent[sent.rindex(SHOWN) :]
    assert "losses " not in after
    assert "meta-training " in after, "a line that says how far it came"


@pytest.mark.thorough
@pytest.mark.usefixtures("programs")
def test_a_quiet_terminal_gets_lines_and_results(terminal: Terminal):
    arguments = ["--training.iterations", "4", "--training.checkpoint-every", "2", "--evaluation.every", "2"]
    program = terminal.start("--quiet", *arguments, *QUICK_EVALUATION)
    sent = terminal.read(lambda sent: False)
    assert program.wait() == 0, sent
    assert HIDDEN not in sent
    assert "\nmeta-training 4/4, " in sent
    assert "\nevaluating 4/4, " in sent
    assert "Success rates of dmil" in sent
    assert "iteration-0000002" not in sent
    assert "success rates after 2 iterations" not in sent
    assert "checkpoint: runs/run/checkpoints/iteration-0000004" in sent, "it is among the results"


def test_where_there_is_no_terminal_there_are_lines(train, capsys: pytest.CaptureFixture[str]):
    schedule = ["--training.iterations", "4", "--training.checkpoint-every", "2", "--evaluation.every", "2"]
    train("run", *schedule)
    printed = capsys.readouterr().out
    (line,) = [line for line in printed.splitlines() if line.startswith("meta-training 4/4, ")]
    assert "; loss " in line
    assert "; sub-skills in use " in line
    assert "; after 2; meta-training 1-shot " in line
    assert "checkpoint: runs/run/checkpoints/iteration-0000002" in printed
    assert "success rates after 2 iterations: meta-training 1-shot " in printed
    assert "\x1b" not in printed


def fail_at_the_third() -> None:
    with Bar("working", 10, unit="pieces") as bar:
        bar.advance(3, "the third")
        raise ArithmeticError


def test_an_error_takes_the_screen_away(terminal: Terminal, monkeypatch: pytest.MonkeyPatch):
    with open(terminal.program, "w") as file:  # noqa: PTH123  a descriptor
        monkeypatch.setattr("services.cli.progress.console", Output(file=file, force_terminal=True, highlight=False))
        with pytest.raises(ArithmeticError):
            fail_at_the_third()
        sent = terminal.read(lambda sent: "working 3/10" in sent.rpartition(SHOWN)[2])
    assert HIDDEN in sent
    assert "0/10" in sent.partition(SHOWN)[0]


def test_steps_are_counted_and_nothing_more(monkeypatch: pytest.MonkeyPatch):
    """What is shown is put together when it is shown."""
    file, asked = StringIO(), []
    monkeypatch.setattr("services.cli.progress.console", Output(file=file, width=160, highlight=False))
    with Bar("working", 10**5, status=lambda: asked.append(1) or Status(at="the work")) as bar:
        for _ in range(10**5):
            bar.advance(1)
    lines = file.getvalue().splitlines()
    assert lines[-1].startswith("working 100000/100000, ")
    assert lines[-1].endswith("; the work")
    assert len(asked) == len(lines) <= 2 + bar._pace().seconds
