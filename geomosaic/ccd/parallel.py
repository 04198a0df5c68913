"""The same work for every pair, on the machine's cores; the results' order is the pairs'."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import cv2

Given = TypeVar("Given")
Found = TypeVar("Found")


@contextmanager
def opencv_alone() -> Iterator[None]:
    """OpenCV without threads of its own, which would only be in the way of ours."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def each(work: Callable[[Given], Found], given: Iterable[Given]) -> list[Found]:
    """`[work(one) for one in given]`, in threads; numpy, scipy and OpenCV let them run side by side."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with opencv_alone(), ThreadPoolExecutor(cores) as pool:
        return list(pool.map(work, given))
