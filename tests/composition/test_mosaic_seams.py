"""Who gives which part, how frames blend, the walk over the windows, and the memory of decoded frames."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from mosaic_scenes import CRS, GSD_M, make_survey

from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.composition import seam_cut
from geomosaic.composition.blends import BLENDS, Blend, Piece
from geomosaic.composition.compose import CompositionOptions, compose
from geomosaic.composition.frame_cells import frame_cells
from geomosaic.composition.grid import output_grid
from geomosaic.composition.model import MapPixels, OutputGrid
from geomosaic.composition.ownership import Ownership, cell_px_of, nearest_nadir
from geomosaic.composition.plan import windows
from geomosaic.composition.plugins import BLENDS_GROUP, Named
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.scene import Scene
from geomosaic.composition.seam_cut import Shared, cut_pair, cut_seams
from geomosaic.composition.seam_figures import seam_figures
from geomosaic.composition.seam_parts import Glimpse, SeamPart, bands, giving, glimpsed, to_8_bits
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.composition.window import Window
from geomosaic.doors.raster import unreferenced_is_fine
from geomosaic.errors import PluginError
from geomosaic.projection.ground import GroundSurface
from geomosaic.spread import AtOnce
from geomosaic.survey.model import Survey

REACH_PX = 48.0


def halves(width: int = 192, height: int = 160) -> np.ndarray:
    """A label that changes from 0 to 1 in the middle column."""
    return np.repeat((np.arange(width) >= width // 2)[None], height, axis=0).astype(np.int32)


def noise(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 255.0, shape).astype(np.float32)


def blended(name: str, images: list[np.ndarray], inside: np.ndarray, label: np.ndarray) -> np.ndarray:
    whole = slice(0, label.shape[0]), slice(0, label.shape[1])
    pieces = [Piece(*whole, p, np.ascontiguousarray(i)) for p, i in zip(images, inside, strict=True)]
    return BLENDS[name].mosaic(pieces, label.astype(np.int16), REACH_PX)


@given(st.sampled_from(sorted(BLENDS)), st.integers(0, 100))
def test_frames_that_agree_are_left_as_they_are(name: str, seed: int) -> None:
    image, label = noise(seed, 160, 192, 3), halves()
    label[:9] = -1
    inside = np.broadcast_to(label >= 0, (2, 160, 192)).astype(np.float32)
    mosaic = blended(name, [image, image], inside, label)
    assert np.abs(mosaic - image)[label >= 0].max() < 0.01


@pytest.mark.parametrize("name, step", [("hard", 60.0), ("feather", 60.0 / 48.0), ("multi_band", 1.72)])
def test_a_difference_in_brightness_is_spread_over_the_reach(name: str, step: float) -> None:
    """Of 60 grey levels, from frame to frame; by `multi_band` over 16 px and more to either side."""
    images = [np.full((160, 192, 1), level, np.float32) for level in (80.0, 140.0)]
    mosaic = blended(name, images, np.ones((2, 160, 192), np.float32), halves())
    row = mosaic[80, :, 0]
    assert np.abs(np.diff(row)).max() == pytest.approx(step, rel=0.05)
    assert row[[8, -8]].tolist() == pytest.approx([80.0, 140.0], abs=0.1)
    assert (np.diff(row) > -0.01).all()


def test_fine_detail_is_not_doubled_by_bands() -> None:
    """Two frames whose lines lie two pixels apart: feathered there are four lines at the seam, by bands two."""
    images = [np.full((160, 192, 1), 100.0, np.float32) for _ in range(2)]
    for k, image in enumerate(images):
        image[80 + 4 * k] = 200.0
    label = halves()
    shown = np.ones((2, 160, 192), np.float32)
    contrast = {
        name: np.abs(blended(name, images, shown, label)[76:90, 84, 0] - 100.0)
        for name in ("feather", "multi_band")
    }
    assert contrast["multi_band"][8] < 0.5 * contrast["feather"][8]
    assert contrast["multi_band"][4] > 1.2 * contrast["feather"][4]


@pytest.mark.parametrize("name", sorted(BLENDS))
def test_what_a_frame_doesnt_show_pulls_nothing_towards_black(name: str) -> None:
    """The left frame ends 10 px before its label does not: beyond it nothing is known; above neither is."""
    label = halves()
    label[:20] = -1
    inside = np.ones((2, 160, 192), np.float32)
    inside[:, :20] = 0.0
    inside[0, :, 96:] = 0.0
    inside[1, :, :96] = 0.0
    images = [np.where(i[..., None] > 0.0, np.float32(120.0), np.float32(0.0)) for i in inside]
    mosaic = blended(name, images, inside, label)
    assert np.abs(mosaic[label >= 0] - 120.0).max() < 0.01


@given(st.sampled_from(sorted(BLENDS)), st.integers(0, 40))
def test_a_blend_looks_no_farther_than_its_halo(name: str, seed: int) -> None:
    halo = BLENDS[name].halo_px(REACH_PX)
    side = 2 * halo + 32
    images = [noise(seed + k, side + 128, side + 128, 1) for k in range(2)]
    label = (noise(seed + 2, 6, 6) > 128.0).astype(np.int32).repeat(96, 0).repeat(96, 1)
    label = label[: side + 128, : side + 128]
    inside = np.ones((2, *label.shape), np.float32)
    whole = blended(name, images, inside, label)
    at = slice(64, 64 + side)
    cut = [np.ascontiguousarray(p[at, at]) for p in images]
    part = blended(name, cut, inside[:, at, at], np.ascontiguousarray(label[at, at]))
    middle = slice(halo, halo + 32)
    assert np.abs(part[middle, middle] - whole[at, at][middle, middle]).max() < 0.3


def scene_of(folder: Path, **options) -> tuple:  # type: ignore[no-untyped-def,type-arg]
    survey, poses, ground = make_survey(folder, **options)
    cameras = [survey.camera_of(i) for i in range(len(poses))]
    views = frame_views(PosedFrames(survey, poses, cameras, [True] * len(poses), ground), CRS)
    grid = output_grid(MapPixels(CRS, GSD_M), views, [f.name for f in survey.frames])
    return survey, poses, cameras, ground, Scene(survey.work_frame, ground, grid, views)


def test_each_cell_goes_to_the_frame_that_sees_it_most_steeply(tmp_path: Path) -> None:
    *_, scene = scene_of(tmp_path)
    owned, distance_m = nearest_nadir(scene, [True] * 6, cell_px_of(scene))
    assert owned.cell_px == 8
    grid = scene.grid
    middle = [grid.width_px // 16, grid.height_px // 16]
    east, north = grid.map_from_pixel((np.array(middle) + 0.5) * 8)
    away_m = [float(np.hypot(*(v.nadir_m - [east, north]))) for v in scene.views]
    assert owned.owner[middle[1], middle[0]] == scene.views[int(np.argmin(away_m))].frame + 1
    assert distance_m[middle[1], middle[0]] == pytest.approx(min(away_m), abs=0.01)
    assert (owned.owner == 0).sum() > 0 and np.isinf(distance_m[owned.owner == 0]).all()


@pytest.mark.parametrize("times", [1.9, 3.5])
def test_frames_far_above_others_give_only_what_these_do_not_see(tmp_path: Path, times: float) -> None:
    """Three lines at 50 m and one frame higher up, whose nadir point lies between theirs."""
    survey, poses, ground = make_survey(tmp_path, lines=3, per_line=6)
    high = replace(survey.frames[8], name="high.tif")
    there = poses.positions_m[8] * [1.0, 1.0, times] + [3.0, 2.0, 0.0]
    posed = PosedFrames(
        replace(survey, frames=(*survey.frames, high)),
        replace(
            poses,
            **{
                name: np.concatenate([getattr(poses, name), getattr(poses, name)[8:9]])
                for name in ("positions_m", "rotations", "positions_sd_m", "rotations_sd_rad")
            },
        ),
        [survey.camera_of(0)] * 19,
        [True] * 19,
        ground,
    )
    posed.poses.positions_m[18] = there
    views = frame_views(posed, CRS)
    names = [f.name for f in posed.survey.frames]
    scene = Scene(survey.work_frame, ground, output_grid(MapPixels(CRS, GSD_M), views, names), views)
    low = nearest_nadir(replace(scene, views=views[:18]), [True] * 19, 8)[0].owner
    nearest, found = glimpses(posed.survey, scene)
    assert not ((low > 0) & (nearest.owner == 19)).any() and (nearest.owner == 19).any()
    (part,) = (its for its in found if its.frame == 18)
    assert not (part.may & (low[part.of_all] > 0)).any()


def test_windows_anywhere_see_the_same_owners() -> None:
    owner = np.arange(1, 13, dtype=np.int32).reshape(3, 4)
    owned = Ownership(OutputGrid(CRS, 0.0, 0.0, 1.0, 120, 96), np.ones(12, bool), 32, owner)
    row, col, around = owned.around(Window(40, -8, 16, 16))
    assert (row, col, around.shape) == (-2, 0, (4, 3))
    assert around[-1].tolist() == [5, 6, 7] and around[0].tolist() == [1, 2, 3]


def glimpses(survey: Survey, scene: Scene) -> tuple[Ownership, list[SeamPart]]:
    """The nearest frames' cells, and what each frame may give of them."""
    nearest, distance_m = nearest_nadir(scene, [True] * len(survey.frames), 8)
    jobs = [Glimpse(survey.frames[b.view.frame], 1, b)
            for b in bands(scene, nearest, distance_m, giving(scene, nearest))]  # fmt: skip
    return nearest, [glimpsed(scene, 8, None, job) for job in jobs]


def eights(values: np.ndarray) -> np.ndarray:
    """Values (h, w) as an image of 8 bits shows them."""
    return values[..., None].astype(np.float16)


def test_wild_nodata_of_measured_values_spoils_no_seam_and_no_blend(tmp_path: Path) -> None:
    """Two frames of fractions, each with a block of -3.4e38 where the other one shows the ground."""
    survey, poses, cameras, ground, scene = scene_of(
        tmp_path / "frames", lines=1, per_line=2, dtype="float32", bands=1
    )
    for k, frame in enumerate(survey.frames):
        with unreferenced_is_fine(), rasterio.open(frame.path, "r+") as tiff:
            pixels = tiff.read(1)
            pixels[60:110, 60 + 80 * k : 100 + 80 * k] = -3.4e38
            tiff.write(pixels, 1)
            tiff.nodata = -3.4e38
    nearest, found = glimpses(survey, scene)
    owned = cut_seams(nearest, found)
    assert all((np.abs(part.values) <= 1.0).all() for part in found)
    frames = PosedFrames(survey, poses, cameras, [True] * 2, ground)
    compose(frames, owned, MosaicFiles(tmp_path / "mosaic.tif"), CompositionOptions("feather"))
    with rasterio.open(tmp_path / "mosaic.tif") as mosaic:
        shown, valid = mosaic.read(1), mosaic.dataset_mask() > 0
    assert np.isfinite(shown).all() and shown[valid].min() >= 0.0 and shown[valid].max() <= 1.0


@pytest.mark.parametrize(("values", "scale"), [(np.float16, 1.0), (np.float32, 255.0 / 0.3)])
def test_a_frame_that_glints_leaves_the_scale_of_seams_as_it_is(values: Any, scale: float) -> None:
    """Reflectances of 0.3, and of 2 in one frame; the same numbers of 8 bits are grey levels."""
    cells = np.ones((12, 12), dtype=bool)
    parts = [
        SeamPart(k, np.zeros(2), 0, 0, np.full((12, 12, 1), of, values), cells)
        for k, of in enumerate((0.3, 0.3, 0.3, 2.0))
    ]
    assert to_8_bits(parts) == pytest.approx(scale, rel=1e-5)


def test_a_strip_of_one_row_goes_to_a_frame_that_sees_it_as_finely(tmp_path: Path) -> None:
    """Next to its northern edge the nearest frame sees nothing; one as fine does, and one three times as
    coarse."""
    survey, poses, ground = make_survey(tmp_path, lines=1, per_line=3)
    cameras = [Camera("cam", 240, rows, 200.0, 120.0, rows / 2.0) for rows in (180, 300, 180)]
    at_m = np.array([[0.0, 0.0, 50.0], [0.0, -5.0, 50.0], [0.0, 0.0, 150.0]])
    level = np.repeat(Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0).matrix[None], 3, axis=0)
    poses = replace(poses, positions_m=at_m, rotations=level)
    views = frame_views(PosedFrames(survey, poses, cameras, [True] * 3, ground), CRS)
    east_m, north_m = views[0].nadir_m
    edge_m = north_m + 22.5 + 0.6  # of the row of cells that holds the frame's edge, in its southern half
    grid = OutputGrid(CRS, east_m - 16.0, edge_m + 4.0, 0.25, 128, 80)
    owned, _ = nearest_nadir(Scene(survey.work_frame, ground, grid, views), [True] * 3, 8)
    assert owned.owner[:, 8].tolist() == [2, 2, *[1] * 8]
    assert (owned.owner == owned.owner[:, :1]).all()


def test_seams_go_where_frames_agree(tmp_path: Path) -> None:
    """Two frames alike in one lane of cells only, which leads next to the line halfway between them."""
    survey, *_, scene = scene_of(tmp_path, lines=1, per_line=2)
    nearest, found = glimpses(survey, scene)
    one, other = (part.of_all for part in found)
    rows, cols = (range(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(one, other, strict=True))
    across = len(cols) < len(rows)
    shared = cols if across else rows
    lane = shared[len(shared) // 2 + 2]
    parts = []
    for k, part in enumerate(found):
        row, col = np.mgrid[part.of_all]
        off = np.abs((col if across else row) - lane) > 1
        parts.append(replace(part, values=eights(np.where(off, 100.0 + 60.0 * k, 100.0))))
    cut = cut_seams(nearest, parts)
    before, after = (seam_figures(o, parts) for o in (nearest, cut))
    assert before.difference_mean > 30.0 > 10.0 > after.difference_mean
    assert ((cut.owner > 0) == (nearest.owner > 0)).all(), "no gap, nothing new"
    assert (cut.owner != nearest.owner).any()


def test_seams_keep_off_what_stands_on_the_ground(tmp_path: Path) -> None:
    """Two frames that differ alike everywhere, and a house on the line halfway between them."""
    off_m, up_m = np.abs(np.arange(201) - 100.0), np.zeros((201, 201))
    up_m[np.ix_(off_m <= 5, off_m <= 5)] = 6.0
    house = GroundSurface("dem", -100.0, -100.0, 1.0, up_m)
    survey, *_, scene = scene_of(tmp_path, lines=1, per_line=2, ground=house)
    nearest, found = glimpses(survey, scene)
    parts = []
    for k, part in enumerate(found):
        assert part.standing is not None and 0.0 < part.standing.mean() < 0.1
        parts.append(replace(part, values=eights(np.full(part.may.shape, 100.0 + 5.0 * k))))
    cut = cut_seams(nearest, parts)
    assert (seam_figures(nearest, parts).on_objects or 0.0) > 0.05
    assert seam_figures(cut, parts).on_objects == 0.0
    blind = [replace(p, standing=None) for p in parts]
    assert seam_figures(cut_seams(nearest, blind), parts).on_objects != 0.0
    assert seam_figures(cut, blind).on_objects is None


def crossed(first: np.ndarray, difference: np.ndarray) -> float:
    """What a cut costs: how far both differ at both cells of each of its steps."""
    total = 0.0
    for axis in (0, 1):
        one, other = (np.moveaxis(first, axis, 0)[s] for s in (slice(None, -1), slice(1, None)))
        left, right = (np.moveaxis(difference, axis, 0)[s] for s in (slice(None, -1), slice(1, None)))
        total += float((left + right)[one != other].sum())
    return total


@pytest.mark.parametrize("seed", range(2))
def test_a_large_cut_is_as_good_as_one_in_small_cells_alone(seed: int) -> None:
    """What either frame alone may give stays its own; the rest costs at most a tenth more than the least."""
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.uniform(0.0, 60.0, (25, 25)), (200, 200), interpolation=cv2.INTER_CUBIC)
    difference = np.abs(coarse + rng.normal(0.0, 4.0, (200, 200)))
    col = np.arange(200) + rng.integers(-3, 3, (200, 1))
    one, other = col < 170, col > 30
    assert (one & other).sum() > seam_cut._MANY_CELLS
    values = np.zeros((200, 200, 1)), difference[..., None]
    first = cut_pair(1.0, Shared((one, other), values, None))
    assert first[one & ~other].all() and not first[other & ~one].any()
    shown = [np.repeat(of, 3, axis=2).astype(np.float32) for of in values]
    least = np.where(one & other, seam_cut._least_cut(shown, one, other), one)
    assert crossed(first, difference) <= 1.1 * crossed(least, difference)


def test_pairs_cut_at_once_have_no_frame_in_common(tmp_path: Path) -> None:
    """So the seams are the same, whoever cuts which pair first."""
    survey, *_, scene = scene_of(tmp_path)
    nearest, parts = glimpses(survey, scene)
    rounds: list[int] = []

    class Backwards(AtOnce):
        def map(self, name: str, function: Any, items: Sequence[Any], keys: Sequence[Any]) -> list[Any]:
            rounds.append(len(items))
            return super().map(name, function, items[::-1], keys[::-1])[::-1]

    backwards = cut_seams(nearest, parts, Backwards())
    assert len(rounds) < sum(rounds) and max(rounds) <= len(parts) // 2
    assert np.array_equal(backwards.owner, cut_seams(nearest, parts).owner)


def test_places_between_cells_that_are_exact(tmp_path: Path) -> None:
    """Hills, seen tilted: to half a pixel; where the lens ends near the frame, all are exact."""
    wave = 8.0 * np.sin(np.arange(101) / 8.0)
    hills = GroundSurface("dem", -150.0, -150.0, 3.0, wave[:, None] + wave)
    *_, scene = scene_of(tmp_path, ground=hills, camera=Camera("cam", 240, 180, 200.0, 120.0, 90.0))
    off: list[float] = []
    for view in scene.views:
        exact, smooth = (frame_cells(scene, view, 1, smooth=s) for s in (False, True))
        away = np.hypot(exact.cols_px - smooth.cols_px, exact.rows_px - smooth.rows_px)
        off += away[exact.margin_px > 0.0].tolist()
    assert 0.01 < max(off) < 0.5
    for view in scene.views:  # cells so large that the lens ends within one of the frame's corners
        exact, smooth = (frame_cells(scene, view, 8, smooth=s) for s in (False, True))
        assert np.array_equal(exact.cols_px, smooth.cols_px, equal_nan=True)


def test_the_mosaic_is_made_as_it_is_owned(tmp_path: Path) -> None:
    survey, poses, cameras, ground, scene = scene_of(tmp_path / "frames", lines=1, per_line=2)
    frames = PosedFrames(survey, poses, cameras, [True] * 2, ground)
    nearest, _ = nearest_nadir(scene, [True] * 2, 8)
    swapped = replace(nearest, owner=np.where(nearest.owner > 0, 2, 0).astype(np.int32))
    sources = tmp_path / "sources.tif"
    for ownership, share in ((nearest, (0.35, 0.65)), (swapped, (0.0, 0.4))):
        raster = tmp_path / "mosaic.tif"
        compose(frames, ownership, MosaicFiles(raster, sources), CompositionOptions("hard"))
        with rasterio.open(sources) as tiff:
            index = tiff.read(1)
        first = (index == 1).sum() / (index > 0).sum()
        assert share[0] <= first <= share[1], "what the second frame doesn't see the first one gives"


def test_windows_cover_the_grid_once_and_walk_from_neighbour_to_neighbour():
    grid = OutputGrid("EPSG:32632", 0.0, 0.0, 1.0, 1000, 1900)
    seen = np.zeros((1900, 1000), dtype=int)
    walk = windows(grid, 128)
    for w in walk:
        seen[w.row : w.row + w.height, w.col : w.col + w.width] += 1
    assert (seen == 1).all()
    steps = [abs(a.col - b.col) + abs(a.row - b.row) for a, b in itertools.pairwise(walk)]
    assert np.mean([s == 128 for s in steps]) > 0.85


def test_other_distributions_bring_blends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that works, one that can't be loaded, one that is no blend, one whose name is taken."""
    meta = tmp_path / "thirds-1.2.dist-info"
    meta.mkdir()
    (meta / "METADATA").write_text("Metadata-Version: 2.1\nName: thirds\nVersion: 1.2\n")
    lines = ["works = thirds:works", "gone = thirds:gone", "number = thirds:number", "hard = thirds:works"]
    (meta / "entry_points.txt").write_text("\n".join([f"[{BLENDS_GROUP}]", *lines]))
    code = "from geomosaic.composition.blends import Blend, hard\nworks = Blend(hard, lambda px: 0)\nnumber = 3\n"
    (tmp_path / "thirds.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    known = Named({"hard": BLENDS["hard"]}, BLENDS_GROUP, lambda found: isinstance(found, Blend))
    assert list(known) == ["gone", "hard", "number", "works"]
    assert known["works"].halo_px(9.0) == 0
    for name, said in (
        ("gone", r"can't be loaded from thirds:gone \(thirds 1\.2\)"),
        ("number", r"of thirds:number \(thirds 1\.2\) is none: 3"),
        ("hard", r"claimed by geomosaic itself and by thirds:works \(thirds 1\.2\)"),
    ):
        with pytest.raises(PluginError, match=said):
            known[name]
    with pytest.raises(KeyError):
        known["soft"]
