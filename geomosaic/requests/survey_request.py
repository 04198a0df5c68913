"""What is given of a survey of frames besides the folder, and how it is to be read."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass
from pathlib import Path

from geomosaic.requests.of_frames import FramesRequest
from geomosaic.requests.option import INPUTS, RARE, Option, asked


@dataclass(frozen=True, kw_only=True)
class SurveyRequest(FramesRequest, ABC):
    """A run of a survey of frames: the files next to them, and how all of it is read."""

    pos: Path | None = asked(
        Option(
            "positions and attitudes of the frames (CSV, geo.txt) [the frames' tags]",
            "FILE",
            INPUTS,
            sets="survey.read.pos",
        )
    )
    pos_crs: str | None = asked(
        Option(
            "CRS of x and y in the --pos file, and in a --gcp file that states none",
            "EPSG:n",
            INPUTS,
            sets="survey.read.pos_crs",
        )
    )
    camera: Path | None = asked(
        Option(
            "interior orientation of the camera (cameras.json, YAML) [the frames' tags]",
            "FILE",
            INPUTS,
            sets="survey.read.camera",
        )
    )
    dem: Path | None = asked(
        Option(
            "elevation model of the ground (GeoTIFF or another raster file)",
            "FILE",
            INPUTS,
            sets="survey.read.dem",
        )
    )
    dem_offset: float | None = asked(
        Option(
            "metres to add to the DEM's heights to make them ellipsoidal",
            "M",
            RARE,
            sets="survey.read.dem_offset_m",
        )
    )
    gcp: Path | None = asked(
        Option(
            "control and check points with their image positions (gcp_list.txt, CSV)",
            "FILE",
            INPUTS,
            sets="survey.read.gcp",
        )
    )
    gcp_optional: bool = asked(
        Option(
            "run without control points if none of --gcp can be used",
            None,
            INPUTS,
            sets="survey.read.gcp_optional",
        ),
        False,
    )
    height_datum: str | None = asked(
        Option(
            "what heights without a stated datum count from, in tags, --pos, --dem and --gcp, and those of "
            "the surface written [ellipsoidal]",
            "EGM96|EGM2008|EPSG:n",
            INPUTS,
            sets="survey.read.height_datum",
        )
    )
    camera_kind: str | None = asked(
        Option(
            "frames of one of the aircraft's cameras: wide, zoom, thermal; wide+thermal: of both as bands of "
            "one mosaic [the one with most files]",
            "KIND",
            RARE,
            sets="survey.read.camera_kind",
        )
    )
    every: int = asked(
        Option("use every N-th frame, in time", "N", RARE, sets="survey.read.every", least=1), 1
    )
    radiometry: str | None = asked(
        Option(
            "reflectance calibrates multispectral frames by the makers' models, sun sensor and panels; "
            "temperature reads the degrees in FLIR's JPEG frames [none]",
            "none|reflectance|temperature",
            INPUTS,
            sets="survey.read.radiometry",
        )
    )
    panel: str | None = asked(
        Option(
            "photo of a reflectance panel and its albedo, a number or a table by band; more behind commas "
            "[found by its QR code]",
            "IMAGE=ALBEDO",
            INPUTS,
            sets="survey.read.panel",
        )
    )
    damaged: str | None = asked(
        Option(
            "leave_out drops damaged frames, mask only their damaged parts [leave_out]",
            "leave_out|mask",
            RARE,
            sets="survey.read.damaged",
        )
    )
    keep_strays: bool = asked(
        Option(
            "also use images that seem not to belong to the survey: copies, blurred ones, those of another "
            "flight",
            None,
            RARE,
            sets="survey.read.leave_out",
            value="none",
        ),
        False,
    )
    attitude: str | None = asked(
        Option(
            "what the angles in the --pos file mean; 'geomosaic stages survey.read' lists the conventions",
            "NAME",
            RARE,
            sets="survey.read.attitude_convention",
            methods=True,
        )
    )
