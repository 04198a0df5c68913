"""Memory that was freed, back to the system."""

from __future__ import annotations

import ctypes
import sys


def release_memory() -> None:
    """All that this process freed and keeps for its next arrays, holes amid what lives included. Does nothing
    where the C library isn't glibc."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
