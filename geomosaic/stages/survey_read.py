"""The front door: a folder of frames and its companion files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from geomosaic.geodesy.local import LocalFrame
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.pipeline.stored_result import StoredResult
from geomosaic.recording.file.thumbnail import thumbnail
from geomosaic.stages.spares import spare_of
from geomosaic.survey.attitude import CONVENTIONS
from geomosaic.survey.damage import Wholeness, coarsened, looked_at
from geomosaic.survey.folder import frame_folders, project_files
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Survey
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.read import check_survey_files, read_survey
from geomosaic.survey.reflectance import RADIOMETRY
from geomosaic.survey.small import Spare
from geomosaic.survey.strays import LEAVE_OUT
from geomosaic.survey.usable import DAMAGED

_READ_AGAIN = 200
"""Frames, of those whose look for damage gave no thumbnail, that are read again for one."""


@dataclass(frozen=True)
class FirstLook:
    """What came of decoding a frame: whether it is whole; and the thumbnail of a JPEG that is, or nothing."""

    wholeness: Wholeness
    thumbnail: bytes


@dataclass(frozen=True)
class Looking:
    """A frame's file, and where what it shows small is left for others."""

    path: str
    spare: Spare


def seen(looking: Looking) -> FirstLook:
    """Decodes a frame once, for all of it. Raises: as `looked_at`."""
    wholeness, half = looked_at(looking.path)
    if half is None:
        return FirstLook(wholeness, b"")
    looking.spare.leave(half)
    return FirstLook(wholeness, thumbnail(coarsened(half, 4) if min(half.shape[:2]) >= 4 else half))


def _inputs(params: SurveyParams) -> SurveyInputs:
    """What is given, and a project's own files where none are."""
    given = params.model_dump()
    own = {kind: path for kind, path in project_files(params.frames).items() if given[kind] is None}
    return SurveyInputs(**given | own)


class SurveyParams(StageParams):
    """See each parameter's help."""

    frames: Path = param(help="folder of frames: JPEG, TIFF or PNG")
    pos: Path | None = param(None, help="positions and attitudes: CSV, geo.txt, Pix4D")
    camera: Path | None = param(None, help="interior orientation: cameras.json or YAML")
    dem: Path | None = param(None, help="elevation model: GeoTIFF and other local rasters")
    dem_offset_m: float | None = param(
        None, help="what to add to the DEM to have ellipsoidal heights", unit="m", ge=-12000, le=12000
    )
    gcp: Path | None = param(None, help="control and check points: gcp_list.txt or CSV")
    gcp_optional: bool = param(
        False, help="go on without control where no point of gcp can be used; it is an error otherwise"
    )
    crs: str = param("auto", help="the map's CRS; auto is the UTM zone of the middle")
    pos_crs: str | None = param(None, help="CRS of x and y in the POS file, and in gcp if that states none")
    attitude_convention: str = param("auto", help="what the POS file's angles mean", choices=CONVENTIONS)
    damaged: str = param(
        "leave_out",
        help="what becomes of frames whose data are damaged; mask: the part above the damage is used",
        choices=DAMAGED,
    )
    leave_out: str = param(
        "auto",
        help="images that don't belong to the survey: copies, blurred, oblique, of another flight; "
        "none: all are kept",
        choices=LEAVE_OUT,
    )
    camera_kind: str | None = param(
        None,
        help="frames of which of the aircraft's cameras are used, by their tag ImageSource: wide, zoom, "
        "thermal, ms; wide+thermal: both as bands of one mosaic, the first is adjusted; without it those "
        "that are most",
    )
    every: int = param(1, help="every how many frames one is used, in the order of exposure", ge=1)
    height_datum: str | None = param(
        None,
        help="what heights in tags, POS, DEM and control count from that state no datum: ellipsoidal, EGM96, "
        "EGM2008, or a vertical CRS such as EPSG:7837",
    )
    strict: bool = param(
        False,
        help="frames that can't be used, frames without a line in the POS file and lines without a frame "
        "are errors",
    )
    radiometry: str = param(
        "none",
        help="reflectance: values of MicaSense's, DJI's and Parrot's multispectral cameras by the makers' "
        "models, sun sensor and panels; temperature: the degrees in FLIR's JPEG frames; none: as recorded",
        choices=RADIOMETRY,
    )
    panel: str | None = param(
        None,
        help="photos of reflectance panels, IMAGE=ALBEDO between commas: a number, or a table with the "
        "columns band and albedo; without any, panels are found by their QR code",
    )


def _check(params: SurveyParams) -> None:
    """The frames' names and every companion file, but for what only the frames' headers show."""
    check_survey_files(_inputs(params))


def _files(params: SurveyParams) -> dict[str, Path]:
    """The folders that hold the frames, and their companion files."""
    files = _inputs(params).files
    folders = frame_folders(params.frames, files.values())
    return {f"frames/{name}" if name else "frames": p for name, p in folders.items()} | files


def _plans(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How many frames there are."""
    counts = summary["metrics"]["survey"]
    return [("frames", f"{counts['frames']}, {counts['left_out']} left out")]


def _work_frame(survey: Survey, context: Context) -> LocalFrame:
    """That of the run before, if most frames are the same: else all coordinates would differ for any new
    frame."""
    was: Survey | None = None if context.earlier is None else context.earlier.artefact("survey", Survey)
    if was is None or context.earlier is None or was.map_crs != survey.map_crs:
        return survey.work_frame
    same = context.earlier.unchanged({f.name: Path(f.path) for f in survey.frames})
    return was.work_frame if 2 * len(same) >= len(survey.frames) else survey.work_frame


@stage(
    "survey.read", "Read the survey", group="Survey", version=51, outputs="survey", wants_frames=True,
    check=_check, files=_files, plans=_plans, goes_on=True,
)  # fmt: skip
def survey_read(params: SurveyParams, context: Context) -> Survey:
    """Reads headers, positions, attitudes, cameras, DEM and control; decodes every frame small."""
    survey_inputs = _inputs(params)
    for name in project_files(params.frames):
        if getattr(params, name) is None:
            text = (
                f"{survey_inputs.files[name].name} in the folder of frames is used as --{name}; "
                f"give another file with --{name} if it is wrong"
            )
            context.warn("project-file", "", text)
    looks: dict[str, StoredResult[FirstLook]] = {}

    def inspect(paths: list[str]) -> list[Wholeness]:
        items = [Looking(path, spare_of(context, path, lasting=True)) for path in paths]
        looks.update(zip(paths, context.stored("looking for damage", seen, items), strict=True))
        return [looks[path].load().wholeness for path in paths]

    survey = read_survey(survey_inputs, inspect=inspect, progress=context.progress)
    survey = replace(survey, work_frame=_work_frame(survey, context))
    context.metric("survey.frames", len(survey.frames))
    context.metric("survey.left_out", len(survey.left_out))
    if survey.quantity is not None:
        context.metric("survey.values", {"are": survey.quantity.name, "by": survey.quantity.source})
    for warning in survey.warnings:
        context.warn(warning.code, warning.frame, warning.text)
    for camera in survey.cameras:
        context.recorder.camera(camera.name, camera)
    every = -(-len(survey.frames) // _READ_AGAIN)
    for k, frame in enumerate(survey.frames):
        context.check_cancelled()
        small = looks[frame.path].load().thumbnail
        if small or k % every == 0:
            shown = small or thumbnail(read_pixels(frame, 8)[0])
            context.recorder.frame_image(frame.name, shown, frame.time_s)
    return survey
