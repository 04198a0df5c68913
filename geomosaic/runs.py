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
import io
import json
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.errors import FileError
from geomosaic.pipeline.finished import load_artefact, read_summary
from geomosaic.pipeline.recipe import RECORDING, RUN_JSON
from geomosaic.pipeline.registry import installed

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

    from geomosaic.recording.model import Recording

Name = str | Path
Sets = Mapping[str, object] | Sequence[str]
_TEXTS = ("frame", "status")


@dataclass(frozen=True)
class Judgement:
    """Whether the map can be trusted: good, doubtful or bad; why, and what would mend it."""

    grade: str
    text: str
    mend: str


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
        told = self.summary.get("verdict")
        if told is None:
            return None
        return Judgement(told["grade"], f"{told['cause']}; {told['text']}".removeprefix("; "), told["mend"])

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
            raise FileError(
                f"this run made no '{name}'", file=self.folder, mend=f"it made {', '.join(kinds)}"
            )
        return load_artefact(self.folder, self.summary, name, kinds[name])

    def _file(self, name: str) -> Path:
        path = self.files.get(name)
        if path is None:
            raise FileError(f"holds no {name}", file=self.folder, mend=f"it holds {', '.join(self.files)}")
        return path

    def __repr__(self) -> str:
        judged = self.verdict
        return f"Run({str(self.folder)!r}{f', {judged.grade}: {judged.text}' if judged else ''})"

    def _repr_html_(self) -> str:
        """A notebook's view: the mosaic, and whether it can be trusted."""
        from geomosaic.report.glance import glance

        picture = glance(self._file("mosaic")).uri
        judged = self.verdict
        line = f"<b>{html.escape(judged.grade)}</b>: {html.escape(judged.text)}" if judged else ""
        image = f'<img src="{picture}" style="max-width:100%;max-height:40em" alt="the mosaic">'
        return f"<figure>{image}<figcaption>{line}</figcaption></figure>"


def mosaic(
    frames: Name,
    output: Name | None = None,
    *,
    pos: Name | None = None,
    camera: Name | None = None,
    dem: Name | None = None,
    gcp: Name | None = None,
    aoi: Name | None = None,
    align_to: Name | None = None,
    reference: Name | None = None,
    crs: str = "auto",
    gsd: float | str = "auto",
    adjust: str | None = None,
    set: Sets = (),
    workers: int | None = None,
    seed: int | None = None,
    strict: bool = False,
    overwrite: bool = False,
    progress: bool = False,
    **more: Any,
) -> Run:
    """`geomosaic mosaic`: one map-true mosaic of a folder of frames, in `output` (or beside the frames).

    Args: set: any stage's parameters, {"matching.sift.keypoints": 3000}; more: the command's other options,
    as they stand there; progress: shown on stderr.
    Raises: what the command says in one line, as one of `geomosaic.errors`.

    >>> run = gm.mosaic(folder / "frames", folder / "again", set={"matching.sift.keypoints": 3000}, workers=1)
    >>> run.verdict.grade
    'good'
    """
    from geomosaic.cli.mosaic import mosaic as command
    from geomosaic.cli.options import beside

    place = Path(output) if output is not None else beside(Path(frames), "mosaic")
    files = {
        "pos": pos, "camera": camera, "dem": dem, "gcp": gcp, "aoi": aoi, "align_to": align_to,
        "reference": reference,
    }  # fmt: skip
    given: dict[str, Any] = {name: None if path is None else Path(path) for name, path in files.items()}
    given |= {"crs": crs, "gsd": str(gsd), "adjust": adjust, "set": _sets(set), "strict": strict, **more}
    given |= {"workers": workers, "seed": seed, "overwrite": overwrite, "quiet": not progress}
    with redirect_stdout(io.StringIO()):
        command(Path(frames), place, **given)
    return Run(place)


def strips(
    geometry: Name,
    output: Name | None = None,
    *,
    method: str | None = None,
    map: bool = False,
    set: Sets = (),
    workers: int | None = None,
    seed: int | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Run:
    """`geomosaic strips`: one scene of the strips of staggered CCDs. Arguments: as `mosaic`."""
    from geomosaic.cli.options import beside
    from geomosaic.cli.strips import strips as command

    place = Path(output) if output is not None else beside(Path(geometry), "scene")
    with redirect_stdout(io.StringIO()):
        command(
            Path(geometry), place, method, map, _sets(set), workers,
            seed=seed, overwrite=overwrite, quiet=not progress,
        )  # fmt: skip
    return Run(place)


def run(
    recipe: Name,
    input: Name | None = None,
    output: Name | None = None,
    *,
    set: Sets = (),
    workers: int | None = None,
    seed: int | None = None,
    strict: bool = False,
    overwrite: bool = False,
    progress: bool = False,
) -> Run:
    """`geomosaic run`: a recipe's file, or the name of one that is there. Arguments: as `mosaic`."""
    from geomosaic.cli.options import beside
    from geomosaic.cli.run import run as command
    from geomosaic.pipeline.named import recipe_path

    stem = recipe_path(str(recipe)).stem.replace("_", "-")
    place = Path(output) if output is not None else beside(Path(input or recipe), stem)
    with redirect_stdout(io.StringIO()):
        command(
            str(recipe), None if input is None else Path(input), place, set=_sets(set), workers=workers,
            seed=seed, strict=strict, overwrite=overwrite, quiet=not progress,
        )  # fmt: skip
    return Run(place)


def replay(
    recording: Name | Run, output: Name, *, start: str = "", set: Sets = (), workers: int | None = None
) -> Run:
    """`geomosaic replay`: a recorded run again from stage `start` on, or from the first that `set` changes.

    >>> again = gm.replay(run, folder / "chain", set={"adjustment.solve.method": "chain"}, workers=1)
    >>> again.summary["recorded_stages"][-1]
    'matching.sift'
    """
    from geomosaic.cli.recordings import replay as command

    source = recording.folder if isinstance(recording, Run) else Path(recording)
    with redirect_stdout(io.StringIO()):
        command(source, Path(output), start, _sets(set), workers)
    return Run(output)


def open_run(folder: Name) -> Run:
    """A run that was finished before."""
    return Run(folder)


def stages() -> dict[str, dict[str, Any]]:
    """What `geomosaic stages --json` says of each stage that works, by id: inputs, outputs, parameters.

    >>> gm.stages()["adjustment.solve"]["outputs"]
    {'adjusted': 'Adjusted', 'ground': 'GroundSurface'}
    """
    from geomosaic.cli.stages import describe

    return {stage.id: describe(stage) for stage in installed().all()[0]}


def _sets(values: Sets) -> list[str]:
    if not isinstance(values, Mapping):
        return list(values)
    return [f"{k}={v if isinstance(v, str | Path) else json.dumps(v)}" for k, v in values.items()]
