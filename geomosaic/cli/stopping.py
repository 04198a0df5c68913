"""Ctrl-C and SIGTERM: a command ends within 3 s, whatever it is doing, and what it leaves can be resumed."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
GRACE_S = 2.5
"""How long a command may take to stop by itself. People wait 3 s before they press again or kill."""


class Stop:
    """Whether the user asked for an end, and by which signal.

    The system writes each signal into a pipe at the moment it comes, also while the main thread is deep in a
    library and Python's own handlers wait. A watch reads it there.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self.ended: int | None = None
        """With which exit code the command itself ended."""

    @property
    def exit_code(self) -> int:
        """As shells have it for a program that a signal ended: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + (self.signal or signal.SIGINT)

    def ask(self, number: int, _frame: FrameType | None) -> None:
        """The signals' handler: stops the main thread where it is."""
        self.signal = self.signal or number
        raise KeyboardInterrupt

    def watch(self, pipe: int) -> None:
        """Ends a process that a library holds. As after a kill, finished work is kept; workers follow."""
        while number := os.read(pipe, 1):
            if number[0] in SIGNALS:
                self.signal = self.signal or number[0]
                time.sleep(GRACE_S)
                with suppress(OSError):
                    os.write(2, b"geomosaic: stopped\n")
                os._exit(self.exit_code)
        os.close(pipe)

    def leave(self) -> None:
        """The last of a program's doings at its exit: no library waits for a disk or a thread after it, and
        no array is given back piece by piece."""
        code = self.ended if self.signal is None else self.exit_code
        if code is None:
            return
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):
                stream.flush()
        os._exit(code)


@contextmanager
def stoppable() -> Iterator[Stop]:
    """Signals to stop are handled in this block, in the main thread; those that are ignored stay so."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    numbers = [n for n in SIGNALS if signal.getsignal(n) is not signal.SIG_IGN]
    read, write = os.pipe()
    os.set_blocking(write, False)
    threading.Thread(target=stop.watch, args=(read,), daemon=True).start()
    pipe_before = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    before = {number: signal.signal(number, stop.ask) for number in numbers}
    hook = sys.unraisablehook

    def unraisable(raised: Any) -> None:
        if not (stop.signal is not None and issubclass(raised.exc_type, KeyboardInterrupt)):
            hook(raised)

    sys.unraisablehook = unraisable
    try:
        yield stop
    finally:
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(pipe_before)
        os.close(write)
