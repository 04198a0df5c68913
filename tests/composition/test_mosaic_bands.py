"""The bands of a rig in one mosaic."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from mosaic_scenes import CAMERA
from test_mosaic_grid import given_for, seams

from geomosaic.composition.bands import other_bands
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
