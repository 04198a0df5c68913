"""Options of `geomosaic mosaic`, under the headings of its help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geomosaic.cli.help import ACCURACY, INPUTS, OUTPUT, RARE, SURFACE
from geomosaic.cli.options import length_given, name_choices

SURFACES = ("ties", "dense")

PosPath = Annotated[
    Path | None,
    typer.Option(
        help="positions and attitudes of the frames (CSV, geo.txt) [the frames' tags]",
        metavar="FILE",
        rich_help_panel=INPUTS,
    ),
]
PosCrs = Annotated[
    str | None,
    typer.Option(help="CRS of x and y in the --pos file", metavar="EPSG:n", rich_help_panel=INPUTS),
]
CameraPath = Annotated[
    Path | None,
    typer.Option(
        help="interior orientation of the camera (cameras.json, YAML) [the frames' tags]",
        metavar="FILE",
        rich_help_panel=INPUTS,
    ),
]
DemPath = Annotated[
    Path | None,
    typer.Option(
        help="elevation model of the ground (GeoTIFF or another raster file)",
        metavar="FILE",
        rich_help_panel=INPUTS,
    ),
]
DemOffset = Annotated[
    float | None,
    typer.Option(
        help="metres to add to the DEM's heights to make them ellipsoidal",
        metavar="M",
        rich_help_panel=RARE,
    ),
]
GcpPath = Annotated[
    Path | None,
    typer.Option(
        help="control and check points with their image positions (gcp_list.txt, CSV)",
        metavar="FILE",
        rich_help_panel=INPUTS,
    ),
]
GcpOptional = Annotated[
    bool,
    typer.Option(
        "--gcp-optional",
        help="run without control points if none of --gcp can be used",
        rich_help_panel=INPUTS,
    ),
]
GroundHeight = Annotated[
    float | None,
    typer.Option(
        help="ellipsoidal height of flat ground, in metres [measured in the frames]",
        metavar="M",
        rich_help_panel=SURFACE,
    ),
]
SurfaceKind = Annotated[
    str,
    typer.Option(
        help="ground onto which frames are projected: ties is a smooth surface through the tie points, "
        "dense is matched between frames",
        metavar="|".join(SURFACES),
        rich_help_panel=SURFACE,
    ),
]
OrthoGround = Annotated[
    str | None,
    typer.Option(
        help="with --surface dense, project onto the surface (roofs in place) or the terrain below it; "
        "auto takes the surface if frames agree clearly better on it [auto]",
        metavar="auto|surface|terrain",
        rich_help_panel=SURFACE,
    ),
]
Adjust = Annotated[
    str | None,
    typer.Option(
        metavar="METHOD",
        help="adjustment method; 'geomosaic stages adjustment.solve' lists them",
        rich_help_panel=RARE,
    ),
]
NeededHorizontal = Annotated[
    float | None,
    typer.Option(
        help="horizontal RMSE that you need, such as 5cm [what the positions can give]",
        metavar="LENGTH",
        parser=length_given,
        rich_help_panel=ACCURACY,
    ),
]
NeededVertical = Annotated[
    float | None,
    typer.Option(
        help="vertical RMSE that you need, such as 10cm",
        metavar="LENGTH",
        parser=length_given,
        rich_help_panel=ACCURACY,
    ),
]
NeededRelative = Annotated[
    float | None,
    typer.Option(
        help="RMSE of distances that you need, in per mille [what the positions can give]",
        metavar="PERMILLE",
        min=0.0,
        rich_help_panel=ACCURACY,
    ),
]
MosaicReference = Annotated[
    Path | None,
    typer.Option(
        help="orthophoto or satellite image to compare the mosaic with",
        metavar="TIF",
        rich_help_panel=ACCURACY,
    ),
]
SurfaceReference = Annotated[
    Path | None,
    typer.Option(
        help="elevation model or point cloud to compare the surface of --surface dense with",
        metavar="FILE",
        rich_help_panel=ACCURACY,
    ),
]
Damaged = Annotated[
    str | None,
    typer.Option(
        help="leave_out drops damaged frames, mask only their damaged parts [leave_out]",
        metavar="leave_out|mask",
        rich_help_panel=RARE,
    ),
]
MapCrs = Annotated[
    str,
    typer.Option(
        help="map CRS of the mosaic; auto is the UTM zone",
        metavar="auto|EPSG:n",
        rich_help_panel=OUTPUT,
    ),
]
PixelSize = Annotated[
    str,
    typer.Option(
        help="pixel size of the mosaic in metres; auto is that of the frames",
        metavar="auto|M",
        rich_help_panel=OUTPUT,
    ),
]
EdgeRule = Annotated[
    str | None,
    typer.Option(
        help="trim leaves out ground seen obliquely or coarsely, or of extrapolated height; keep keeps "
        "it [trim]",
        metavar="trim|keep",
        rich_help_panel=OUTPUT,
    ),
]
Pdf = Annotated[
    bool,
    typer.Option(
        "--pdf", help="also print the report to report.pdf (needs Chromium)", rich_help_panel=OUTPUT
    ),
]


def name_methods() -> None:
    """Puts the adjustment methods into the help."""
    name_choices(Adjust, "adjustment.solve", "method")
