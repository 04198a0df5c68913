"""What a raster's values mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from geomosaic.constants import sourced
from geomosaic.radiometry.calibration import REFLECTANCE_ONE

if TYPE_CHECKING:
    from geomosaic.doors.raster import Raster

REFLECTANCE: Final = "reflectance"
RELATIVE: Final = "relative reflectance"
TEMPERATURE: Final = "temperature"
QUANTITY_TAG: Final = "QUANTITY"
SOURCE_TAG: Final = "CALIBRATION"
_CELSIUS = sourced((0.01, -273.15), "°C", "of a digital number and of 0", "MicaSense: thermal in 0.01 K")


@dataclass(frozen=True)
class Quantity:
    """The physical value is offset + scale * the stored value. source: by what values were calibrated."""

    name: str
    source: str = ""
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""


UNCALIBRATED: Final = Quantity("uncalibrated values as recorded")
CELSIUS: Final = Quantity(TEMPERATURE, "the camera", unit="°C")
CENTIKELVIN: Final = Quantity(TEMPERATURE, "the camera", *_CELSIUS, "°C")


def reflectance(source: str, *, absolute: bool) -> Quantity:
    """Of values that `Calibration.digital` gives; not absolute: times a factor that nothing reports."""
    return Quantity(REFLECTANCE if absolute else RELATIVE, source, 1.0 / REFLECTANCE_ONE)


def quantity_of(raster: Raster, band: int) -> Quantity | None:
    """What a band of a mosaic says of its values; None where it says nothing."""
    tags, k = raster.tags(band), band - 1
    if QUANTITY_TAG not in tags:
        return None
    scaled = float(raster.scales[k]), float(raster.offsets[k]), raster.units[k] or ""
    return Quantity(tags[QUANTITY_TAG], tags.get(SOURCE_TAG, ""), *scaled)
