"""What is given of a survey: the folder of frames, the files next to it and how they are to be taken."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pyproj import CRS

from geomosaic.arrays import Floats
from geomosaic.camera.interior import Camera
from geomosaic.geodesy.heights import height_datum_in_metres
from geomosaic.survey.camera_files import read_cameras
from geomosaic.survey.control import ControlFile, read_control
from geomosaic.survey.folder import frame_files
from geomosaic.survey.names import FrameNames
from geomosaic.survey.places import NOWHERE
from geomosaic.survey.pos import read_pos
from geomosaic.survey.pos_row import PosFile


@dataclass(frozen=True)
class SurveyInputs:
    """Files of a survey, as docs/inputs.md describes them, and options of reading them.

    frames: the folder. pos, camera, dem, gcp: files. dem_offset_m: what is added to the DEM's values to have
    ellipsoidal heights. gcp_optional: a gcp of which no point can be used is a warning. crs: the map's,
    `auto` for the UTM zone of the middle. pos_crs: of x and y in pos, and in a gcp
    that states none. attitude_convention: one of `attitude.CONVENTIONS`. damaged: one of `usable.DAMAGED`.
    leave_out: one of `strays.LEAVE_OUT`.
    camera_kind: of the aircraft's cameras, see `strays.camera_kind`; several with a + between them. every:
    one frame of so many is used. height_datum: what heights count from whose source doesn't state it, a name
    for `height_datum_in_metres`. strict: unusable frames, frames without a line in pos and lines
    without a frame are errors. radiometry: one of `reflectance.RADIOMETRY`. panel: photos of reflectance
    panels, IMAGE=ALBEDO between commas, a number or the file of a table.
    """

    frames: Path
    pos: Path | None = None
    camera: Path | None = None
    dem: Path | None = None
    dem_offset_m: float | None = None
    gcp: Path | None = None
    gcp_optional: bool = False
    crs: str = "auto"
    pos_crs: str | None = None
    attitude_convention: str = "auto"
    damaged: str = "leave_out"
    leave_out: str = "auto"
    camera_kind: str | None = None
    every: int = 1
    height_datum: str | None = None
    strict: bool = False
    radiometry: str = "none"
    panel: str | None = None

    @property
    def files(self) -> dict[str, Path]:
        """The given files by kind, without the folder of frames."""
        given = {"pos": self.pos, "camera": self.camera, "dem": self.dem, "gcp": self.gcp}
        tables = {image: Path(albedo) for image, albedo in self.panels.items() if Path(albedo).is_file()}
        return {kind: path for kind, path in given.items() if path is not None} | tables

    @property
    def panels(self) -> dict[str, str]:
        """What panel gives as albedo, by image."""
        texts = [text.rpartition("=") for text in (self.panel or "").split(",") if text.strip()]
        return {image.strip(): albedo.strip() for image, _, albedo in texts}

    def frame_files(self) -> dict[Path, str]:
        """The frames' files and what each is called, see `folder.frame_files`."""
        return frame_files(self.frames, self.files.values())

    @property
    def datum(self) -> CRS | None:
        """What heights count from whose source doesn't state it: a vertical CRS, or one with ellipsoidal
        heights; None if nothing is known of it. Raises: `InputError` for another name."""
        return None if self.height_datum is None else height_datum_in_metres(self.height_datum)

    def positions(self, frames: FrameNames) -> PosFile | None:
        """The POS file of these frames, None where none is given."""
        if self.pos is None:
            return None
        convention = self.attitude_convention
        return read_pos(
            self.pos, crs=self.pos_crs, attitude_convention=convention, frames=frames, datum=self.datum
        )

    def cameras(self) -> tuple[Camera, ...]:
        """Cameras of the camera file, () where none is given."""
        return () if self.camera is None else read_cameras(self.camera)

    def control(self, frames: FrameNames, near: Floats = NOWHERE) -> ControlFile | None:
        """The file of control points, None where none is given. Args: near: longitudes and latitudes (k, 2)
        of the frames."""
        return None if self.gcp is None else read_control(self.gcp, frames, near, self.datum, self.pos_crs)
