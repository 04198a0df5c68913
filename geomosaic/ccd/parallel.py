"""The same work for every pair, on the machine's cores; the results' order is the pairs'."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Given = TypeVar("Given")
Found = TypeVar("Found")


def each(work: Callable[[Given], Found], given: Iterable[Given]) -> list[Found]:
    """`[work(one) for one in given]`, in threads; numpy, scipy and OpenCV let them run side by side."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with ThreadPoolExecutor(cores) as pool:
        return list(pool.map(work, given))
