"""Windows composed by threads, in order and in bounded memory, whatever shows their ground."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from typing import Any, Protocol, TypeVar

from geomosaic.mosaic.window import Step

Made = TypeVar("Made")
Materials = Mapping[int, Any]
"""Of each source, by its number, what it needs to show its part of a window."""


class Supply(Protocol):
    """Where sources' materials come from: frames' parts, strips' lines."""

    def for_step(self, step: int) -> Mapping[int, Future[Any]]:
        """The step's materials; asked once for each step, in order."""


def composed(
    steps: Sequence[Step],
    compose: Callable[[Step, Materials], Made],
    supply: Supply,
    pool: Executor,
    ahead: int,
    check_cancelled: Callable[[], None] | None = None,
) -> Iterator[Made]:
    """What is made of all steps in their order, `ahead` of them begun beyond the one that is taken."""
    running: deque[Future[Made]] = deque()
    begun = 0
    while begun < len(steps) or running:
        if check_cancelled is not None:
            check_cancelled()
        if begun < len(steps):
            running.append(pool.submit(_given, compose, steps[begun], supply.for_step(begun)))
            begun += 1
        if len(running) > ahead or begun == len(steps):
            yield running.popleft().result()


def _given(
    compose: Callable[[Step, Materials], Made], step: Step, materials: Mapping[int, Future[Any]]
) -> Made:
    return compose(step, {number: material.result() for number, material in materials.items()})


class InMemory:
    """Hands out materials step by step of a plan known beforehand, loading each as rarely as memory allows.

    `plan[n]` lists the sources that step n needs. When memory runs short the one needed farthest in the
    future is forgotten (Belady 1966, the best any cache can do); one never needed again goes at once. A
    step's own are kept even if they are larger than the budget together.
    """

    def __init__(
        self,
        plan: Sequence[Sequence[int]],
        sizes_bytes: Mapping[int, int],
        memory_bytes: int,
        pool: Executor,
        load: Callable[[int], Any],
    ) -> None:
        self._plan, self._sizes, self._memory, self._pool, self._load = (
            plan,
            sizes_bytes,
            memory_bytes,
            pool,
            load,
        )
        self._uses: dict[int, deque[int]] = {}
        for step, numbers in enumerate(plan):
            for number in numbers:
                self._uses.setdefault(number, deque()).append(step)
        self._kept: dict[int, Future[Any]] = {}

    def for_step(self, step: int) -> dict[int, Future[Any]]:
        """The step's materials; to be called once for each step, in order."""
        needed = self._plan[step]
        given = {}
        self._make_room(0, needed)
        for number in needed:
            if number not in self._kept:
                self._make_room(self._sizes[number], needed)
                self._kept[number] = self._pool.submit(self._load, number)
            given[number] = self._kept[number]
        for number in needed:
            self._uses[number].popleft()
            if not self._uses[number]:
                del self._kept[number]
        return given

    def _make_room(self, size_bytes: int, needed: Sequence[int]) -> None:
        while sum(self._sizes[f] for f in self._kept) + size_bytes > self._memory:
            spare = [f for f in self._kept if f not in needed]
            if not spare:
                return
            del self._kept[max(spare, key=lambda f: (self._uses[f][0], f))]
