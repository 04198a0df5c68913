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

GRACE_S = 2.5
"""How long a command may take to stop by itself. People wait 3 s before they press again or kill."""


class Stop:
    """Whether the user asked for an end, and by which signal."""

    def __init__(self) -> None:
        self.signal: int | None = None

    @property
    def exit_code(self) -> int:
        """As shells have it for a program that a signal ended: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + (self.signal or signal.SIGINT)

    def ask(self, number: int, _frame: FrameType | None) -> None:
        """The signals' handler: stops the main thread where it is, and watches that it ends."""
        if self.signal is None:
            self.signal = number
            threading.Thread(target=self._end_at_last, daemon=True).start()
        raise KeyboardInterrupt

    def _end_at_last(self) -> None:
        """Ends a process that a library holds. As after a kill, finished work is kept; workers follow."""
        time.sleep(GRACE_S)
        with suppress(OSError):
            os.write(2, b"geomosaic: stopped\n")
        os._exit(self.exit_code)


@contextmanager
def stoppable() -> Iterator[Stop]:
    """Signals to stop are heard in this block, in the main thread; those that are ignored stay so."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, stop.ask) for number in numbers}
    hook = sys.unraisablehook

    def unraisable(told: Any) -> None:
        if not (stop.signal is not None and issubclass(told.exc_type, KeyboardInterrupt)):
            hook(told)

    sys.unraisablehook = unraisable
    try:
        yield stop
    finally:
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, handler)
