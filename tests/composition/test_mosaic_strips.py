"""The scene composed of strips: real files, absolute greys, masks, seams, memory."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio

from geomosaic.ccd.layout import StripLookup, image_space_layout
from geomosaic.ccd.model import PairOffsets, StripOffsets
from geomosaic.ccd.radiometry import Radiometry
from geomosaic.composition.blends import BLENDS
from geomosaic.composition.strip_compose import PlacedStrips, StripOptions, compose_strips
from geomosaic.errors import FileError, UnknownNameError
from geomosaic.spread import Unobserved
from geomosaic.survey.strips import Ccd, StripGeometry, read_geometry
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strip_scene import StripWorld
from geomosaic_simulate.strips import simulate_strips

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
WIDTH, OVERLAP, SEPARATION = 120, 24, 100
NOMINAL = StripOffsets("none", ())


def write(path, pixels, nodata=None):
    profile = {"driver": "GTiff", "count": 1, "dtype": pixels.dtype, "nodata": nodata}
    with rasterio.open(path, "w", width=pixels.shape[1], height=pixels.shape[0], **profile) as strip:
        strip.write(pixels, 1)


def ground(cols, lines):
    """A smooth scene, band-limited: greys of 400 to 600 at any scene cols and scene lines."""
    cols, lines = np.broadcast_arrays(cols, lines)
    wave = np.sin(cols / 7.0 + 0.3 * np.sin(lines / 31.0)) + 0.8 * np.cos(lines / 9.0 - cols / 23.0)
    return 500.0 + 50.0 * wave


def strips(
    folder, lines=900, ccds=3, dcol=0.0, dline=0.0, bit_depth=10, dtype="uint16", dead=(), change=None
):
    """CCDs whose right strip of each pair has the ground dcol, dline off its nominal place, each by halves."""
    folder.mkdir(parents=True, exist_ok=True)
    listed, counts = [], []
    for k in range(ccds):
        row = 1 + k % 2
        col, line = np.arange(WIDTH) + 0.5, np.arange(lines)[:, None] + 0.5
        nominal = line + (SEPARATION / 2 if row == 1 else -SEPARATION / 2)
        # With one offset d for every pair the displacements are +- d / 2 in turn: only for two CCDs.
        half = 0.5 if k % 2 else -0.5
        pixels = ground(k * (WIDTH - OVERLAP) + col - half * dcol, nominal - half * dline)
        pixels = np.rint(pixels).astype(dtype)
        if change is not None:
            pixels = change(k, pixels)
        counts.append(0 if k in dead else len(pixels))
        listed.append(Ccd(None if k in dead else folder / f"{k}.tif", row))
        if k not in dead:
            write(folder / f"{k}.tif", pixels)
    return StripGeometry(
        ccds=tuple(listed),
        width_px=WIDTH,
        lines=tuple(counts),
        overlap_px=OVERLAP,
        read_px=OVERLAP + 6,
        row_separation_lines=float(SEPARATION),
        line_rate_hz=3000.0,
        bit_depth=bit_depth,
    )


def offsets(g, dcol, dline, pairs=(0,)):
    n = np.zeros(g.lines[0])
    label = n.astype(np.uint8)
    return StripOffsets("given", tuple(PairOffsets(k, n + dcol, n + dline, n, n, label) for k in pairs))


def composed(g, out, layout=None, radiometry=None, **how):
    layout = image_space_layout(g, NOMINAL) if layout is None else layout
    mosaic = compose_strips(PlacedStrips(g, layout, radiometry), out, StripOptions(**how))
    with rasterio.open(out) as raster:
        return mosaic, raster.read(1), raster.read_masks(1) == 255


def expected(layout):
    lines = layout.first_line + np.arange(layout.height_px)[:, None] + 0.5
    return ground(np.arange(layout.width_px) + 0.5, lines)


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("resampling", ["bilinear", "cubic", "lanczos"])
def test_nominal_places_give_the_strips_own_pixels(tmp_path, blend, resampling):
    g = strips(tmp_path)
    layout = image_space_layout(g, NOMINAL)
    mosaic, pixels, valid = composed(g, tmp_path / "m.tif", layout, blend=blend, resampling=resampling)
    np.testing.assert_array_equal(pixels[valid], np.rint(expected(layout))[valid])
    inside = np.zeros(pixels.shape, dtype=bool)
    for k in range(3):
        start = SEPARATION if k % 2 == 0 else 0
        inside[start : start + 900, slice(*layout.cols(k))] = True
    np.testing.assert_array_equal(valid, inside)
    assert (pixels[~valid] == 0).all()
    assert (mosaic.width_px, mosaic.height_px, mosaic.first_line) == (312, 1000, -50.0)
    assert mosaic.lines_read == (900, 900, 900)
    assert (mosaic.raster, mosaic.dtype, mosaic.bit_depth, mosaic.gaps_px) == ("m.tif", "uint16", 10, ())


@pytest.mark.parametrize("dcol", [3.3, -3.3])
@pytest.mark.parametrize("blend", BLENDS)
def test_offsets_bring_the_ground_to_its_place(tmp_path, dcol, blend):
    g = strips(tmp_path, ccds=2, dcol=dcol, dline=5.6)
    layout = image_space_layout(g, offsets(g, dcol, 5.6))
    _, pixels, valid = composed(g, tmp_path / "m.tif", layout, blend=blend)
    error = pixels - expected(layout)
    # Two roundings, and strips' edges.
    assert np.abs(error[valid]).max() < 2.0
    assert np.sqrt((error[valid] ** 2).mean()) < 0.41
    wrong = image_space_layout(g, offsets(g, -dcol, -5.6))
    _, pixels, valid = composed(g, tmp_path / "w.tif", wrong, blend=blend)
    assert np.sqrt(((pixels - expected(wrong))[valid] ** 2).mean()) > 5.0


def test_threads_and_blends_by_bytes(tmp_path):
    g = strips(tmp_path, ccds=2, dcol=1.3, dline=-2.4)
    layout = image_space_layout(g, offsets(g, 1.3, -2.4))
    made = {}
    for name, how in {
        "a": {"threads": 1},
        "b": {"threads": 3},
        "c": {"blend": "hard"},
        "d": {"blend": "multi_band"},
    }.items():
        compose_strips(PlacedStrips(g, layout), tmp_path / f"{name}.tif", StripOptions(**how))
        made[name] = (tmp_path / f"{name}.tif").read_bytes()
    assert made["a"] == made["b"]
    assert len({made[n] for n in "acd"}) == 3


def test_radiometry_before_resampling_and_saturation_kept(tmp_path):
    def change(k, pixels):
        if k == 1:
            pixels[:, 30:60] = 1023
            pixels[:, 70:80] = 1010
        return pixels

    g = strips(tmp_path, ccds=2, change=change)
    layout = image_space_layout(g, NOMINAL)
    greys = Radiometry(np.array([1.0, 0.95]), np.array([0.0, 7.0]))
    _, pixels, _ = composed(g, tmp_path / "m.tif", layout, greys)
    assert (pixels[50:300, 96 + 30 : 96 + 60] == 1023).all()
    assert (pixels[50:300, 96 + 71 : 96 + 79] == round(1010 * 0.95 + 7)).all()
    row = 200
    own = ground(np.array([96 + 90.5]), layout.first_line + row + 0.5)
    assert pixels[row, 96 + 90] == pytest.approx(np.rint(own[0]) * 0.95 + 7, abs=0.5)
    greys = Radiometry(np.array([1.0, 1.05]), np.array([0.0, 7.0]))
    _, pixels, _ = composed(g, tmp_path / "m.tif", layout, greys)
    assert (pixels[50:300, 96 + 30 : 96 + 80][:, [5, 45]] == 1023).all()


@pytest.mark.parametrize("resampling", ["cubic", "lanczos"])
def test_no_overshoot_beyond_the_bits(tmp_path, resampling):
    def change(k, pixels):
        return np.where(np.arange(WIDTH) // 10 % 2, 1023, 0).astype(np.uint16)[None].repeat(900, 0)

    g = strips(tmp_path, ccds=2, change=change)
    _, pixels, valid = composed(
        g, tmp_path / "m.tif", image_space_layout(g, offsets(g, 1.0, 1.0)), resampling=resampling
    )
    assert pixels[valid].max() == 1023
    assert pixels[valid].min() == 0


@pytest.mark.parametrize(("dtype", "bits"), [("uint8", 8), ("int16", 12)])
def test_types(tmp_path, dtype, bits):
    def change(k, pixels):
        return (np.arange(900)[:, None] % 200 + np.zeros(WIDTH)).astype(dtype)

    g = strips(tmp_path, ccds=2, bit_depth=bits, change=change)
    mosaic, pixels, _ = composed(g, tmp_path / "m.tif")
    assert mosaic.dtype == dtype == str(pixels.dtype)
    np.testing.assert_array_equal(pixels[:900, 150], np.arange(900) % 200)
    with rasterio.open(tmp_path / "m.tif") as raster:
        assert raster.tags(1)["NBITS"] == str(bits)
        assert raster.block_shapes == [(512, 512)]
        assert raster.crs is None


def test_nodata_is_masked_and_leaks_nowhere(tmp_path):
    hole = slice(400, 420), slice(50, 56)

    def change(k, pixels):
        if k == 0:
            pixels[hole] = 0
            pixels[500:530, 100:] = 0  # in the overlap, which the right strip has
        return pixels

    g = dataclasses.replace(strips(tmp_path, ccds=2, dcol=1.0, dline=1.0, change=change), nodata=0.0)
    layout = image_space_layout(g, offsets(g, 1.0, 1.0))
    for how in ("cubic", "lanczos"):
        _, pixels, valid = composed(g, tmp_path / "m.tif", layout, blend="multi_band", resampling=how)
        error = np.abs(pixels - expected(layout))
        # The left strip's line u at scene line u + 50.5, col c at c + 0.5: a hole's edge in half pixels.
        top = int(400 + 50 + 0.5 - layout.first_line)
        assert not valid[top : top + 19, 51:55].any()
        assert valid[top - 2, 45:60].all()
        assert valid[top + 22, 45:60].all()
        assert valid[top : top + 19, [48, 49, 58]].all()
        near = np.zeros(valid.shape, dtype=bool)
        near[top - 8 : top + 30, 42:65] = True
        assert (
            error[valid & ~near].max() < 6.0
        )  # strips' edges repeat half a pixel; zeros let in make 40 and more
        assert error[valid & near].max() < 60.0
        there = slice(int(500 + 51 - layout.first_line), int(528 + 51 - layout.first_line))
        assert valid[there, 100:120].all()
        assert error[there, 100:120].max() < 6.0


def test_nodata_is_no_grey_where_there_is_none(tmp_path):
    def change(k, pixels):
        pixels[:, ::2] = 0
        return pixels

    g = strips(tmp_path, ccds=2, change=change)
    _, pixels, valid = composed(g, tmp_path / "m.tif")
    assert valid[150:850].all()
    assert (pixels[150:850, 0:90:2] == 0).all()


def test_dead_short_and_all_of_it_read_once(tmp_path):
    g = strips(tmp_path, ccds=4, dead=(1,), change=lambda k, p: p[:600] if k == 3 else p)
    layout = image_space_layout(g, NOMINAL)
    mosaic, pixels, valid = composed(g, tmp_path / "m.tif", layout)
    assert mosaic.gaps_px == ((120, 192),)
    assert mosaic.lines_read == (900, 0, 900, 600)
    assert not valid[:, 120:192].any()
    assert valid[100:1000, :120].all()
    assert valid[100:1000, 192:312].all()  # its own pixels to its edge where the short one ends
    assert not valid[600:, 312:].any()
    np.testing.assert_array_equal(pixels[valid], np.rint(expected(layout))[valid])


@pytest.mark.parametrize("blend", BLENDS)
def test_blends(tmp_path, blend):
    """A right strip 30 brighter, with overlaps of 24 px that offsets may make 6 narrower from either side."""
    g = strips(tmp_path, ccds=2, change=lambda k, p: (0 * p + 500 + 30 * k).astype(np.uint16))
    _, pixels, _ = composed(g, tmp_path / "m.tif", blend=blend)
    row = pixels[500].astype(int)
    assert (np.diff(row) >= 0).all()
    if blend != "multi_band":
        assert row[95] == 500 and row[120] == 530
    if blend == "hard":
        assert row[107:109].tolist() == [500, 530]
    if blend == "feather":
        ramp = 500.0 + 30.0 * np.clip(0.5 + (np.arange(96, 120) + 0.5 - 108.0) / 12.0, 0.0, 1.0)
        assert np.abs(row[96:120] - ramp).max() < 1.5, "straight over twice the six pixels of a side"
    if blend == "multi_band":
        assert np.diff(row).max() <= 4
        assert row[40] == 500 and row[175] == 530


def test_multi_band_keeps_detail_sharp(tmp_path):
    """Both strips see stripes, the right one half a period off: feathered they vanish, by bands they don't."""

    def stripes(k, p):
        return np.rint(500.0 + 200.0 * (k - 0.5) * (-1.0) ** (np.arange(900)[:, None] // 2) + 0 * p).astype(
            "u2"
        )

    g = dataclasses.replace(strips(tmp_path, ccds=2, change=stripes), read_px=OVERLAP)
    contrast = {}
    for blend in BLENDS:
        _, pixels, _ = composed(g, tmp_path / "m.tif", blend=blend)
        contrast[blend] = np.ptp(pixels[500:504, 96:120].astype(int), axis=0)
    assert (contrast["hard"] == 200).all()
    assert (contrast["multi_band"] > 195).sum() >= 18
    assert (contrast["feather"] > 195).sum() <= 6


def test_blend_of_one_sided_pixels(tmp_path):
    """A right strip 40 brighter that begins 100 rows later: until then the left one's pixels, unblended."""
    g = strips(tmp_path, ccds=2, change=lambda k, p: (0 * p + 500 + 40 * k).astype(np.uint16))
    for blend in BLENDS:
        _, pixels, _ = composed(g, tmp_path / "m.tif", blend=blend)
        spread = 64 if blend == "multi_band" else 0
        assert (pixels[: 100 - spread, 96 + spread :] == 540).all()
        assert (pixels[900 + spread :, : 120 - spread] == 500).all()
        assert (pixels[100:900, : 96 - spread] == 500).all()
        middle = pixels[500, 96 - spread : 120 + spread].astype(int)
        assert (middle[0], middle[-1]) == (500, 540)
        assert (np.diff(middle) >= 0).all()


def test_layouts_with_many_knots(tmp_path):
    """What object space gives: knots every few columns, here of a curve."""
    g = strips(tmp_path, ccds=2)
    base = image_space_layout(g, NOMINAL)

    class Curved:
        first_line, width_px, height_px, seams_px = (
            base.first_line,
            base.width_px,
            base.height_px,
            base.seams_px,
        )
        cols = staticmethod(base.cols)

        def places(self, ccd, top, bottom):
            first, last = self.cols(ccd)
            knots = np.append(np.arange(first, last, 7.0), last)
            t = self.first_line + np.arange(top, bottom)[:, None] + 0.5
            bend = 0.0004 * (knots - 100.0) ** 2  # scene col x, line t show what nominally is at t + bend
            line = t + bend + (-50.0 if ccd == 0 else 50.0)
            return StripLookup(knots, np.stack([np.broadcast_to(knots - first, line.shape), line]))

    _, pixels, valid = composed(g, tmp_path / "m.tif", Curved())
    cols = np.arange(base.width_px) + 0.5
    lines = base.first_line + np.arange(base.height_px)[:, None] + 0.5
    want = ground(cols, lines + 0.0004 * (cols - 100.0) ** 2)
    assert valid[150:850].all()
    assert np.abs(pixels - want)[valid].max() < 3.0


@pytest.mark.parametrize("nodata", [None, 0.0])
def test_places_that_are_none(tmp_path, nodata):
    """A knot without a place: nothing up to the next knots; the right strip stands in where it has pixels."""
    g = strips(tmp_path, ccds=2)
    if nodata is not None:
        with rasterio.open(g.ccds[0].path, "r+") as strip:
            strip.write(np.zeros((1, 1), np.uint16), 1, window=rasterio.windows.Window(0, 0, 1, 1))
        g = dataclasses.replace(g, nodata=nodata)
    base = image_space_layout(g, NOMINAL)

    class Holed:
        first_line, width_px, height_px, seams_px = (
            base.first_line,
            base.width_px,
            base.height_px,
            base.seams_px,
        )
        cols = staticmethod(base.cols)

        def places(self, ccd, top, bottom):
            first, last = self.cols(ccd)
            knots = np.arange(first, last + 1.0, 8.0)
            line = self.first_line + np.arange(top, bottom)[:, None] + 0.5 + 0.0 * knots
            line += -50.0 if ccd == 0 else 50.0
            if ccd == 0:
                line[:, [5, 13]] = np.nan  # cols 40 and 104
            return StripLookup(knots, np.stack([np.broadcast_to(knots - first, line.shape), line]))

    mosaic, pixels, valid = composed(g, tmp_path / "m.tif", Holed())
    assert mosaic.lines_read == (900, 900)
    assert valid[150:850, :32].all()
    assert not valid[:, 32:48].any()
    assert valid[150:850, 48:].all()
    np.testing.assert_array_equal(pixels[valid], np.rint(expected(base))[valid])


def test_bad_names_and_broken_strips(tmp_path):
    g = strips(tmp_path, ccds=2)
    layout = image_space_layout(g, NOMINAL)
    with pytest.raises(UnknownNameError, match="blend"):
        compose_strips(PlacedStrips(g, layout), tmp_path / "m.tif", StripOptions("fade"))
    with pytest.raises(UnknownNameError, match="resampling"):
        compose_strips(PlacedStrips(g, layout), tmp_path / "m.tif", StripOptions(resampling="best"))
    path = g.ccds[1].path
    path.write_bytes(path.read_bytes()[:100_000])
    with pytest.raises(FileError, match=r"1\.tif"):
        compose_strips(PlacedStrips(g, layout), tmp_path / "m.tif")


def test_progress_and_cancel(tmp_path):
    g = strips(tmp_path, ccds=2)
    reports = []

    class Stopped(Unobserved):
        def progress(self, done, total, text=""):
            reports.append((done, total))

        def check_cancelled(self):
            if reports:
                raise KeyboardInterrupt

    scene = PlacedStrips(g, image_space_layout(g, NOMINAL))
    with pytest.raises(KeyboardInterrupt):
        compose_strips(scene, tmp_path / "m.tif", progress=Stopped())
    assert reports == [(512, 1000)]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    plan = StripPlan(seed=3, ccds=3, lines=2800, drift_angle_deg=0.05, gain_sd=0.03, column_sd=0.0, snr=1e4)
    made = simulate_strips(tmp_path_factory.mktemp("strips"), plan, scene=False)
    return plan, read_geometry(made.geometry), StripWorld(plan)


def test_true_offsets_leave_no_step_at_the_seams(simulated, tmp_path):
    """Left strip alone and right strip alone, each composed by itself, show one image in the overlap."""
    plan, g, world = simulated
    n = np.zeros(plan.lines)
    pairs = tuple(
        PairOffsets(t.pair, t.dcol_px, t.dline_px, n, n, n.astype(np.uint8))
        for t in map(world.truth, g.pairs)
    )
    rms = {}
    for name, found in (("truth", pairs), ("nominal", ())):
        layout = image_space_layout(g, StripOffsets(name, found))
        images = []
        for k in (0, 1):
            alone = tuple(c if j == k else Ccd(None, c.row) for j, c in enumerate(g.ccds))
            part = dataclasses.replace(g, ccds=alone)
            images.append(composed(part, tmp_path / f"{k}.tif", layout)[1:])
        zone = slice(layout.cols(1)[0] + 6, layout.cols(0)[1] - 6)
        both = (images[0][1] & images[1][1])[:, zone]
        left, right = (p[:, zone][both].astype(float) for p, _ in images)
        gain = (left * right).sum() / (left**2).sum()
        rms[name] = np.sqrt(((right - gain * left) ** 2).mean())
    assert rms["truth"] < 2.0
    assert rms["nominal"] > 5.0 * rms["truth"]


PEAK = """
import sys
from pathlib import Path
from geomosaic.ccd.layout import image_space_layout
from geomosaic.ccd.model import StripOffsets
from geomosaic.composition.strip_compose import PlacedStrips, compose_strips
from geomosaic.survey.strips import Ccd, StripGeometry
folder, lines = Path(sys.argv[1]), int(sys.argv[2])
g = StripGeometry(ccds=(Ccd(folder / "0.tif", 1), Ccd(folder / "1.tif", 2)), width_px=1024, lines=(lines, lines),
                  row_separation_lines=100.0, line_rate_hz=3000.0, bit_depth=10)
compose_strips(PlacedStrips(g, image_space_layout(g, StripOffsets("none", ()))), folder / "m.tif")
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""
# VmHWM and not getrusage, whose highest is at least that of the process this one was started by.


@pytest.mark.proof
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the peak memory from /proc")
def test_memory_does_not_grow_with_the_lines(tmp_path):
    peaks_mb = []
    for lines in (12000, 36000):  # 12 and 37 million pixels a strip, 16 bits; both fill the cache of blocks
        for k in range(2):
            write(tmp_path / f"{k}.tif", np.full((lines, 1024), 500 + k, np.uint16))
        command = [sys.executable, "-c", PEAK, str(tmp_path), str(lines)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        peaks_mb.append(int(done.stdout) / 1024)
    assert peaks_mb[1] < peaks_mb[0] + 40.0  # a strip grows by 49, the scene by 98
