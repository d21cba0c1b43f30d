"""How a program is stopped: Ctrl-C, SIGTERM and SIGHUP, each with time for what is to be kept."""

import _thread
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
AGAIN_SECONDS = 0.01
"""After which a stop is tried again that came in a finaliser or the like, where Python lets no exception pass."""


@contextmanager
def stoppable() -> Iterator[list[int]]:
    """Have a signal to stop end what goes on inside by KeyboardInterrupt; yield the signals that came.

    The second is only answered, so that what is being kept, as a checkpoint, is kept; the third ends that too. A signal
    that is ignored, as SIGHUP under nohup, stays so. One that comes where Python ignores exceptions comes once more.
    """
    received, lost = list[int](), list[int]()

    def stop(number: int, frame: object) -> None:
        if lost:
            lost.clear()
            raise KeyboardInterrupt
        received.append(number)
        if len(received) != 2:
            raise KeyboardInterrupt  # of a class of our own nothing would be left where Ray waits
        with suppress(OSError):  # no print: it may be at work already
            os.write(2, b"stopping; once more ends at once, and what is being written may be lost\n")

    def again(number: int) -> None:
        time.sleep(AGAIN_SECONDS)
        lost.append(number)
        signal.pthread_kill(main_thread, number)  # the thread whose waiting a signal ends

    def unraisable(told: "sys.UnraisableHookArgs") -> None:
        if told.exc_type is KeyboardInterrupt and received:
            _thread.start_new_thread(again, (received[0],))  # waits for nothing: the next signal may be on its way
        else:
            hook(told)

    main_thread = threading.main_thread().ident or 0
    hook, sys.unraisablehook = sys.unraisablehook, unraisable
    before = {number: signal.getsignal(number) for number in STOPS}
    for number in STOPS:
        if before[number] != signal.SIG_IGN:
            signal.signal(number, stop)
    try:
        yield received
    finally:
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def stops_deferred() -> Iterator[None]:
    """Defer signals to stop to the end of what goes on inside, which would be left without a state to go on from."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    deferred: list[int] = []
    handlers = {number: signal.signal(number, lambda number, frame: deferred.append(number)) for number in STOPS}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in deferred:
            signal.raise_signal(number)
