"""Grids of PROJ's collection, of geoids and of shifts between datums, fetched into its folder of the user."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from pyproj import Transformer
from pyproj.crs import CompoundCRS
from pyproj.datadir import get_user_data_dir  # type: ignore[attr-defined]
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from geomosaic.doors.addresses import is_address, parsed
from geomosaic.doors.remote import copy, look
from geomosaic.errors import FileError, InputError
from geomosaic.geodesy.heights import height_datum, missing_grids
from geomosaic.pipeline import files

COLLECTION: Final = "https://cdn.proj.org/"
_GRIDS: Final = (".tif", ".gtx")
_READERS: Final = ("vgridshift +multiplier=1", "hgridshift")


def grid_names(name: str) -> list[str]:
    """The files that heights of a name need and PROJ lacks: of `EGM2008`, `EPSG:7837`, or a grid's own name.

    Raises: `InputError` for another name, and where PROJ knows no grid that can be fetched.
    """
    if name.endswith(_GRIDS) and Path(name).name == name:
        return [name]
    vertical = height_datum(name)
    heights = CompoundCRS(name="heights of a vertical datum", components=["EPSG:4326", vertical])
    with warnings.catch_warnings(action="ignore"):
        group = TransformerGroup(heights, "EPSG:4979", always_xy=True, allow_ballpark=False)
    if group.transformers:
        return []
    grids = missing_grids(group.unavailable_operations)
    if not grids or not all(grid.url for grid in grids):
        fix = f"give the file's name in {COLLECTION}, such as us_nga_egm08_25.tif"
        raise InputError(f"PROJ knows no grid of '{vertical.name}' that can be fetched", fix=fix)
    return [grid.short_name for grid in grids]


def fetch_grid(name: str, source: str, stopped: Callable[[], bool]) -> Path:
    """Puts a grid where PROJ looks for it, whole or not at all.

    Args: name: the file's. source: the file itself, or the folder that holds it, here or on a server.
    Raises: `InputError` for what can't be fetched, `FileError` for what is no grid of PROJ.
    """
    remote = is_address(source)
    given = source if source.endswith(_GRIDS) else f"{source.rstrip('/')}/{name}"
    if not remote and not Path(given).is_file():
        raise FileError("there is no such file", file=given, fix=f"give {name}, or the folder that has it")
    path = Path(get_user_data_dir(create=True)) / (Path(given).name if given.endswith(".gtx") else name)
    with files.writing(path) as temporary:
        if remote:
            with temporary.open("xb") as file:
                copy(look(parsed(given)), file, stopped)
        else:
            temporary.write_bytes(Path(given).read_bytes())
        if not any(_reads(reader, temporary) for reader in _READERS):
            raise FileError(
                "it is no grid that PROJ reads", file=given, fix=f"give {name} as {COLLECTION} has it"
            )
    return path


def _reads(reader: str, grid: Path) -> bool:
    with suppress(ProjError):
        Transformer.from_pipeline(f'+proj={reader} +grids="{grid}"')
        return True
    return False
