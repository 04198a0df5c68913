"""Headings for the many options of `geomosaic simulate`."""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING, Final

from geomosaic.pipeline.params import describe_params
from geomosaic.requests.option import RARE

if TYPE_CHECKING:
    from geomosaic.pipeline.stage import Stage

STARTS: Final = {
    "simulate.frames": {
        "dirty": "Survey",
        "lines": "Flight",
        "width_px": "Camera",
        "dem": "Ground",
        "position_sd_m": "Positions and control",
        "exposure_sd": "Images",
        "pos_in": "Files",
    },
    "simulate.strips": {
        "ccds": "Focal plane",
        "jitter_1hz_px": "Motion",
        "lon_deg": "Ground",
        "cloud_cover": "Clouds",
        "bit_depth": "Images",
        "attitude_hz": "Reported attitude and DEM",
        "true_scene": "Files",
    },
}
"""By stage the parameter with which each heading begins, in the order in which parameters are declared."""
_FREQUENT: Final = {
    "dirty", "kind", "lines", "frames_per_line", "forward_overlap", "side_overlap", "height_above_ground_m",
    "ground_pixel_m", "width_px", "height_px", "dem", "relief_m", "buildings_stand", "trees_stand",
    "position_sd_m", "height_sd_m", "tilt_sd_deg", "yaw_sd_deg", "control_points", "exposure_sd",
    "vignetting", "blur_px", "rolling_shutter_s", "pixel_noise", "ccds", "overlap_px",
    "jitter_1hz_px", "drift_px_per_s", "mounting_px", "cloud_cover", "snr", "attitude_noise_urad",
    "dem_error_m",
}  # fmt: skip
"""What the help shows without `--help-all`."""


def simulation_headings(stage: type[Stage]) -> dict[str, str]:
    """By parameter its heading; nothing for a stage with few parameters."""
    starts = STARTS.get(stage.id)
    if starts is None:
        return {}
    names = [p.name for p in describe_params(stage.Params)]
    found = accumulate(names, lambda heading, name: starts.get(name, heading), initial="")
    return {
        name: heading if name in _FREQUENT else f"{RARE}: {heading.lower()}"
        for name, heading in zip(names, list(found)[1:], strict=True)
    }
