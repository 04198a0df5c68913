"""The lines of a file of control points: OpenDroneMap's gcp_list.txt, or a table with named columns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

from geomosaic.errors import InputError
from geomosaic.geodesy.crs_names import StatedCrs, required_crs
from geomosaic.survey.column_names import Aliases
from geomosaic.survey.head import has_numbers, names_known, read_head
from geomosaic.survey.names import FrameNames
from geomosaic.survey.places import check_columns, given_crs
from geomosaic.survey.pos import ALIASES as POS_ALIASES
from geomosaic.survey.table import Line, ParsedTable, is_number, read_lines, read_table, split

ALIASES: Final[Aliases] = {
    "name": (
        "name", "point", "point_name", "point_number", "gcp", "gcp_name", "label", "id", "point_id",
        "pointid", "gcp_label", "gcp_id", "pt", "station",
    ),
    **{
        c: POS_ALIASES[c]
        for c in (
            "lon", "lat", "lon_ref", "lat_ref", "x", "y",
            "height_ellipsoidal", "height_orthometric", "height", "sd_horizontal",
            "sd_vertical", "sd_e", "sd_n",
        )
    },
    "sd": ("sd", "sigma", "accuracy", "precision", "std", "stdev", "standard_deviation", "rms", "rmse"),
    "kind": ("kind", "type", "role"),
    "image": ("image", "frame", "image_name", "file", "filename", "photo"),
    "col": ("col", "column", "im_x", "pixel_x", "image_x", "px"),
    "row": ("row", "line", "im_y", "pixel_y", "image_y", "py"),
}  # fmt: skip
"""Columns of a table of control points; a point has one line per image it was measured in, or one."""

OR_POS_CRS: Final = ", or give it with --pos-crs"
GIVE_CRS: Final = (
    f"write the EPSG code of x and y in the first line of the --gcp file, such as EPSG:n{OR_POS_CRS}"
)
_GCP_LIST: Final = ("x", "y", "height", "col", "row", "image", "name")


def control_table(
    path: Path, frames: FrameNames, crs: str | None = None
) -> tuple[ParsedTable, StatedCrs | None]:
    """A table with a line per measurement or point, and the CRS of x and y.

    Args: crs: of x and y, where neither the file's first line nor a .prj file of the same name states one.
    Raises: `InputError` naming the file, the line and the fix.
    """
    lines = read_lines(path, "measurements")
    if not lines:
        raise InputError("the file of control points is empty", file=path, fix="give a line per measurement")
    stated, lines = read_head(path, lines, ALIASES, GIVE_CRS)
    stated = stated or given_crs(path, None, GIVE_CRS)
    if stated is None and crs is not None:
        stated = required_crs(crs, GIVE_CRS)
    lines = [line if line.comment else replace(line, text=frames.quoted(line.text)) for line in lines]
    if lines and not has_numbers(lines[0]) and any(names_known(lines[0], ALIASES, path)):
        table = read_table(path, lines, ALIASES)
        check_columns(table, ALIASES, "name", "point's name")
        return table, stated
    return _gcp_list(path, lines), stated


def _gcp_list(path: Path, lines: list[Line]) -> ParsedTable:
    """A table without names of columns: a measurement a line, or a point that is measured in no image, with
    its description at the end."""
    first = next((line.text for line in lines if not line.comment), "")
    fields = split(first, first)
    described = len(fields) > 4 and not is_number(fields[4])
    if fields and (not is_number(fields[0]) or len(fields) in (4, 5) or described):
        return read_table(path, lines, ALIASES, ("name", "x", "y", "height"))
    return read_table(path, lines, ALIASES, _GCP_LIST)
