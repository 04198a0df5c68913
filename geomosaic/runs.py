"""geomosaic from Python: commands as functions that return a `Run`, whose attributes are the run's products.

>>> run = gm.open_run(folder / "run")
>>> run
Run('...', good: 4 of 4 frames tied, ...)
>>> run.mosaic.crs.to_epsg(), run.mosaic.count
(32632, 3)
>>> run.frames["frame"].tolist()
['F0001.jpg', 'F0002.jpg', 'F0003.jpg', 'F0004.jpg']
>>> bool((run.frames["sd_e_m"] < 10.0).all())
True
>>> run.figures["adjustment"]["reprojection_mean_px"] < 0.5
True
>>> sorted(run.files)[:3]
['accuracy', 'accuracy_report', 'layers']
"""

from __future__ import annotations

import csv
import html
import inspect
import json
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2  # noqa: F401  writes to the environment as it loads, which no call may do
import numpy as np
import rasterio  # noqa: F401  likewise
from numpy.typing import NDArray

from geomosaic.errors import FileError, UnknownNameError
from geomosaic.pipeline.recipe import RECORDING, RUN_JSON
from geomosaic.pipeline.registry import installed
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.naming import in_python, named_as_arguments
from geomosaic.requests.option import kinds_of, option_of
from geomosaic.requests.perform import check_result, perform
from geomosaic.requests.recipe_request import RecipeRequest
from geomosaic.requests.replay_request import ReplayRequest
from geomosaic.requests.run_request import RunRequest
from geomosaic.requests.strips_request import StripsRequest

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

    from geomosaic.pipeline.reporter import Reporter
    from geomosaic.recording.file.model import Recording

Name = str | Path
_TEXTS = ("frame", "status")


@dataclass(frozen=True)
class Judgement:
    """Whether the map can be trusted: good, doubtful or bad; why, and what would fix it."""

    grade: str
    text: str
    fix: str

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> str:
            """`fix` by its former name, for one release."""
            if name != "mend":
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            warnings.warn("Judgement.mend is Judgement.fix now", DeprecationWarning, stacklevel=2)
            return self.fix


class Run:
    """A finished run.

    folder: where it lies; summary: what its run.json holds. The rest is read when it is first asked for.
    Raises: `FileError` for a folder that is no finished run.
    """

    def __init__(self, folder: Name) -> None:
        self.folder = Path(folder).absolute()
        self.summary: dict[str, Any] = read_summary(self.folder)

    @property
    def files(self) -> dict[str, Path]:
        """Its results by name: mosaic, sources, layers, positions, report, recording, ..."""
        steps = self.summary["recipe"]["stages"]
        names = [name for step in steps for name in installed().get(step["stage"]).results]
        found: dict[str, Path] = {}
        for file in (*names, RECORDING):
            name = "recording" if file == RECORDING else Path(file).stem
            if (self.folder / file).exists():
                found[file if name in found else name] = self.folder / file
        return found | {"summary": self.folder / RUN_JSON}

    @cached_property
    def mosaic(self) -> DatasetReader:
        """mosaic.tif as a rasterio dataset, open."""
        from geomosaic.doors.raster import OWN, open_raster

        return open_raster(self._file("mosaic"), OWN)

    @cached_property
    def frames(self) -> NDArray[Any]:
        """positions.csv as a table: numpy's structured array (n,) of the file's columns, NaN where empty.

        `pandas.DataFrame(run.frames)` makes a data frame of it.
        """
        with self._file("positions").open(encoding="utf-8", newline="") as file:
            head, *rows = csv.reader(file)
        kinds = [(name, "U256" if name in _TEXTS else "f8") for name in head]
        texts = [name in _TEXTS for name in head]
        cells = [
            tuple(c if text else float(c or "nan") for c, text in zip(row, texts, strict=True))
            for row in rows
        ]
        return np.array(cells, dtype=kinds)

    @property
    def verdict(self) -> Judgement | None:
        """Whether it can be trusted; None of a run that doesn't judge itself."""
        verdict = self.summary.get("verdict")
        if verdict is None:
            return None
        fix = verdict["fix"] if "fix" in verdict else verdict["mend"]
        text = f"{verdict['cause']}; {verdict['text']}".removeprefix("; ")
        return Judgement(verdict["grade"], text, fix)

    @property
    def figures(self) -> dict[str, Any]:
        """What was measured, as run.json's `metrics` has it."""
        metrics: dict[str, Any] = self.summary["metrics"]
        return metrics

    @property
    def warnings(self) -> list[dict[str, str]]:
        """What was assumed or doubtful: code, frame (or ""), text."""
        warnings: list[dict[str, str]] = self.summary["warnings"]
        return warnings

    @property
    def recording(self) -> Recording:
        """What every stage was given, made and saw."""
        from geomosaic.recording import read_recording

        return read_recording(self._file("recording"))

    def artefact(self, name: str) -> Any:
        """What a stage made, by its name: `survey`, `ties`, `adjusted`, `ground`, ...

        Raises: `FileError` if the run made none of that name, or holds it no more.
        """
        steps = self.summary["recipe"]["stages"]
        kinds = {n: kind for step in steps for n, kind in installed().get(step["stage"]).outputs.items()}
        if name not in kinds:
            raise FileError(f"this run made no '{name}'", file=self.folder, fix=f"it made {', '.join(kinds)}")
        return load_artefact(self.folder, self.summary, name, kinds[name])

    def _file(self, name: str) -> Path:
        path = self.files.get(name)
        if path is None:
            raise FileError(f"holds no {name}", file=self.folder, fix=f"it holds {', '.join(self.files)}")
        return path

    def __repr__(self) -> str:
        judged = self.verdict
        return f"Run({str(self.folder)!r}{f', {judged.grade}: {judged.text}' if judged else ''})"

    def _repr_html_(self) -> str:
        """A notebook's view: the mosaic where there is one, and whether it can be trusted."""
        from geomosaic.report.glance import glance

        its = self.verdict
        line = f"<b>{html.escape(its.grade)}</b>: {html.escape(its.text)}" if its else ""
        if "mosaic" not in self.files:
            return f"<p>{html.escape(str(self.folder))} {line}</p>"
        image = f'<img src="{glance(self.files["mosaic"]).uri}" alt="the mosaic" style="max-width:100%">'
        return f"<figure>{image}<figcaption>{line}</figcaption></figure>"


def mosaic(frames: Name, output: Name | None = None, *, progress: bool = False, **options: Any) -> Run:
    """`geomosaic mosaic`: one map-true mosaic of a folder of frames, in `output` (or next to the frames).

    >>> run = gm.mosaic(folder / "frames", folder / "again", set={"matching.sift.keypoints": 3000}, workers=1)
    >>> run.verdict.grade
    'good'
    """
    return _made(MosaicRequest, {"frames": frames, "output": output, **options}, progress)


def strips(geometry: Name, output: Name | None = None, *, progress: bool = False, **options: Any) -> Run:
    """`geomosaic strips`: one scene of the strips of staggered CCDs."""
    return _made(StripsRequest, {"geometry": geometry, "output": output, **options}, progress)


def run(
    recipe: Name,
    input: Name | None = None,
    output: Name | None = None,
    *,
    progress: bool = False,
    **options: Any,
) -> Run:
    """`geomosaic run`: a recipe's file, or the name of one that comes with geomosaic."""
    given = {"name": str(recipe), "input": input, "output": output, **options}
    return _made(RecipeRequest, given, progress)


def replay(recording: Name | Run, output: Name, *, progress: bool = False, **options: Any) -> Run:
    """`geomosaic replay`: a recorded run again from stage `start` on, or from the first that `set` changes.

    >>> again = gm.replay(run, folder / "chain", set={"adjustment.solve.method": "chain"}, workers=1)
    >>> again.summary["recorded_stages"][-1]
    'matching.sift'
    """
    given = {"recording": getattr(recording, "folder", recording), "output": output, **options}
    return _made(ReplayRequest, given, progress)


def _made(kind: type[RunRequest], options: Mapping[str, Any], progress: bool) -> Run:
    """The run of a request. Raises: `UnknownNameError` for an option that it does not have."""
    known = {its.name for its in fields(kind)}
    for name in options:
        if name not in known:
            raise UnknownNameError("argument", name, known)
    with named_as_arguments(kind), _reporter(progress) as reporter:
        job = kind(**{**options, "set": _sets(options.get("set", ()))}).job()
        check_result(job, perform(job, reporter))
    return Run(job.folder)


@contextmanager
def _reporter(progress: bool) -> Iterator[Reporter]:
    """Shows progress on stderr, or nothing."""
    from geomosaic.pipeline.reporter import Silent

    if not progress:
        yield Silent()
        return
    from geomosaic.cli import progress as terminal

    with terminal.progress() as reporter:
        yield reporter


def _with_options(function: Callable[..., Run], kind: type[RunRequest]) -> None:
    """Shows the options of a request in a function's signature and, with their help, in its docstring."""
    shown = inspect.signature(function).parameters
    own = [p for p in shown.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    more, lines = [], []
    for its in fields(kind):
        option = option_of(its)
        if option.heading and its.name not in shown:
            kinds = kinds_of(kind)[its.name]
            keyword = inspect.Parameter.KEYWORD_ONLY
            more.append(inspect.Parameter(its.name, keyword, default=its.default, annotation=kinds))
            lines.append(f"    {its.name}: {in_python(option.help, kind)}")
    function.__signature__ = inspect.Signature([*own, *more], return_annotation="Run")  # type: ignore[attr-defined]
    first, example, rest = (inspect.getdoc(function) or "").partition("\n\n>>>")
    listed = "\n".join(lines)
    raised = "Raises: what the command says in one line, as one of `geomosaic.errors`."
    function.__doc__ = f"{first}\n\nOptions:\n{listed}\n\n{raised}{example}{rest}"


for _function, _request in (
    (mosaic, MosaicRequest),
    (strips, StripsRequest),
    (run, RecipeRequest),
    (replay, ReplayRequest),
):
    _with_options(_function, _request)


def open_run(folder: Name) -> Run:
    """A run that was finished before."""
    return Run(folder)


def list_stages() -> dict[str, dict[str, Any]]:
    """What `geomosaic stages --json` says of each stage that works, by id: inputs, outputs, parameters.

    >>> gm.list_stages()["adjustment.solve"]["outputs"]
    {'adjusted': 'Adjusted', 'ground': 'GroundSurface'}
    """
    from geomosaic.cli.stages import describe

    return {stage.id: describe(stage) for stage in installed().all()[0]}


def _sets(values: Any) -> Any:
    """STAGE.PARAMETER=VALUE of a mapping; else the values themselves."""
    if not isinstance(values, Mapping):
        return values
    plain = {k: v.tolist() if isinstance(v, np.generic | np.ndarray) else v for k, v in values.items()}
    return [f"{k}={v if isinstance(v, str | Path) else json.dumps(v)}" for k, v in plain.items()]
