"""COLMAP's mapping of a folder of frames, with the positions of their tags as priors.

    python pycolmap_mapping.py match|incremental|tagged_lens|global FRAMES OUT

`match` extracts keypoints and matches neighbours by position into OUT/database.db. The others map from it and
write OUT/NAME.json: for each frame lat, lon, height of its projection centre. Options are pycolmap's own,
apart from one camera for all frames, one thread a core, and a fixed seed. Positions are in metres east, north
and up, with the deviations that geomosaic assumes of them too. `tagged_lens` is the incremental mapper with
the lens as the tags report it: COLMAP has no prior deviation of a lens, and frees or keeps it. The global
mapper takes no positions: its result is aligned to them and adjusted once more with them as priors.

Runs in an environment of its own with pycolmap, without the project.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pycolmap  # type: ignore[import-not-found]

SEED = 1
ALIGNED_M = 10.0
"""Positions farther off than this are no inliers of the global map's alignment."""
POSITION_SD_M = (5.0, 5.0, 15.0)
"""Of positions in tags, east, north and up; without a covariance pycolmap assumes 1 m."""


def match(frames: Path, out: Path) -> None:
    """Keypoints, position priors and matches in a new database."""
    database = out / "database.db"
    database.unlink(missing_ok=True)
    pycolmap.extract_features(database, frames, camera_mode=pycolmap.CameraMode.SINGLE)
    with pycolmap.Database.open(database) as file:
        priors = file.read_all_pose_priors()
        lat_lon_height = np.array([prior.position for prior in priors])
        origin = lat_lon_height.mean(axis=0)
        enu_m = pycolmap.GPSTransform().ellipsoid_to_enu(lat_lon_height, *origin)
        for prior, position in zip(priors, enu_m, strict=True):
            prior.position = position
            prior.position_covariance = np.diag(np.square(POSITION_SD_M))
            prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
            file.update_pose_prior(prior)
    (out / "origin.json").write_text(json.dumps(origin.tolist()))
    pycolmap.match_spatial(database)


def incremental(frames: Path, out: Path, lens: bool = True) -> pycolmap.Reconstruction:
    """The largest model of the incremental mapper, which takes the positions. lens: whether it is freed."""
    options = pycolmap.IncrementalPipelineOptions()
    options.use_prior_position = True
    options.random_seed = SEED
    options.ba_refine_focal_length = options.ba_refine_extra_params = lens
    return _largest(pycolmap.incremental_mapping(out / "database.db", frames, _folder(out), options))


def tagged_lens(frames: Path, out: Path) -> pycolmap.Reconstruction:
    """The same with the lens of the tags."""
    return incremental(frames, out, lens=False)


def global_(frames: Path, out: Path) -> pycolmap.Reconstruction:
    """The largest model of the global mapper, adjusted once more with the positions."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = SEED
    found = _largest(pycolmap.global_mapping(out / "database.db", frames, _folder(out), options))
    with pycolmap.Database.open(out / "database.db") as file:
        priors = file.read_all_pose_priors()
    alignment = pycolmap.PosePriorBundleAdjustmentOptions()
    alignment.alignment_ransac.max_error = ALIGNED_M
    alignment.alignment_ransac.random_seed = SEED
    config = pycolmap.BundleAdjustmentConfig()
    for image in found.reg_image_ids():
        config.add_image(image)
    options_of_solve = pycolmap.BundleAdjustmentOptions()
    adjuster = pycolmap.create_pose_prior_bundle_adjuster(options_of_solve, alignment, config, priors, found)
    adjuster.solve()
    return found


def _folder(out: Path) -> Path:
    folder = out / "models"
    folder.mkdir(exist_ok=True)
    return folder


def _largest(models: dict[int, pycolmap.Reconstruction]) -> pycolmap.Reconstruction:
    if not models:
        raise SystemExit("no model was found")
    return max(models.values(), key=lambda model: model.num_reg_images())


def main() -> int:
    step, frames, out = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    pycolmap.logging.minloglevel = 1
    pycolmap.set_random_seed(SEED)
    if step == "match":
        match(frames, out)
        return 0
    mappers = {"incremental": incremental, "tagged_lens": tagged_lens, "global": global_}
    found = mappers[step](frames, out)
    images = [found.image(i) for i in found.reg_image_ids()]
    centres_m = np.array([image.projection_center() for image in images])
    origin = json.loads((out / "origin.json").read_text())
    places = pycolmap.GPSTransform().enu_to_ellipsoid(centres_m, *origin)
    by_name = {image.name: place.tolist() for image, place in zip(images, places, strict=True)}
    (out / f"{step}.json").write_text(json.dumps(by_name, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
