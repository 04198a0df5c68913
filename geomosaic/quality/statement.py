"""What people ask of a map, answered in a line each; and the sentence that the ASPRS standard asks for."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from geomosaic.constants import sourced
from geomosaic.quality.accuracy import (
    LEAST_CHECK_POINTS,
    AbsoluteAccuracy,
    Accuracy,
    RelativeAccuracy,
    Requirement,
    metres,
)
from geomosaic.quality.seam_check import SeamCheck

_STANDARD: Final = "ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2 (2023)"
NO_RELATIVE: Final = "not stated by this adjustment method"
_WHOLE_PERMILLE = sourced(1000.0, "per mille", "error as long as the distance", "definition")
UNDETERMINED: Final = "not determined: give a calibrated lens with --camera, or positions with --pos"
NO_ABSOLUTE: Final = "not stated: no positions, no control points, or an adjustment method without deviations"


def answers(
    accuracy: Accuracy, required: Requirement, seams: SeamCheck, pixel_m: float
) -> list[tuple[str, str]]:
    """Does it hold together, how accurate are distances, how accurate are places, and what is asked of both:
    (question, answer)."""
    return [
        ("seams", _seams(seams)),
        ("relative accuracy", _relative(accuracy.relative, required, pixel_m)),
        ("absolute accuracy", _absolute(accuracy.absolute)),
        ("required", _required(required)),
    ]


def _required(required: Requirement) -> str:
    asked = [
        f"{name} RMSE {metres(value)}"
        for name, value in (("horizontal", required.rmse_h_m), ("vertical", required.rmse_v_m))
        if math.isfinite(value)
    ]
    if required.permille >= _WHOLE_PERMILLE:
        asked.append("distances none, since the frames lie too close together to scale the map")
    elif math.isfinite(required.permille):
        asked.append(f"distances {float(f'{required.permille:.2g}'):g} per mille")
    return f"{', '.join(asked) or 'nothing'}: {required.why}"


def _seams(seams: SeamCheck) -> str:
    length = seams.length_px[np.isfinite(seams.length_px)]
    if not length.size:
        return "no seam could be measured"
    median, most = np.quantile(length, [0.5, 0.95])
    return f"{median:.2f} px (median), {most:.2f} px (95 %), at {length.size} of {len(seams.left)} places"


def _relative(relative: RelativeAccuracy, required: Requirement, pixel_m: float) -> str:
    if not math.isfinite(relative.scale_permille):
        return NO_RELATIVE
    if relative.undetermined:
        return UNDETERMINED
    over = [(relative.rmse_100m_m, 100.0), (relative.rmse_whole_m, relative.whole_m)]
    distances = [
        f"{metres(rmse_m)} ({rmse_m / pixel_m:.1f} px) over {length_m:.0f} m"
        for rmse_m, length_m in over
        if math.isfinite(rmse_m)
    ]
    if not required.scaled:
        off_px, over_px = relative.rmse_whole_m / pixel_m, relative.whole_m / pixel_m
        return f"RMSE of distances {off_px:.1f} px over {over_px:.0f} px once it is scaled; scale unknown"
    return f"RMSE of distances {', '.join(distances)}; scale {relative.scale_permille:.2f} per mille"


def _absolute(absolute: AbsoluteAccuracy) -> str:
    if not math.isfinite(absolute.rmse_h_m):
        return NO_ABSOLUTE
    words = [f"horizontal RMSE {metres(absolute.rmse_h_m)}, CE90 {metres(absolute.ce90_m)}"]
    if absolute.without_datum:
        words.append("heights not known: they may count from the take-off; give --gcp with heights")
    elif math.isfinite(absolute.rmse_v_m):
        words.append(f"vertical RMSE {metres(absolute.rmse_v_m)}, LE90 {metres(absolute.le90_m)}")
    return f"{'; '.join(words)} ({_how(absolute)})"


def _how(absolute: AbsoluteAccuracy) -> str:
    if not absolute.check_points:
        return "estimated from the covariance"
    east, north, up = absolute.shift_m
    scatter_m = float(np.hypot(*absolute.scatter_m[:2]))
    shift = f"mean shift {east:+.3f} m east, {north:+.3f} m north"
    shift += f", {up:+.3f} m up" if math.isfinite(up) else ""
    return (
        f"measured at {absolute.check_points} check points: {shift}; scatter {metres(scatter_m)} horizontally"
    )


def asprs_class_cm(rmse_m: float) -> float:
    """The accuracy class that an RMSE meets: it in cm, rounded up to two digits."""
    rmse_cm = 100.0 * rmse_m
    digit = 10.0 ** (math.floor(math.log10(max(rmse_cm, 1e-3))) - 1)
    return round(math.ceil(rmse_cm / digit - 1e-9) * digit, 6)


def asprs_statement(absolute: AbsoluteAccuracy) -> str:
    """The standard's reporting sentence: tested to meet by 30 check points, else produced to meet."""
    if not math.isfinite(absolute.rmse_h_m):
        return ""
    parts = [("horizontal", "RMSEH", absolute.rmse_h_m)]
    if math.isfinite(absolute.rmse_v_m) and absolute.check_points:
        parts.append(("vertical", "RMSEV", absolute.rmse_v_m))
    tested = absolute.check_points >= LEAST_CHECK_POINTS
    few = (
        f"Although the Standards call for a minimum of {LEAST_CHECK_POINTS} check points, this test was "
        f"performed using only {absolute.check_points} check points. "
    )
    out = few if absolute.check_points and not tested else ""
    for name, symbol, rmse_m in parts:
        met = f"{asprs_class_cm(rmse_m):g} cm {symbol} {name} positional accuracy class"
        out += f"This data set was {'tested' if tested else 'produced'} to meet {_STANDARD} for a {met}. "
        if absolute.check_points:
            out += (
                f"The tested {name} positional accuracy was found to be {symbol} = {100.0 * rmse_m:.1f} cm. "
            )
    return out.strip()


def reported(accuracy: Accuracy, required: Requirement) -> dict[str, Any]:
    """What run.json says of accuracy; None for what is not stated."""
    absolute, relative = accuracy.absolute, accuracy.relative
    found = {
        "absolute": {
            "rmse_h_m": absolute.rmse_h_m,
            "ce90_m": absolute.ce90_m,
            "ce95_m": absolute.circle_m(0.95),
            "rmse_v_m": absolute.rmse_v_m,
            "le90_m": absolute.le90_m,
            "le95_m": absolute.interval_m(0.95),
            "how": absolute.how,
            "check_points": absolute.check_points,
            "shift_m": absolute.shift_m.tolist(),
            "scatter_m": absolute.scatter_m.tolist(),
        },
        "relative": {
            "scale_permille": relative.scale_permille,
            "rmse_m_per_100m": relative.rmse_100m_m,
            "rmse_m_whole": relative.rmse_whole_m,
            "whole_m": relative.whole_m,
        },
        "class": asprs_statement(absolute),
        "requirement": asdict(required),
    }
    return {name: _known(value) for name, value in found.items()}


def _known(value: Any) -> Any:
    """The value with None for NaN."""
    if isinstance(value, dict):
        return {name: _known(v) for name, v in value.items()}
    if isinstance(value, list):
        return [_known(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
