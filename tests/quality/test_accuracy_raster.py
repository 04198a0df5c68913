"""accuracy.tif: deviations against finite differences through rays and ground, and what GDAL reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from mosaic_scenes import CAMERA, HOME
from osgeo_utils.samples.validate_cloud_optimized_geotiff import validate
from scipy.spatial.transform import Rotation as Turn

from geomosaic.adjustment.ground_places import GroundPlaces
from geomosaic.adjustment.model import Adjusted, ImageResiduals
from geomosaic.camera.exterior import Pose, Poses
from geomosaic.camera.rotation import Rotation
from geomosaic.composition.area import Area
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.ownership import Ownership
from geomosaic.export.accuracy import BANDS, write_accuracy
from geomosaic.export.cog import CogOptions, write_cog
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.matching.model import TiePoints
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.accuracy_grid import AccuracyCells, MatchedCells, standing_m, tied_area
from geomosaic.quality.ground_accuracy import GroundPropagation, HeightSource
from geomosaic.surface.cells import Cells

CRS = "EPSG:32632"
AT_M = MapProjection(CRS).map_from_geodetic(HOME.lon_deg, HOME.lat_deg)
POSE = Pose(np.array([3.0, -2.0, 50.0]), Rotation.from_yaw_pitch_roll(0.7, 0.06, -0.09))
IMAGE_PX = np.array([[20.0, 15.0], [120.0, 90.0], [230.0, 10.0], [60.0, 170.0]])
EVERYWHERE = Area(((AT_M + 1e4 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]),),))


def plane(kind: str, slope: tuple[float, float], sd_m: float | None) -> GroundSurface:
    """Ground through the origin that rises by so much per m east and north."""
    north, east = np.mgrid[-4:5, -4:5] * 50.0
    up = slope[0] * east + slope[1] * north
    return GroundSurface(kind, -200.0, -200.0, 50.0, up, None if sd_m is None else np.full(up.shape, sd_m))


def adjusted(ground: GroundSurface, covariance: np.ndarray | None, status: str = "tied") -> Adjusted:
    """One frame; without a covariance its deviations are those of its POS."""
    sd = np.array([[0.3, 0.4, 0.5]]), np.array([[0.01, 0.02, 0.03]])
    poses = Poses(POSE.position_m[None], POSE.rotation.matrix[None], *sd)
    whole = None if covariance is None else covariance[None]
    return Adjusted(poses, (CAMERA,), (status,), (), (), ground, pose_covariance=whole)


def uneven_covariance() -> np.ndarray:
    """East, north, up, turns: unequal and correlated, as position and tilts of a block are."""
    mixed = (
        np.random.default_rng(4).normal(size=(6, 6)) * np.array([0.5, 0.3, 0.8, 0.004, 0.009, 0.02])[:, None]
    )
    return np.asarray(mixed @ mixed.T)


def differences(ground: GroundSurface) -> np.ndarray:
    """By how much places (k, 3, 6) move by a shift and turn of the frame: rays of the moved frame, met anew."""
    found = []
    for axis in range(6):
        ends = []
        for step in (1e-4, -1e-4):
            change = step * np.eye(6)[axis]
            turned = Turn.from_rotvec(change[3:]).as_matrix() @ POSE.rotation.matrix
            moved = Pose(POSE.position_m + change[:3], Rotation(turned))
            ends.append(ground_from_image(moved, CAMERA, ground, IMAGE_PX))
        found.append((ends[0] - ends[1]) / 2e-4)
    return np.stack(found, axis=-1)


def deviations(of: Adjusted, ground: GroundSurface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places that the frame shows, and what is stated of them."""
    places = ground_from_image(POSE, CAMERA, ground, IMAGE_PX)
    found = GroundPropagation(of, ground, 4.0).at(places, np.zeros(len(places), dtype=np.intp))
    return places, found.horizontal_m, found.vertical_m


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.3, -0.2)])
def test_poses_move_places_as_rays_met_with_the_ground_anew(slope: tuple[float, float]) -> None:
    ground, covariance = plane("dem", slope, 0.0), uneven_covariance()
    _, horizontal, vertical = deviations(adjusted(ground, covariance), ground)
    moved = differences(ground)[:, :2]
    expected = np.sqrt(np.trace(moved @ covariance @ np.swapaxes(moved, 1, 2), axis1=1, axis2=2) / 2.0)
    assert horizontal == pytest.approx(expected, rel=1e-4)
    assert vertical == pytest.approx(np.zeros(4))
    assert np.ptp(horizontal) > 0.05


def test_a_height_moves_places_by_the_tangent_of_the_view() -> None:
    """Nothing but 0.4 m of height: rings about the point below the frame, and 0.4 m / sqrt 2 at 45 degrees."""
    ground = plane("dem", (0.0, 0.0), 0.4)
    away = np.linspace(0.0, 50.0, 6)
    for way in (0.0, 1.0, 2.5):
        places = POSE.position_m * [1, 1, 0] + np.stack(
            [away * np.cos(way), away * np.sin(way), 0 * away], axis=1
        )
        found = GroundPropagation(adjusted(ground, np.zeros((6, 6))), ground, 4.0).at(
            places, np.zeros(6, np.intp)
        )
        assert found.horizontal_m == pytest.approx(0.4 * away / 50.0 / np.sqrt(2.0))
        assert found.vertical_m == pytest.approx(np.full(6, 0.4))


def test_beyond_its_grid_the_ground_is_unsure_by_what_it_would_rise() -> None:
    """30 m beyond the last nodes of a slope of 0.1; along its edge and within nothing is added."""
    ground = plane("dem", (0.1, 0.0), 0.4)
    for east, expected in (
        (230.0, np.hypot(0.4, 3.0)),
        (200.0, 0.4),
        (150.0, 0.4),
        (-230.0, np.hypot(0.4, 3.0)),
    ):
        at = np.array([[east, 10.0, float(ground.up_at(east, 10.0))]])
        found = GroundPropagation(adjusted(ground, np.zeros((6, 6))), ground, 4.0).at(
            at, np.zeros(1, np.intp)
        )
        assert found.vertical_m == pytest.approx([expected])


def test_a_slope_towards_the_frame_moves_places_less() -> None:
    """Raised by dh, ground of slope s seen at tangent t is met t dh / (1 + s t) nearer, rising away."""
    for slope in (-0.3, 0.3):
        ground = plane("dem", (slope, 0.0), 0.4)
        at = np.array([[POSE.position_m[0] + 20.0, POSE.position_m[1], 0.0]])
        at[0, 2] = float(ground.up_at(at[0, 0], at[0, 1]))
        tangent = 20.0 / (50.0 - at[0, 2])
        found = GroundPropagation(adjusted(ground, np.zeros((6, 6))), ground, 4.0).at(
            at, np.zeros(1, np.intp)
        )
        assert found.horizontal_m == pytest.approx(0.4 * tangent / (1.0 + slope * tangent) / np.sqrt(2.0))


def test_ground_of_the_block_rises_and_tilts_with_it() -> None:
    """A height that frames have in common moves the tie surface and no place in plan; a DEM stays where it is."""
    common = np.diag([0.0, 0.0, 4.0, 0.0, 0.0, 0.0])
    for kind, status, moved in (
        ("tie_surface", "tied", False),
        ("tie_surface", "placed", True),
        ("dem", "tied", True),
    ):
        ground = plane(kind, (0.1, 0.0), 0.0)
        _, horizontal, vertical = deviations(adjusted(ground, common, status), ground)
        assert (horizontal.max() > 0.1) == moved
        assert vertical == pytest.approx(np.full(4, 0.0 if moved else 2.0))


def test_the_turn_of_a_whole_block_is_a_turn_of_its_ground() -> None:
    """The block turns about the frame: places move as points of a rigid body."""
    ground, covariance = plane("tie_surface", (0.1, 0.05), 0.0), np.zeros((6, 6))
    covariance[3:, 3:] = uneven_covariance()[3:, 3:]
    places, horizontal, vertical = deviations(adjusted(ground, covariance), ground)
    turns = np.random.default_rng(1).multivariate_normal(np.zeros(3), covariance[3:, 3:] * 1e-4, 40_000)
    moved = 100.0 * np.cross(turns[:, None], (places - POSE.position_m)[None])
    assert horizontal == pytest.approx(np.sqrt(np.square(moved[..., :2]).mean(axis=(0, 2))), rel=0.02)
    risen = moved @ [-0.1, -0.05, 1.0]
    assert vertical == pytest.approx(risen.std(axis=0), rel=0.02)


def similar_places() -> tuple[GroundPlaces, np.ndarray]:
    """Places that shift, grow, turn and tilt together, and the deviations of those (6,)."""
    east, north = (a.ravel() for a in np.meshgrid([-30.0, 0.0, 30.0], [-20.0, 5.0, 20.0]))
    at_m = np.stack([east, north, 0.0 * east], axis=1)
    sd = np.array([0.2, 0.1, 0.3, 0.004, 0.003, 0.006])
    modes = similar(at_m)
    return GroundPlaces(at_m, np.einsum("nai,i,mbi->namb", modes, sd**2, modes).reshape(27, 27)), sd


def similar(at_m: np.ndarray) -> np.ndarray:
    """Derivatives (n, 3, 6) by shift, scale, turn and one tilt."""
    east, north = at_m[:, 0], at_m[:, 1]
    out = np.zeros((len(at_m), 3, 6))
    out[:, range(3), range(3)] = 1.0
    out[:, 0, 3], out[:, 1, 3] = east, north
    out[:, 0, 4], out[:, 1, 4] = -north, east
    out[:, 2, 5] = east
    return out


def test_a_block_that_shifts_grows_turns_and_tilts_moves_each_place_by_that() -> None:
    """Also 60 m beyond the last of the places whose covariance is known; heights of a slope move with plan."""
    places, sd = similar_places()
    ground = plane("tie_surface", (0.1, 0.0), 0.0)
    of = replace(adjusted(ground, np.zeros((6, 6))), places=places)
    at_m = np.array([[1.0, 2.0, 0.1], [29.0, -19.0, 2.9], [90.0, -40.0, 9.0]])
    found = GroundPropagation(of, ground, 4.0).at(at_m, np.zeros(3, np.intp))
    moved = similar(at_m) * sd
    assert found.horizontal_m == pytest.approx(np.sqrt(np.square(moved[:, :2]).sum(axis=(1, 2)) / 2.0))
    risen = moved[:, 2] - 0.1 * moved[:, 0]
    assert found.vertical_m == pytest.approx(np.sqrt(np.square(risen).sum(axis=1)))


def test_a_frame_that_is_less_sure_than_its_block_adds_what_it_has_of_its_own() -> None:
    places, _ = similar_places()
    ground = plane("tie_surface", (0.0, 0.0), 0.0)
    at = np.array([[10.0, 5.0, 0.0]]), np.zeros(1, np.intp)
    surer, less_sure = (
        GroundPropagation(replace(adjusted(ground, covariance), places=places), ground, 4.0).at(*at)
        for covariance in (np.zeros((6, 6)), np.diag([0.5, 0.5, 0.0, 0.0, 0.0, 0.0]))
    )
    below = GroundPropagation(replace(adjusted(ground, np.zeros((6, 6))), places=places), ground, 4.0).at(
        POSE.position_m[None] * [1.0, 1.0, 0.0], np.zeros(1, np.intp)
    )
    own_m2 = 0.5 - float(below.horizontal_m[0]) ** 2
    assert less_sure.horizontal_m == pytest.approx(np.sqrt(surer.horizontal_m**2 + own_m2))
    assert less_sure.vertical_m == pytest.approx(surer.vertical_m)


def test_a_cell_with_a_wall_states_the_mean_square_of_its_heights() -> None:
    """Of a cell of 4 m a fifth is as unsure as a wall is high; on smooth ground the middle counts."""
    ground = plane("dense", (0.0, 0.0), 0.1)
    east = np.arange(-40.0, 41.0, 0.1)
    sd_m = np.where((east > 0.5) & (east < 1.1), 5.0, 0.1) * np.ones((len(east), 1))
    at = np.array([[0.0, 0.0, 0.0]]), np.zeros(1, np.intp)
    for kind, expected in (("dense", np.sqrt(0.2 * 25.0 + 0.8 * 0.01)), ("tie_surface", 0.1)):
        walled = GroundSurface(kind, -40.0, -40.0, 0.1, np.zeros(sd_m.shape), sd_m)
        found = GroundPropagation(adjusted(ground, np.zeros((6, 6))), walled, 4.0).at(*at)
        assert found.vertical_m == pytest.approx([expected])


def test_what_is_only_assumed_level_has_no_vertical_deviation() -> None:
    ground = plane("flat", (0.0, 0.0), None)
    _, horizontal, vertical = deviations(adjusted(ground, uneven_covariance()), ground)
    assert np.isfinite(horizontal).all() and np.isnan(vertical).all()


def test_without_a_covariance_the_deviations_of_positions_and_attitudes_count() -> None:
    ground = plane("flat", (0.0, 0.0), None)
    _, horizontal, _ = deviations(adjusted(ground, None), ground)
    variances = np.square([0.3, 0.4, 0.5, 0.01, 0.02, 0.03])
    expected = np.sqrt(np.einsum("nij,j->n", np.square(differences(ground)[:, :2]), variances) / 2.0)
    assert horizontal == pytest.approx(expected, rel=1e-4)


def test_a_matched_surface_has_its_own_deviation_or_that_of_the_ground_before() -> None:
    known = plane("tie_surface", (0.0, 0.0), 0.05)
    for sd_m, expected in ((2.0, 2.0), (np.nan, 0.05)):
        woods = replace(known, kind="dense", sd_m=np.full(known.up_m.shape, sd_m))
        _, _, vertical = deviations(adjusted(known, np.zeros((6, 6))), woods)
        assert vertical == pytest.approx(np.full(4, expected))


def test_what_may_stand_unseen_counts_beyond_the_matched_surface() -> None:
    ground = plane("dense", (0.0, 0.0), 0.1)
    roof = np.zeros((120, 100), dtype=np.float32)
    roof[:30] = 6.0
    matched = np.arange(100) >= np.full((120, 1), 20)
    height_m = standing_m(roof, np.zeros_like(roof), matched)
    assert height_m == pytest.approx(3.0)
    bare, standing = (
        next(iter(cells(ground, 8, MatchedCells(Cells(-40.0, -60.0, 1.0, 120, 100), matched, m)).blocks()))
        for m in (0.0, height_m)
    )
    beyond, seen = bare.source == HeightSource.EXTRAPOLATED, np.isfinite(bare.source)
    assert standing.vertical_m[beyond] == pytest.approx(np.hypot(bare.vertical_m[beyond], 3.0), rel=1e-5)
    assert (standing.horizontal_m[beyond] > bare.horizontal_m[beyond]).all() and beyond.any()
    assert standing.vertical_m[seen & ~beyond] == pytest.approx(bare.vertical_m[seen & ~beyond])


def cells(
    ground: GroundSurface, by: int, matched: MatchedCells | None = None, tied: Area = EVERYWHERE
) -> AccuracyCells:
    """A mosaic of 1,050 x 1,000 pixels of 0.1 m about the origin, of which the frame gives the left half."""
    owner = np.zeros((125, 132), dtype=np.int32)
    owner[:, :64] = 1
    grid = OutputGrid(CRS, float(AT_M[0]) - 52.5, float(AT_M[1]) + 50.0, 0.1, 1050, 1000)
    ownership = Ownership(grid, np.array([True]), 8, owner)
    return AccuracyCells(ownership, by, HOME, adjusted(ground, uneven_covariance()), ground, tied, matched)


def written(of: AccuracyCells, folder: Path) -> Path:
    write_accuracy(folder / "plain.tif", of.grid, of.blocks())
    write_cog(folder / "plain.tif", folder / "accuracy.tif", CogOptions(overviews="nearest"))
    return folder / "accuracy.tif"


def test_the_raster_is_a_cog_with_overviews_named_bands_and_nan(tmp_path: Path) -> None:
    ground = plane("tie_surface", (0.0, 0.0), 0.1)
    path = written(cells(ground, 1), tmp_path)
    assert validate(str(path), full_check=True)[:2] == ([], [])
    with rasterio.open(path) as tiff:
        assert tiff.descriptions == tuple(name for name, _ in BANDS) and tiff.units[:2] == ("m", "m")
        assert tiff.dtypes == ("float32",) * 3 and np.isnan(tiff.nodatavals).all()
        assert tiff.overviews(1)[0] == 2
        assert tiff.crs.to_epsg() == 32632 and (tiff.width, tiff.height) == (1050, 1000)
        values = tiff.read()
        assert set(np.unique(tiff.read(3, out_shape=(500, 525))[:, :250])) == {1.0}
    assert np.isfinite(values[:, :, :512]).all() and np.isnan(values[:, :, 512:]).all()


def test_a_coarser_raster_has_the_same_values_and_the_mosaics_corner(tmp_path: Path) -> None:
    """Cells of 32 px where the finer ones are 2 px; the last ones reach past the mosaic."""
    ground = plane("tie_surface", (0.2, 0.0), 0.1)
    with rasterio.open(written(cells(ground, 2), tmp_path)) as tiff:
        finer = tiff.read(1)
    coarse = cells(ground, 32)
    with rasterio.open(written(coarse, tmp_path)) as tiff:
        assert (tiff.transform.c, tiff.transform.f) == (
            coarse.ownership.grid.west_m,
            coarse.ownership.grid.north_m,
        )
        assert tiff.transform.a == pytest.approx(3.2) and (tiff.width, tiff.height) == (33, 32)
        values = tiff.read(1)
    middles = (finer[7::16, 7::16] + finer[8::16, 8::16])[:31, :16] / 2.0
    assert values[:31, :16] == pytest.approx(middles, rel=1e-3)


def test_heights_come_from_ties_matching_filling_or_beyond(tmp_path: Path) -> None:
    """Matched east of -20 m but for a void, which ties hold south of 0; beyond nothing encloses what is filled."""
    ground = plane("dense", (0.0, 0.0), 0.1)
    west, north = cells(ground, 8).grid.west_m, float(AT_M[1])
    south = np.array(
        [
            [west, north],
            [west, north - 99.0],
            [west + 99.0, north - 99.0],
            [west + 99.0, north],
            [west, north],
        ]
    )
    matched = np.arange(100) >= np.full((120, 1), 20)
    matched[5:-5, 28:32] = False
    surface = MatchedCells(Cells(-40.0, -60.0, 1.0, 120, 100), matched)
    block = next(iter(cells(ground, 8, surface, Area(((south,),))).blocks()))
    east = -52.5 + 0.8 * (np.arange(block.source.shape[1]) + 0.5)
    row = {True: block.source[100], False: block.source[20]}
    for tied in (True, False):
        assert set(row[tied][east < -21.0]) == {HeightSource.EXTRAPOLATED}
        between = HeightSource.FILLED if tied else HeightSource.EXTRAPOLATED
        assert set(row[tied][(east > -11.0) & (east < -9.0)]) == {between}
        assert set(row[tied][(east > -19.0) & (east < -13.0)]) == {HeightSource.MATCHED}
    on_ties = next(iter(cells(plane("tie_surface", (0.0, 0.0), 0.1), 8, None, Area(((south,),))).blocks()))
    assert set(on_ties.source[100, :60]) == {HeightSource.TIE_SURFACE}
    assert set(on_ties.source[20, :60]) == {HeightSource.EXTRAPOLATED}


def test_tie_points_that_count_hold_the_ground_between_them() -> None:
    ground = plane("flat", (0.0, 0.0), None)
    px = np.array([[20.0, 20.0], [200.0, 20.0], [200.0, 150.0], [20.0, 150.0], [239.0, 179.0]])
    weight = np.array([1.0, 1.0, 1.0, 1.0, 0.1])
    residuals = ImageResiduals(np.zeros(5, np.intp), px, 0.0 * px, weight)
    none = TiePoints(())
    tied = tied_area(replace(adjusted(ground, None), image_residuals=residuals), none, HOME, CRS)
    corners = ground_from_image(POSE, CAMERA, ground, px[:4])[:, :2]
    x, y = corners.T
    area = 0.5 * abs(float(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))))
    assert tied.geometry.area == pytest.approx(area, rel=2e-3)
    assert not tied_area(adjusted(ground, None), none, HOME, CRS).polygons
