"""The map projection that messages propose: the UTM zone in which the survey's frames lie."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import numpy as np

from geomosaic.errors import GeomosaicError, InputError
from geomosaic.estimation.robust import LEAST_OBSERVATIONS
from geomosaic.geodesy.ellipsoid import middle_of
from geomosaic.geodesy.mapcrs import utm_crs
from geomosaic.survey.header import read_header
from geomosaic.survey.onboard import onboard_position

_EXAMPLE: Final = re.compile(r"such as EPSG:n\b")

LonLat = tuple[float, float]


@contextmanager
def proposing_zone(frames: Collection[Path], near: Collection[LonLat] = ()) -> Iterator[None]:
    """An error raised inside that proposes a code `such as EPSG:n` names that of the frames' UTM zone.

    The zone is that of `near`, longitudes and latitudes, else of the positions in the frames' tags. The text
    stays as it is where there are none.
    """
    try:
        yield
    except InputError as error:
        if _EXAMPLE.search(str(error)) and (zone := zone_of(near or tagged_positions(frames))):
            error.reword(lambda text: _EXAMPLE.sub(f"such as {zone} (UTM zone of the frames)", text))
        raise


def zone_of(lonlat: Collection[LonLat]) -> str:
    """The code of the UTM zone (`EPSG:32633`) in the middle of positions, '' without any."""
    return utm_crs(*middle_of(np.array([*lonlat]))) if lonlat else ""


def tagged_positions(frames: Collection[Path]) -> list[LonLat]:
    """Longitudes and latitudes that the tags of some frames hold, evenly taken from all."""
    found = []
    for path in [*frames][:: len(frames) // LEAST_OBSERVATIONS + 1]:
        with suppress(GeomosaicError):
            header = read_header(path)
            position = onboard_position(header.exif, header.xmp or {})
            if position is not None and position.known:
                found.append((position.lon_deg, position.lat_deg))
    return found
