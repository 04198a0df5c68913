"""Attitudes in POS files: which convention a file uses, and body angles out of any of them."""

from __future__ import annotations

from typing import Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.rotation import Rotation, about_z
from geomosaic.errors import InputError, UnknownNameError
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.model import Warn
from geomosaic.survey.onboard import body_from_gimbal
from geomosaic.survey.table import ParsedTable

CONVENTIONS: Final = {
    "auto": "per file: by the columns' names; gimbal where the middle pitch lies nearer to -90 than to 0",
    "body": "yaw, pitch, roll of a body; pitch 0 at the nadir, > 0 looking forward; roll > 0 looking left",
    "gimbal": "yaw, pitch, roll of a gimbal; pitch -90 at the nadir",
    "positions": "as geomosaic's positions.csv: a body's angles, but pitch less 90",
    "omega-phi-kappa": "Rx(omega) Ry(phi) Rz(kappa) from east, north, up",
    "phi-omega-kappa": "phi first, X north and Y west (Yue et al. 2021, equation 1); heading is -kappa",
}
"""What an attitude in a POS file can mean; see `camera.rotation.Rotation`."""


def read_angles(
    table: ParsedTable, convention: str, projection: MapProjection | None, lonlat: Floats
) -> tuple[Floats, str, list[Warn]]:
    """Body angles (n, 3) from true north of a table's rows, where they come from, and what was assumed.

    NaN where unknown. In a file of yaw, pitch and roll, yaw is from true north, whatever its positions' CRS.
    Omega, phi and kappa refer to the axes of the file's positions, so that a grid's convergence is added.

    Args: projection of the file's x and y, None for geographic positions; lonlat (n, 2) degrees.
    """
    if convention not in CONVENTIONS:
        raise UnknownNameError("attitude convention", convention, CONVENTIONS)
    has = table.factors.keys()
    has_opk = {"omega", "phi", "kappa"} <= has
    has_ypr = bool({"yaw", "pitch", "gimbal_pitch"} & has)
    if has_opk and convention == "auto" and has_ypr:
        has_ypr = bool(np.isfinite([table.numbers(c) for c in ("pitch", "gimbal_pitch")]).any())
    if convention.endswith("kappa") if convention != "auto" else has_opk and not has_ypr:
        if not has_opk:
            raise _lacks(table, convention, "omega, phi and kappa")
        return _from_opk(table, convention, projection, lonlat), "pos-omega-phi-kappa", []
    if convention != "auto" and not has_ypr:
        raise _lacks(table, convention, "yaw, pitch and roll")
    prefix = "gimbal_" if "gimbal_pitch" in has else ""
    names = [f"{prefix}{c}" for c in ("yaw", "pitch", "roll")]
    if "gimbal_yaw" not in has:
        names[0] = "yaw"  # a gimbal follows the aircraft's heading
    angles = np.column_stack([table.numbers(c) for c in names])
    notes: list[Warn] = []
    if convention == "auto":
        convention, notes = _convention(table, angles[:, 1])
    if convention == "gimbal":
        angles = np.where(np.isnan(angles[:, 1:2]), angles, body_from_gimbal(*angles.T))
    elif convention == "positions":
        angles[:, 1] += 90.0
    angles[:, 0] %= 360.0
    return angles, "pos-yaw-pitch-roll", notes


def _lacks(table: ParsedTable, convention: str, columns: str) -> InputError:
    return InputError(
        f"has no columns {columns} for the attitude convention '{convention}'",
        file=table.path,
        fix=f"name them, or give --attitude NAME ({', '.join(CONVENTIONS)})",
    )


def _convention(table: ParsedTable, pitches_deg: Floats) -> tuple[str, list[Warn]]:
    if "gimbal_pitch" in table.factors:
        return "gimbal", []
    if {"moved", "turned"} <= table.factors.keys():
        return "positions", []
    if np.isnan(pitches_deg).all():
        return "body", []
    middle = float(np.nanmedian(pitches_deg))
    convention, nadir = ("gimbal", -90) if abs(middle + 90.0) < 45.0 else ("body", 0)
    text = (
        f"{table.path.name}: the middle pitch is {middle:.1f} degrees, so angles are read as those of a "
        f"{convention} (nadir {nadir}); if they are others, give --attitude NAME ({', '.join(CONVENTIONS)})"
    )
    return convention, [Warn("pos-attitude-convention", "", text)]


def _from_opk(
    table: ParsedTable, convention: str, projection: MapProjection | None, lonlat: Floats
) -> Floats:
    o, p, k = np.radians([table.numbers(c) for c in ("omega", "phi", "kappa")])
    if convention == "phi-omega-kappa":
        rotation = Rotation.from_phi_omega_kappa(p, o, k)
    else:
        rotation = Rotation.from_omega_phi_kappa(o, p, k)
    if projection is not None:
        rotation = Rotation(about_z(-projection.grid_convergence_rad(*lonlat.T)) @ rotation.matrix)
    degrees = np.degrees(np.stack(rotation.yaw_pitch_roll(), axis=-1))
    degrees[:, 0] %= 360.0
    return np.where(np.isnan(degrees).any(axis=1, keepdims=True), np.nan, degrees)
