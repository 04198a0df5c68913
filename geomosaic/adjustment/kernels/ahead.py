"""Work on one group of observations while another thread prepares the next."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from itertools import pairwise
from typing import TypeVar

from geomosaic.constants import tuned

_FEWEST = tuned(16, "groups", "fewer: handing over costs what the second thread saves")
Item = TypeVar("Item")
Result = TypeVar("Result")


def ahead(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[Item, Result]]:
    """Each item and its result, in their order. While one is used, another thread makes the next, one at a
    time: whatever the function sums up is summed in the items' order. Few are done one after the other."""
    if len(items) < _FEWEST:
        yield from ((item, function(item)) for item in items)
        return
    context = copy_context()  # how numpy warns
    with ThreadPoolExecutor(1) as thread:
        coming = thread.submit(context.run, function, items[0])
        for item, following in pairwise(items):
            result = coming.result()
            coming = thread.submit(context.run, function, following)
            yield item, result
        yield items[-1], coming.result()
