"""Reflectance panels in frames: where one lies, and what its QR code says."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats32
from geomosaic.constants import sourced, tuned

_SERIAL: Final = re.compile(r"RP(\d\d)-\d{7}-\D{2}")
_ALBEDOS: Final = re.compile(r"(\d{4})(\d{3})(\d{4})(\d{3})$")
_GEOMETRY = sourced(
    {0: (42.0, 76.2, 143.2), 3: (45.0, 50.0, 145.8), 6: (41.0, 50.0, 130.84)},
    "mm",
    "half a code's side, an inner square of the panel, distance of their middles, by the serial's version",
    "MicaSense, Image Processing: calibrated reflectance panels",
)
BLACK_WHITE = tuned((1.0, 99.0), "%", "of values that become black and white; fewer greys lose a code")
_EVEN = tuned(0.1, "ratio", "deviation to mean on a panel: more is grass or a shadow; less is noise")
_MIDDLE = tuned(0.1, "sides", "of the square in the middle of a frame in which a panel without a code lies")


@dataclass(frozen=True)
class Panel:
    """corners_px: of the code, or of an area on the panel itself where is_area, columns and rows (4, 2)."""

    text: str
    corners_px: Floats32
    is_area: bool = False

    def albedo(self, wavelength_nm: float | None) -> float | None:
        """What the code's text says of a wavelength; None where it says nothing."""
        found = _ALBEDOS.search(self.text)
        if found is None or wavelength_nm is None:
            return None
        short_nm, at_short, long_nm, at_long = (float(group) for group in found.groups())
        share = (wavelength_nm - short_nm) / (long_nm - short_nm) if long_nm > short_nm else 0.0
        return (at_short + share * (at_long - at_short)) / 1000.0  # per mille

    def value(self, values: NDArray[Any]) -> float | None:
        """The mean of a frame's values (rows, cols) on the panel; None where nothing even lies there.

        The panel lies on one of the code's four sides: the one whose values differ least.
        """
        found = []
        for corners in [self.corners_px] if self.is_area else self._areas():
            area = np.zeros(values.shape, dtype=np.uint8)
            cv2.fillConvexPoly(area, np.rint(corners).astype(np.int32), 1)
            within = values[area > 0]
            inside = (corners >= 0.0).all() and (corners < values.shape[::-1]).all()
            if inside and within.size and float(mean := within.mean()) > 0.0:
                found.append((float(within.std() / mean), float(mean)))
        spread, mean = min(found, default=(np.inf, 0.0))
        return mean if spread < _EVEN else None

    def _areas(self) -> list[Floats32]:
        serial = _SERIAL.search(self.text)
        half, side, away = _GEOMETRY[max(v for v in _GEOMETRY if not serial or v <= int(serial[1]))]
        square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]], dtype=np.float32)
        on_image = cv2.getPerspectiveTransform(square * np.float32(half), self.corners_px)
        middles = np.array([[away, 0.0], [0.0, away], [-away, 0.0], [0.0, -away]], dtype=np.float32)
        areas = middles[:, None] + square * np.float32(side / 2.0)
        return list(cv2.perspectiveTransform(areas, on_image))


def find_panel(values: NDArray[Any]) -> Panel | None:
    """The panel whose QR code is read in a frame's values (rows, cols), if any."""
    black, white = np.percentile(values, BLACK_WHITE)
    grey = np.clip((values - black) * (255.0 / max(white - black, 1.0)), 0.0, 255.0).astype(np.uint8)
    text, corners, _ = cv2.QRCodeDetector().detectAndDecode(grey)
    known = _SERIAL.search(text) is not None
    return Panel(text, np.asarray(corners, dtype=np.float32).reshape(4, 2)) if known else None


def middle_of(values: NDArray[Any]) -> Panel:
    """What lies in the middle of a frame's values (rows, cols)."""
    rows, cols = values.shape
    half = min(rows, cols) * _MIDDLE / 2.0
    square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    return Panel("", (square + np.array([cols, rows]) / 2.0).astype(np.float32), is_area=True)
