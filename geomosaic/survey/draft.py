"""A survey while it is read: what the steps of `survey.read` have found so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.interior import Camera
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import LOCAL_CRS
from geomosaic.radiometry.calibration import Calibration
from geomosaic.radiometry.quantity import Quantity
from geomosaic.survey.cameras import CameraChoice, cameras_from_headers
from geomosaic.survey.cameras_of_file import cameras_from_file
from geomosaic.survey.extent import lonlat_of
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import (
    Band,
    ControlPoint,
    ElevationModel,
    Frame,
    Position,
    Survey,
    UnusedImage,
    Warn,
)
from geomosaic.survey.observations import Observations
from geomosaic.survey.places import NOWHERE
from geomosaic.survey.pos_row import PosFile
from geomosaic.survey.rig import CaptureGroups, incomplete_captures
from geomosaic.survey.strays import Stray, stray_warnings
from geomosaic.survey.usable import Usable

_NO_PLACE = (
    "no frame has a position and there are no control points: the mosaic has no place on the Earth and no "
    "north; its scale is that of the reported heights above the ground, else of a flight at 120 m; give "
    "--pos or --gcp to have a map"
)


@dataclass(frozen=True)
class SurveyDraft:
    """A survey while it is read; what no step has read yet is empty.

    pos, camera_file: of the files that are given. usable: the folder's frames that can be read. headers: of
    the survey's frames, in order; in_time: whether that is the order of capture. rig: where its cameras write
    a file a band. strays: frames that don't belong to the survey. observed, choice: by frame, as headers.
    heights_m: ellipsoidal, of the DEM under the frames. map_crs: `LOCAL_CRS` without a place on the Earth.
    calibrations: by the frame's path; quantities: what values mean, by band. The warnings are those of the
    step that their name tells.
    """

    inputs: SurveyInputs
    pos: PosFile | None
    camera_file: tuple[Camera, ...]
    usable: Usable
    headers: tuple[FrameHeader, ...]
    in_time: bool
    rig: CaptureGroups | None = None
    strays: tuple[Stray, ...] = ()
    calibrations: Mapping[str, Calibration] = field(default_factory=dict)
    quantities: Mapping[str, Quantity] = field(default_factory=dict)
    observed: Observations = field(default_factory=Observations)
    control: tuple[ControlPoint, ...] = ()
    choice: CameraChoice = field(default_factory=CameraChoice)
    elevation: ElevationModel | None = None
    heights_m: Floats = field(default_factory=lambda: np.array([]))
    work_frame: LocalFrame = field(default_factory=lambda: LocalFrame(0.0, 0.0, 0.0))
    map_crs: str = LOCAL_CRS
    frames: tuple[Frame, ...] = ()
    other_bands: tuple[Band, ...] = ()
    folder_warnings: tuple[Warn, ...] = ()
    control_warnings: tuple[Warn, ...] = ()
    dem_warnings: tuple[Warn, ...] = ()
    crs_warnings: tuple[Warn, ...] = ()

    @property
    def names(self) -> list[str]:
        """Of the frames, in order."""
        return [header.name for header in self.headers]

    @property
    def left_out(self) -> tuple[UnusedImage, ...]:
        """The folder's images that aren't used, and why."""
        return (*self.usable.left_out, *(out for _, out in self.strays))

    @property
    def other_images(self) -> dict[str, str]:
        """The folder's images that are no frames, each with the frame that it was taken with, '' for none."""
        rig = self.rig
        found = {header.name: "" for header in rig.incomplete} if rig else {}
        for files in rig.others.values() if rig else ():
            found |= {file.header.name: own for own, file in files.items()}
        return found | {image.name: "" for image in self.left_out}

    @property
    def located(self) -> list[Position]:
        """The positions that were observed."""
        return [position for position in self.observed.positions if position.known]

    @property
    def lonlat(self) -> Floats:
        """Longitudes and latitudes (n, 2) of the observed positions, of all where none was observed."""
        return lonlat_of(self.located or self.observed.positions)

    @property
    def near(self) -> Floats:
        """Longitudes and latitudes (n, 2) of the observed positions."""
        return lonlat_of(self.located) if self.located else NOWHERE

    @property
    def without_place(self) -> bool:
        """Whether nothing says where on the Earth the survey lies."""
        return not self.located and not self.control

    @property
    def band(self) -> str:
        """What the frames show, '' where they are no rig's."""
        return "" if self.rig is None else self.rig.own[0].band

    def cameras_of(self, headers: Sequence[FrameHeader], named: Sequence[str | None]) -> CameraChoice:
        """The camera file's cameras of frames, else those of their tags. named: as the POS file has them."""
        if self.inputs.camera is None:
            return cameras_from_headers(headers)
        return cameras_from_file(headers, self.camera_file, self.inputs.camera, named)

    def survey(self) -> Survey:
        """The survey that was read."""
        return Survey(
            frames=self.frames,
            cameras=self.choice.cameras,
            work_frame=self.work_frame,
            map_crs=self.map_crs,
            elevation=self.elevation,
            control=self.control,
            left_out=self.left_out,
            band=self.band,
            quantity=self.quantities.get(self.band),
            other_bands=self.other_bands,
            warnings=self._warnings(),
        )

    def _warnings(self) -> tuple[Warn, ...]:
        by_name = "frames without a time: all go by their names; rename them if they flew otherwise"
        return (
            *self.folder_warnings,
            *([] if self.rig is None else incomplete_captures(self.rig, self.names)),
            *([Warn("local-frame", "", _NO_PLACE)] if self.without_place else []),
            *self.usable.warnings,
            *stray_warnings(self.strays),
            *([] if self.in_time else [Warn("order-by-name", "", by_name)]),
            *self.crs_warnings,
            *self.observed.warnings,
            *self.choice.warnings,
            *self.dem_warnings,
            *self.control_warnings,
        )
