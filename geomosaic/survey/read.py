"""The front door: a folder of frames, and the files next to it, become a `Survey`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Final

from geomosaic.errors import InputError
from geomosaic.geodesy.crs_names import AmbiguousCrsError
from geomosaic.geodesy.mapcrs import map_crs
from geomosaic.survey.control_use import check_marks
from geomosaic.survey.draft import SurveyDraft
from geomosaic.survey.elevation import check_dem
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Survey
from geomosaic.survey.names import FrameNames
from geomosaic.survey.read_frames import (
    Progress,
    readable_frames,
    thinned,
    with_bands,
    with_cameras,
    with_frames,
    with_observations,
    with_temperatures,
    without_other_cameras,
    without_strays,
)
from geomosaic.survey.read_place import with_control, with_elevation, with_map_crs, with_work_frame
from geomosaic.survey.reflectance import with_reflectance
from geomosaic.survey.usable import Inspect, inspect_all
from geomosaic.survey.zone import proposing_zone

PROCEDURE: Final[tuple[Callable[[SurveyDraft], SurveyDraft], ...]] = (
    with_temperatures,
    without_other_cameras,
    with_reflectance,
    without_strays,
    thinned,
    with_observations,
    with_control,
    with_cameras,
    with_elevation,
    with_work_frame,
    with_map_crs,
    with_frames,
    with_bands,
)
"""The steps after the folder is read, each a function of the survey so far."""


def check_survey_files(inputs: SurveyInputs) -> None:
    """Raises what `read_survey` would raise without opening a frame: of a survey's files each by itself."""
    files, _ = inputs.frame_files(), inputs.datum
    if inputs.attitude_convention != "auto" and inputs.pos is None:
        raise InputError("--attitude has an effect only on angles of a POS file", fix="add --pos FILE")
    names = FrameNames(files.values())
    near: list[tuple[float, float]] = []
    with proposing_zone(files, near):
        if inputs.crs != "auto":
            with suppress(AmbiguousCrsError):  # decided by the frames' positions when these are read
                map_crs(inputs.crs)
        if (pos := inputs.positions(names)) is not None:
            near += [(row.lon_deg, row.lat_deg) for row in pos.rows]
        inputs.cameras()
        if inputs.dem is not None:
            check_dem(inputs.dem)
        with suppress(AmbiguousCrsError):
            control = inputs.control(names)
            if control is not None and not inputs.gcp_optional:
                check_marks(control)


def read_survey(
    inputs: SurveyInputs, *, inspect: Inspect = inspect_all, progress: Progress | None = None
) -> Survey:
    """Read everything a survey is made of; nothing is written. Every frame is decoded once, small.

    Frames are those of `frame_files`, in order of capture (time, then name; by name alone where a frame has
    no time). The work frame lies at the median position, at the median height of the ground. That height is
    the DEM's, else it is by absolute less relative heights, else by control, else 0. Where no frame has a
    position it lies amid the control points; without those it is nowhere, and the map's CRS is `LOCAL_CRS`.

    Args: inspect: `damage.wholeness` of many frames; progress: called with frames done, frames in all, and
    what is being done.
    Raises: `InputError` and `FileError`, one line that names the file and the fix.
    """
    survey = readable_frames(inputs, inspect, progress)
    for step in PROCEDURE:
        survey = step(survey)
    return survey.survey()
