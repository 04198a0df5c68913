"""The bands of a rig in one mosaic."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio
from mosaic_scenes import CAMERA, paint
from test_mosaic_grid import given_for, seams

from geomosaic.composition.bands import compose_bands, other_bands
from geomosaic.composition.compose import CompositionOptions, compose
from geomosaic.composition.model import Mosaic
from geomosaic.composition.orthos import plan_orthos, write_ortho
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.views import PosedFrames
from geomosaic.matching.band_registration import BandPose, RigPoses
from geomosaic.survey.model import Band


def test_a_capture_that_lacks_a_file_gives_no_pixels(tmp_path: Path) -> None:
    given = given_for(tmp_path, lines=1, per_line=3, bands=1)
    survey = given["survey"]
    files = tuple(replace(f, name=f"nir{f.name}", camera="nir") for f in survey.frames)
    nir = Band("NIR", 840.0, replace(CAMERA, name="nir"), (files[0], None, files[2]))
    rigged = replace(survey, other_bands=(nir,))
    owned, _ = seams(tmp_path / "run", {**given, "survey": rigged})
    assert owned.used.tolist() == [True, False, True] and not (owned.owner == 2).any()
    pose = BandPose("NIR", nir.camera, np.eye(3), 9, 0.5, 0.1)
    adjusted = given["adjusted"]
    frames = PosedFrames(rigged, adjusted.poses, adjusted.cameras, owned.used.tolist(), given["ground"])
    (band,) = other_bands(frames, RigPoses((pose,)))
    assert band.used == (True, False, True) and {f.camera for f in band.survey.frames} == {"nir"}


def test_bands_of_signed_and_unsigned_values_share_a_raster(tmp_path: Path) -> None:
    """No type of 16 bits takes 60000 and -500: fractional values take both."""
    given = given_for(tmp_path, lines=1, per_line=2, bands=1, dtype="uint16")
    survey, adjusted = given["survey"], given["adjusted"]
    files = tuple(
        replace(f, name=f"t{f.name}", path=f"{f.path}.t.tif", camera="t", dtype="int16")
        for f in survey.frames
    )
    for own, other in zip(survey.frames, files, strict=True):
        paint(own, np.full((180, 240, 1), 60000))
        paint(other, np.full((180, 240, 1), -500))
    rigged = replace(survey, other_bands=(Band("T", None, replace(CAMERA, name="t"), files),))
    rig = RigPoses((BandPose("T", rigged.other_bands[0].camera, np.eye(3), 9, 0.5, 0.1),))
    owned, _ = seams(tmp_path / "run", given)
    frames = PosedFrames(rigged, adjusted.poses, adjusted.cameras, owned.used.tolist(), given["ground"])

    def composing(some: PosedFrames, files: MosaicFiles) -> Mosaic:
        return compose(some, owned, files, CompositionOptions("hard"))

    made = compose_bands(composing, frames, rig, tmp_path, MosaicFiles(tmp_path / "mosaic.tif"))
    assert (made.dtype, made.bands) == ("float32", 2)
    plan = plan_orthos(frames, owned, rig, "cubic", None)
    assert write_ortho(plan.warping, plan.area, plan.names, plan.frames[0], tmp_path / "ortho.tif")
    for name in ("mosaic.tif", "ortho.tif"):
        with rasterio.open(tmp_path / name) as tiff:
            valid = tiff.dataset_mask() > 0
            assert tiff.dtypes == ("float32", "float32") and valid.any()
            assert [set(np.unique(band[valid]).tolist()) for band in tiff.read()] == [{60000.0}, {-500.0}]
