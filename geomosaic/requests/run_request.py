"""What every run can be asked for, and how a request becomes a recipe."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from geomosaic.errors import InputError, UnknownNameError
from geomosaic.requests.option import (
    OUTPUT,
    RARE,
    RUNNING,
    Option,
    asked,
    checked,
    folder_given,
    kinds_of,
    option_of,
)

if TYPE_CHECKING:
    from geomosaic.pipeline.recipe import Recipe
    from geomosaic.pipeline.replayed_stage import ReplayedStage
    from geomosaic.pipeline.run_options import RunOptions
    from geomosaic.recording.file.levels import RecordOptions

Parameters = dict[str, dict[str, Any]]
DASK: Final = Option("compute on this Dask cluster instead of this machine", "tcp://HOST:PORT", RARE)


def cores() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Job:
    """A checked recipe, the folder of its run, and how it works. strict: whether a poor result is an error.

    given: results of its first stages from a recording, by their number. left_out: what cannot be done, and
    why.
    """

    recipe: Recipe
    folder: Path
    how: RunOptions
    strict: bool
    given: Mapping[int, ReplayedStage] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RunRequest(ABC):
    """Where a run goes, how it works, and how much is recorded of it.

    Raises: `InputError` for a value of another type or out of bounds.
    """

    output: Path | None = asked(
        Option(
            "folder to write the run to [next to the input, such as INPUT-mosaic]",
            "RUN",
            OUTPUT,
            flags=("-o", "--output"),
            parse=folder_given,
            toolbox=False,
        )
    )
    overwrite: bool = asked(
        Option("write into a folder that holds other files; results may replace them", None, OUTPUT), False
    )
    set: tuple[str, ...] = asked(
        Option(
            "set a parameter of a stage ('geomosaic stages' lists them); may be repeated",
            "STAGE.PARAM=VALUE",
            RARE,
            toolbox=False,
        ),
        (),
    )
    workers: int | None = asked(
        Option("number of worker processes [one per core]", "N", RUNNING, least=1, most=1024)
    )
    fixed_time: bool = asked(
        Option("leave clock times out of the recording, so that equal runs give equal bytes", None, RARE),
        False,
    )
    record: str = asked(
        Option(
            "content of run.mcap: off writes none; summary holds figures; normal also images and what a "
            "replay needs; full also the tie points of each pair",
            "off|summary|normal|full",
            RARE,
        ),
        "normal",
    )

    def __post_init__(self) -> None:
        kinds = kinds_of(type(self))
        for its in fields(self):
            value = checked(its.name, option_of(its), kinds[its.name], getattr(self, its.name))
            object.__setattr__(self, its.name, value)

    @abstractmethod
    def recipe(self) -> Recipe:
        """The checked recipe. Raises: `InputError` for what cannot be used."""

    @abstractmethod
    def folder(self, recipe: Recipe) -> Path:
        """Where its run goes: what is asked for, or a folder next to the input."""

    def job(self) -> Job:
        """What the request comes to. Raises: `InputError` for what cannot be used."""
        how, recipe = self.how(), self.recipe()
        return Job(recipe, self.folder(recipe), how, self.is_strict)

    def how(self) -> RunOptions:
        """How the run works. Raises: `UnknownNameError` for another level of recording."""
        from geomosaic.pipeline.run_options import RunOptions

        return RunOptions(
            workers=self.workers or cores(),
            dask=self.cluster,
            fixed_time=self.fixed_time,
            overwrite=self.overwrite,
            incremental=self.goes_on,
            record=self.recorded(),
        )

    @property
    def is_strict(self) -> bool:
        """Whether a poor result is an error."""
        return False

    @property
    def goes_on(self) -> bool:
        """Whether it goes on from the finished run in its folder."""
        return False

    @property
    def cluster(self) -> str | None:
        """The address of a Dask cluster that computes."""
        return None

    def parameters(self) -> Parameters:
        """The values that are given, by stage and parameter."""
        found: Parameters = {}
        for its in fields(self):
            value, option = getattr(self, its.name), option_of(its)
            if option.sets and value is not None and value is not False:
                stage, _, name = option.sets.rpartition(".")
                found.setdefault(stage, {})[name] = option.value or value
        return found

    def recorded(self) -> RecordOptions:
        """How the run is recorded. Raises: `UnknownNameError` for another level."""
        return record_options(self.record)

    def prepare(self, stages: Iterable[str]) -> None:
        """Has workers made ready, if there are to be some on this machine, while the recipe is read."""
        from geomosaic.pipeline.entry_points import modules_of
        from geomosaic.pipeline.worker_process import prepare_workers

        if self.cluster is None and (self.workers or cores()) > 1:
            prepare_workers(modules_of(stages))


@dataclass(frozen=True, kw_only=True)
class NewRunRequest(RunRequest, ABC):
    """A run from the beginning, not from a recording."""

    seed: int | None = asked(Option("seed of all random numbers", "N", RARE, least=0))
    private: bool = asked(
        Option("leave folders, user and host out of the recording, so that it can be shared", None, RARE),
        False,
    )
    private_places: bool = asked(
        Option(
            "what --private does, and move all places by a secret offset; the recording cannot be replayed, "
            "and its images still show the ground",
            None,
            RARE,
        ),
        False,
    )
    live: bool = asked(Option("show the run in Rerun while it works", None, RARE, toolbox=False), False)

    def recorded(self) -> RecordOptions:
        """How the run is recorded. Raises: `UnknownNameError` for another level, `InputError` if nothing is
        to be recorded and shown."""
        return record_options(self.record, self.private, self.private_places, self.live)


def record_options(
    record: str, private: bool = False, private_places: bool = False, live: bool = False
) -> RecordOptions:
    """How a run is recorded. Raises: `UnknownNameError` for another level, `InputError` if nothing is to be
    recorded and shown."""
    from geomosaic.recording.file.levels import LEVELS, RecordOptions

    if record not in LEVELS:
        raise UnknownNameError("level of --record", record, LEVELS)
    if live and record == "off":
        raise InputError("--live shows what is recorded", fix="leave out --record off")
    return RecordOptions(record, private, private_places, live)


def recipe_of(
    named: tuple[str, str],
    stages: Sequence[str],
    given: Mapping[str, Mapping[str, Any]],
    seed: int | None = None,
    sets: Sequence[str] = (),
) -> Recipe:
    """The checked recipe of some stages. named: its name and description; given: parameters by stage, also of
    stages that are not among these."""
    from geomosaic.pipeline.recipe import recipe_from
    from geomosaic.pipeline.registry import installed

    steps = [{"stage": id, "params": dict(given.get(id, {}))} for id in stages]
    plain = {"name": named[0], "description": named[1], "seed": seed or 0, "stages": steps}
    return recipe_from(plain, installed(), sets)


def override(parameter: str, value: Any) -> str:
    """STAGE.PARAMETER=VALUE as `--set` takes it. A path that YAML takes for nothing becomes absolute."""
    if isinstance(value, Path) and str(value).lower() == "null":
        value = value.absolute()
    return f"{parameter}={value}"


def default_folder(given: Path, what: str) -> Path:
    """The run folder where none is given: `FRAMES-mosaic` next to `FRAMES`."""
    place = given if given.name not in ("", "..") else given.resolve()
    if not place.name:
        raise InputError("no run folder can lie next to it", file=given, fix="give the run folder with -o")
    return place.with_name(f"{place.stem if place.is_file() else place.name}-{what}")
