"""The step of reading a survey that finds how each frame's values become reflectance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import sourced, tuned
from geomosaic.doors.raster import FRAME, open_raster, reading
from geomosaic.errors import InputError
from geomosaic.radiometry.panel import find_panel, middle_of
from geomosaic.radiometry.quantity import UNCALIBRATED, reflectance
from geomosaic.survey.calibration_tags import SensorModel, missing_tags, sensor_model, temperature
from geomosaic.survey.draft import SurveyDraft
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.lens_tags import label
from geomosaic.survey.model import UnusedImage, Warn
from geomosaic.survey.names import FrameNames
from geomosaic.survey.strays import camera_kind
from geomosaic.survey.table import is_number, read_lines, read_table
from geomosaic.survey.xmp import number

RADIOMETRY: Final = ("none", "reflectance", "temperature")
_LOW_M = tuned(
    10.0, "m", "below the median height: frames searched for a panel; more misses it, less is slow"
)
_SATURATED = sourced(65_000.0, "digital numbers", "beyond which a panel is saturated", "MicaSense, panels")
_GIVE_PANEL: Final = "give a photo of a panel with --panel IMAGE=ALBEDO"
_GREY: Final = (
    "thermal frames are read as the grey pictures that their JPEG files show, not as temperatures: for "
    "degrees give --radiometry temperature (FLIR), or convert them to TIFF in 32-bit floats first (DJI)"
)
_LEAVE: Final = "leave out --radiometry reflectance to have values as recorded"

Albedo = Mapping[str, float] | None
"""By band in lower case, of all bands under ''; None: as the panel's code says."""


@dataclass(frozen=True)
class BandFiles:
    """Files of a band and their sensor models, by the name of the capture's file in the rig's first one."""

    band: str
    files: Mapping[str, FrameHeader]
    models: Mapping[str, SensorModel]

    @property
    def sun(self) -> bool:
        """Whether the sun sensor has a reading for each file."""
        return all(model.irradiance for model in self.models.values())

    def by_sun(self, scale: float) -> dict[str, float]:
        """Factors to reflectance of radiance, by irradiance alone."""
        return {name: scale / (model.irradiance or math.inf) for name, model in self.models.items()}

    def by_panels(self, panels: Mapping[str, Albedo]) -> dict[str, float]:
        """Factors to reflectance of radiance: the light on panels, linear in time between them, or its
        ratio to the sun sensor's.

        Raises: `InputError` where no panel can be read in this band.
        """
        light = self.by_sun(1.0) if self.sun else dict.fromkeys(self.models, 1.0)
        seen = {
            name: self._panel_value(name, albedo) for name, albedo in panels.items() if name in self.files
        }
        measured = {name: value * light[name] / of for name, (value, of) in seen.items() if value}
        if not measured:
            file = next((self.files[name].path for name in seen), None)
            raise InputError(f"no panel can be read in the band {self.band}", file=file, fix=_GIVE_PANEL)
        times = {name: header.exif.time_s or 0.0 for name, header in self.files.items()}
        order = sorted(measured, key=lambda name: times[name])
        at, lit = [times[name] for name in order], [measured[name] for name in order]
        return {name: light[name] / float(np.interp(times[name], at, lit)) for name in self.files}

    def _panel_value(self, name: str, given: Albedo) -> tuple[float | None, float]:
        """The radiance of the panel that a file shows, None where it is not seen or saturated; its albedo."""
        header, xmp = self.files[name], self.files[name].xmp or {}
        values = _values(header)
        panel = find_panel(values) or (None if given is None else middle_of(values))
        if panel is None or (panel.value(values) or 0.0) > _SATURATED:
            return None, 1.0
        albedo = panel.albedo(number(xmp, "Camera:CentralWavelength"))
        if given is not None:
            albedo = given.get(self.band.lower(), given.get(""))
        if not albedo:
            problem = f"nothing says the panel's albedo in the band {self.band}"
            raise InputError(problem, file=header.path, fix=_GIVE_PANEL)
        radiance = self.models[name].calibration.reflectance(values[..., None])[..., 0]
        return panel.value(radiance), albedo


def with_reflectance(draft: SurveyDraft) -> SurveyDraft:
    """What frames' values mean, and how they become reflectance where that is asked for; without the captures
    that show a panel.

    Panels give each band a factor; where all frames of a band have a reading of the sun sensor, this follows
    the light from frame to frame. Raises: `InputError` for a camera without a known model, and where neither
    a panel nor the sun sensor gives reflectance.
    """
    bands = _by_band(draft)
    firsts = {band: next(iter(files.values())) for band, files in bands.items() if files}
    meant = {band: kind for band, header in firsts.items() if (kind := temperature(header)) is not None}
    if draft.inputs.radiometry != "reflectance":
        rest = dict.fromkeys(bands.keys() - meant.keys(), UNCALIBRATED) if draft.rig else {}
        files = [header for of in bands.values() for header in of.values()]
        grey = [h.name for h in files if camera_kind(h) == "thermal" and h.dtype == "uint8"]
        warnings = [Warn("thermal-grey", "", _GREY)] if grey else []
        warnings = [*draft.folder_warnings, *warnings]
        return replace(draft, quantities=meant | rest, folder_warnings=tuple(warnings))
    shown = [
        BandFiles(band, files, {name: _model(header) for name, header in files.items()})
        for band, files in bands.items()
        if band not in meant
    ]
    models = [model for one in shown for model in one.models.values()]
    panels = _given(draft.inputs.panels, bands) if draft.inputs.panel else _found(draft.headers)
    absolute, sun = all(model.absolute for model in models), all(one.sun for one in shown)
    if panels:
        factors = {one.band: one.by_panels(panels) for one in shown}
    elif sun:
        scale = math.pi if absolute else 1.0 / max(map(_brightest, models))
        factors = {one.band: one.by_sun(scale) for one in shown}
    else:
        problem = "reflectance needs a panel or a sun sensor's reading of every frame, and there is neither"
        raise InputError(problem, file=draft.inputs.frames, fix=f"{_GIVE_PANEL}, or {_LEAVE}")
    by = [f"panel {', '.join(panels)}"] * bool(panels) + ["sun sensor"] * sun
    quantity = reflectance(" and ".join(by), absolute=absolute or bool(panels))
    calibrations = {
        str(header.path): replace(
            calibration := one.models[name].calibration, gain=calibration.gain * factors[one.band][name]
        )
        for one in shown
        for name, header in one.files.items()
    }
    if all(header.name in panels for header in draft.headers):
        problem = "all frames show a reflectance panel"
        raise InputError(problem, file=draft.inputs.frames, fix="give the frames of the flight too")
    strays = [("frame-panel", UnusedImage(name, "shows a reflectance panel")) for name in panels]
    return replace(
        draft,
        headers=tuple(h for h in draft.headers if h.name not in panels),
        strays=(*draft.strays, *strays),
        calibrations=calibrations,
        quantities=meant | {one.band: quantity for one in shown},
    )


def _by_band(draft: SurveyDraft) -> dict[str, dict[str, FrameHeader]]:
    """The files of each band by the name of the capture's file in the first one."""
    if draft.rig is None:
        return {"": {header.name: header for header in draft.headers}}
    found = {draft.rig.own[0].band: {file.header.name: file.header for file in draft.rig.own}}
    for band, files in draft.rig.others.items():
        found[band] = {name: file.header for name, file in files.items()}
    return found


def _model(header: FrameHeader) -> SensorModel:
    model = sensor_model(header)
    if model is None:
        problem = (
            f"its tags lack {', '.join(lacking)}, without which its values have no known relation to light "
            f"(camera {label(header)})"
            if (lacking := missing_tags(header))
            else f"its tags hold no known sensor model (camera {label(header)}): MicaSense's, DJI's or "
            "Parrot's, of frames with one band in 16 bits"
        )
        raise InputError(problem, file=header.path, fix=_LEAVE)
    return model


def _brightest(model: SensorModel) -> float:
    """The largest ratio of radiance to irradiance that can be recorded, the vignetting left aside."""
    calibration = model.calibration
    most = np.iinfo(np.uint16).max - calibration.black_level
    return calibration.gain * most / (model.irradiance or math.inf)


def _values(header: FrameHeader) -> NDArray[Any]:
    with open_raster(header.path, FRAME) as tiff, reading(header.path, FRAME.problem, FRAME.fix):
        return np.asarray(tiff.read(1))


def _found(headers: Sequence[FrameHeader]) -> dict[str, Albedo]:
    """Frames in which a panel's code is read: of those that lie low, as panels are taken from the ground."""
    heights = [header.exif.altitude_m for header in headers]
    known = [height for height in heights if height is not None]
    low = float(np.median(known)) - _LOW_M if known else math.inf
    searched = [h for h, height in zip(headers, heights, strict=True) if height is None or height < low]
    return {header.name: None for header in searched if find_panel(_values(header)) is not None}


def _given(panels: Mapping[str, str], bands: Mapping[str, Mapping[str, FrameHeader]]) -> dict[str, Albedo]:
    """Of albedos by image, any of a capture's files. Raises: `InputError` where one is no frame."""
    capture = {header.name: name for files in bands.values() for name, header in files.items()}
    names = FrameNames(capture)
    found: dict[str, Albedo] = {}
    for image, albedo in panels.items():
        file = names.find(image) if image else None
        if file is None:
            problem = f"--panel: '{image}' is no frame of the folder"
            raise InputError(problem, fix=f"write IMAGE=ALBEDO; {names.near(image)}")
        found[capture[file]] = _albedo(albedo)
    return found


def _albedo(text: str) -> dict[str, float]:
    """A number, or the file of a table with the columns band and albedo."""
    if is_number(text):
        found = {"": float(text)}
    else:
        path = Path(text)
        columns = {"band": ("band", "band_name", "name"), "albedo": ("albedo", "reflectance", "value")}
        table = read_table(path, read_lines(path, "bands"), columns)
        named = [(band or "").lower() for band in table.texts("band")]
        found = dict(zip(named, table.required("albedo").tolist(), strict=True))
    if not found or not all(0.0 < albedo <= 1.0 for albedo in found.values()):
        raise InputError(f"--panel: {text} holds no albedo", fix="give numbers from 0 to 1, such as 0.49")
    return found
