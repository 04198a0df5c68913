"""The contract of a stage: what it declares, what it gets, what it gives.

A stage is a function that adapts between the rooms and the runner and holds no maths:

    class EnhanceParams(StageParams):
        clip: float = param(2.0, help="contrast limit", ge=0.5, le=8.0)

    @stage("matching.enhance", "Enhance contrast", group="Matching", version=1, outputs="enhanced")
    def enhance(survey: Survey, params: EnhanceParams, context: Context) -> Enhanced:
        '''Raises the contrast of each frame.'''

`geomosaic.pipeline.function_stage` makes a subclass of `Stage` of it; one with more to say may be written as
such a subclass. It enters by the entry-point group `geomosaic.stages`.

Its outputs are kept under a fingerprint. This covers id, version, parameters that affect the output, the
seed, its inputs' fingerprints, and the contents of all files that it or an earlier stage read. Whoever
changes what a stage computes raises its `version`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from geomosaic.pipeline.context import Context, RunFile
from geomosaic.pipeline.former_names import FORMER_DECLARATIONS
from geomosaic.pipeline.params import StageParams, file_values, param

__all__ = ["Context", "RunFile", "Stage", "StageParams", "param"]


class Stage(ABC):
    """One step of the staircase, with its declaration.

    inputs, outputs, optional_inputs: artefact types by name. Artefacts are frozen dataclasses of
    numbers, strings, tuples, dicts and numpy arrays (also nested), or `RunFile`s; they pass from stage
    to stage by name. A name is given once, but a stage may give anew what it takes: later stages get
    what it made of it. An optional input is missing from `inputs` if no earlier stage gives it.
    formerly: by output, the name it had in recordings of earlier versions.
    cached: False for a stage that reads more than its inputs (the report reads the run's summary);
    it runs every time.
    concurrent: True for a stage that shares nothing with other stages but its inputs and may run in a thread
    of its own as soon as these are there.
    goes_on: True for a stage that may begin with what it made in an earlier run (`Context.earlier`); its
    outcome is kept apart from that of a whole run.
    looks_ahead: True for a stage that says what the later ones will take (`context.inform`): with the last of
    these a dry run ends.
    wants_frames: True for a stage that makes nothing of thumbnails: a replay without frames leaves it out.
    results: names of the files and folders it may write next to RUN/work. A run is refused before any work
    if one of them is there and not geomosaic's; one of an earlier run that is not made again is removed.
    """

    id: ClassVar[str]
    display_name: ClassVar[str]
    group: ClassVar[str]
    version: ClassVar[int] = 1
    inputs: ClassVar[dict[str, type]] = {}
    optional_inputs: ClassVar[dict[str, type]] = {}
    outputs: ClassVar[dict[str, type]] = {}
    formerly: ClassVar[dict[str, str]] = {}
    cached: ClassVar[bool] = True
    concurrent: ClassVar[bool] = False
    goes_on: ClassVar[bool] = False
    looks_ahead: ClassVar[bool] = False
    wants_frames: ClassVar[bool] = False
    results: ClassVar[tuple[str, ...]] = ()
    Params: ClassVar[type[StageParams]] = StageParams

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        for former, present in FORMER_DECLARATIONS.items():
            if former in cls.__dict__:
                setattr(cls, present, cls.__dict__[former])

    @classmethod
    def check(cls, params: Any) -> None:
        """Raises `InputError` for what can be seen to be wrong before any stage runs; reads headers at most.

        Every file and folder that `params` names is there when it is asked.
        """
        return

    @classmethod
    def files(cls, params: Any) -> dict[str, Path]:
        """The files and folders whose contents the stage's result depends on, by name.

        Those that `params` names; a stage adds what these name in turn. `check` has passed when it is asked.
        """
        return file_values(params)

    @classmethod
    def plugged(cls, params: Any) -> list[tuple[str, str]]:
        """What `params` name that other distributions may bring: groups of entry points, names in them."""
        return []

    @classmethod
    def conclusions(cls, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
        """What a command says of the stage at the end of a run: a word and its text, out of run.json."""
        return []

    @classmethod
    def plans(cls, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
        """What a dry run says of the stage: a word and its text, out of what run.json would hold so far."""
        return []

    @classmethod
    def shortcoming(cls, summary: Mapping[str, Any]) -> str:
        """Why a strict run fails on what the stage found, out of run.json; nothing if it doesn't."""
        return ""

    @abstractmethod
    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """The outputs by name. Everything it reports or writes goes by way of `context`."""
