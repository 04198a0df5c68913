"""positions.csv: the adjusted exterior orientation, one row for each frame. Others build on its columns."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geomosaic.export.orientation import Orientations

COLUMNS = (
    "frame", "status", "lon_deg", "lat_deg", "height_ellipsoidal_m", "easting_m", "northing_m",
    "yaw_deg", "pitch_deg", "roll_deg", "omega_deg", "phi_deg", "kappa_deg", "sd_e_m", "sd_n_m", "sd_u_m",
    "sd_omega_deg", "sd_phi_deg", "sd_kappa_deg", "moved_m", "turned_deg",
)  # fmt: skip
_DECIMALS = (9, 9, 4, 4, 4, *[6] * 6, *[4] * 3, *[5] * 3, 4, 5)


def write_positions(path: Path, orientations: Orientations, left_out: Sequence[str] = ()) -> None:
    """Writes the table; what is unknown is an empty cell. Images that were left out come last."""
    o = orientations
    angles, deviations = (o.yaw_pitch_roll_deg, o.omega_phi_kappa_deg), (o.sd_m, o.sd_omega_phi_kappa_deg)
    place = (o.lon_lat_height, o.map_m)
    numbers = np.column_stack([*place, *angles, *deviations, o.moved_m, o.turned_deg])
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for name, status, row in zip(o.names, o.status, numbers, strict=True):
            cells = [f"{v:.{d}f}" if np.isfinite(v) else "" for v, d in zip(row, _DECIMALS, strict=True)]
            table.writerow([name, status, *cells])
        for name in left_out:
            table.writerow([name, "left_out", *[""] * len(_DECIMALS)])
