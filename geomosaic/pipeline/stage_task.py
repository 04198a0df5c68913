"""A stage at work: when its turn comes, or earlier, concurrently with the stages before it in the recipe.

A stage that shares only its inputs with others (`Stage.concurrent`) may run early. Its messages, progress and
notes are spooled until its turn, so that the recording does not depend on which stage finished first.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from geomosaic.errors import GeomosaicError
from geomosaic.pipeline.cache import ArtefactHandle
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.plugin import blamed
from geomosaic.pipeline.recipe import RecipeStep
from geomosaic.pipeline.single_stage import check_outputs
from geomosaic.pipeline.stage_log import StageLog


class StageTask:
    """The execution of a stage, in this thread or in one of its own.

    lineage: of its outcome.
    """

    def __init__(
        self,
        step: RecipeStep,
        inputs: Mapping[str, ArtefactHandle],
        context: Context,
        log: StageLog,
        lineage: frozenset[str],
    ) -> None:
        self.context, self.log, self.lineage = context, log, lineage
        self.seconds = 0.0
        self._step, self._inputs = step, inputs
        self._values: dict[str, Any] = {}
        self._made: dict[str, Any] = {}
        self._error: BaseException | None = None
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        """Starts the stage in a thread of its own; errors are raised when its turn comes."""
        try:
            self._take()
        except Exception as error:
            self._error = error
            return
        self._thread = threading.Thread(target=self._go, name=self._step.stage.id, daemon=True)
        self._thread.start()

    def outcome(self) -> dict[str, Any]:
        """The outputs, when they are there. Raises: what the stage raises."""
        self.log.turn()
        if self._thread is not None:
            self._thread.join()
        elif self._error is None:
            self._take()
            self._go()
        if self._error is not None:
            raise self._error
        self.log.close()
        return self._made

    def end(self) -> None:
        """Stops it as soon as it asks, and waits for that; nothing of it stays but finished items."""
        self.log.end()
        if self._thread is not None:
            self._thread.join()
        try:
            self.log.close()
        finally:
            self.log.spool.unlink(missing_ok=True)

    def _take(self) -> None:
        self._values = {name: handle.value() for name, handle in self._inputs.items()}

    def _go(self) -> None:
        started = time.monotonic()
        try:
            self.context.check_cancelled()
            with blamed(self._step.stage):
                self._made = self._step.stage().run(self._values, self._step.params, self.context)
            check_outputs(self._step.stage, self._made)
        except BaseException as error:
            self._error = error
        self._values = {}
        self.seconds = time.monotonic() - started


def concurrent_steps(steps: Sequence[RecipeStep], i: int) -> list[int]:
    """The steps after step i that may be begun with it: nothing from i on gives what they take, and none has
    their name or writes their files.

    Those before i are done.
    """
    found, given, named, written = [], set[str](), set[str](), set[str]()
    for k, step in enumerate(steps[i:], i):
        stage = step.stage
        taken = {*stage.inputs, *stage.optional_inputs}
        apart = stage.id not in named and written.isdisjoint(stage.results)
        if k > i and stage.concurrent and stage.cached and apart and given.isdisjoint(taken):
            found.append(k)
        given |= stage.outputs.keys()
        named.add(stage.id)
        written |= set(stage.results)
    return found


def may_be_forged_data(error: BaseException) -> bool:
    """Whether a stage may have failed on cached data whose hashes are right and whose content isn't: a run
    folder may come from anybody."""
    by_data = (LookupError, ArithmeticError, TypeError, ValueError, AttributeError, AssertionError)
    return isinstance(error, by_data) and not isinstance(error, GeomosaicError)
