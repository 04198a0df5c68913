"""Windows composed by threads, in order and in bounded memory, whatever shows their ground."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from typing import Any, Protocol, TypeVar

from geomosaic.composition.window import CompositionStep

Made = TypeVar("Made")
Materials = Mapping[int, Any]
"""Of each source, by its number, what it needs to show its part of a window."""


class Supply(Protocol):
    """Where sources' materials come from: frames' parts, strips' lines."""

    def for_step(self, step: int) -> Mapping[int, Future[Any]]:
        """The step's materials; asked once for each step, in order."""


def composed(
    steps: Sequence[CompositionStep],
    compose: Callable[[CompositionStep, Materials], Made],
    supply: Supply,
    pool: Executor,
    ahead: int,
) -> Iterator[Made]:
    """What is made of all steps in their order, `ahead` of them begun beyond the one that is taken."""
    running: deque[Future[Made]] = deque()
    begun = 0
    while begun < len(steps) or running:
        if begun < len(steps):
            running.append(pool.submit(_given, compose, steps[begun], supply.for_step(begun)))
            begun += 1
        if len(running) > ahead or begun == len(steps):
            yield running.popleft().result()


def _given(
    compose: Callable[[CompositionStep, Materials], Made],
    step: CompositionStep,
    materials: Mapping[int, Future[Any]],
) -> Made:
    return compose(step, {number: material.result() for number, material in materials.items()})
